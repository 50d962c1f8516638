"""Child processes in Python: none of them runs code from the working folder.

Python looks for modules in the working folder first when it is given a statement (`-c`) or a module
(`-m`). People work in folders that were unpacked from deliveries: a `numpy.py` beside the images must
stay a file.
"""

import os
import sys

SAFE_PATH = {
    "PYTHONSAFEPATH": "1",
    "NUMBA_CACHE_DIR": "",
    "NUMBA_CACHE_LOCATOR_CLASSES": "",
}
"""Variables for processes that libraries start, such as the servers of multiprocessing.

Numba reads `.numba_config.yaml` in the working folder, which could name a folder of compiled code;
variables of the environment come first, and empty ones stand for its own folders.
"""


def python_command(*arguments: str) -> tuple[str, ...]:
    """The command line of a Python process that does not look for modules in its working folder.

    Args:
        arguments: of the interpreter: a statement after `-c`, a module after `-m`.
    """
    return (sys.executable, "-P", *arguments)


def leave_out_working_folder() -> None:
    """Let no process that this one starts, by whatever library, look for modules in the working folder.

    An empty part of `PYTHONPATH`, as `PYTHONPATH=$PYTHONPATH:/more` has, stands for that folder: it is
    taken out, for this process too.
    """
    for name, value in SAFE_PATH.items():
        os.environ.setdefault(name, value)
    places = os.environ.pop("PYTHONPATH", "").split(os.pathsep)
    named = [place for place in places if place]
    if named:
        os.environ.update(PYTHONPATH=os.pathsep.join(named))
    if 1 < len(places) > len(named) and os.getcwd() in sys.path:
        sys.path.remove(os.getcwd())
