"""Linear algebra on one thread: its threads wait for each other longer than our matrices take.

They are of a hundred measures; the demonstration takes a third less CPU without them. Whole scenes and
tasks are what runs at the same time.
"""

import os

ONE_THREAD = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Variables that libraries of linear algebra read when they are loaded."""


def use_one_thread() -> None:
    """Let this process and its children use one thread, unless their environment says otherwise."""
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)
