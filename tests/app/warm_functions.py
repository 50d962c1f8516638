"""What the warm processes of a test run."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


def end_with(arguments: list[str]) -> int:
    """End with this exit code."""
    return int(arguments[0])


def describe(arguments: list[str]) -> int:
    """Write what surrounds the process into a file."""
    facts = {
        "temporary": tempfile.gettempdir(),
        "variable": os.environ.get("AMERS_TEST_VARIABLE"),
        "random": float(np.random.uniform()),
        "session": os.getsid(0) == os.getpid(),
        "group": os.getpgrp() == os.getpid(),
        "threads": len(os.listdir("/proc/self/task")),
        "descriptors": sorted(os.readlink(f"/proc/self/fd/{n}") for n in (0, 1, 2)),
        "sockets": sum("socket" in _target(name) for name in os.listdir("/proc/self/fd")),
        "kernels_loaded": _kernels_loaded(),
    }
    Path(arguments[0]).write_text(json.dumps(facts))
    return 0


def sleep_with_a_child(arguments: list[str]) -> int:
    """Start a child, write both process numbers into a file, and sleep."""
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    part = Path(arguments[0] + ".part")
    part.write_text(f"{os.getpid()} {child.pid}")
    part.rename(arguments[0])
    time.sleep(600)
    return 0


def leave_a_child(arguments: list[str]) -> int:
    """Start a child, write its process number into a file, and end without it."""
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    Path(arguments[0]).write_text(str(child.pid))
    return 0


def fail(arguments: list[str]) -> int:
    """Raise an error."""
    raise ValueError(arguments[0])


def _target(name: str) -> str:
    try:
        return os.readlink(f"/proc/self/fd/{name}")
    except OSError:
        return ""


def _kernels_loaded() -> bool:
    from amers.services.sensors import rpc

    return bool(rpc._project.signatures) and bool(rpc._locate.signatures)
