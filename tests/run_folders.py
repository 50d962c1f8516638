"""A folder for each run of the tests, and the clean-up after killed runs."""

import fcntl
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

DISK = Path("/tmp")
MEMORY = Path("/dev/shm")
ENOUGH_BYTES = 8 * 2**30
"""Of free memory, for the databases of all processes of the tests."""
PREFIX = "amers-test-"
MARK = "run"
"""A file that the process of the tests locks as long as it lives."""
PATIENCE_S = 10.0


def place_of_databases() -> Path:
    """In memory if there is enough: a database is made and dropped there in a tenth of the time."""
    free_bytes = shutil.disk_usage(MEMORY).free if MEMORY.is_dir() else 0
    return MEMORY if free_bytes >= ENOUGH_BYTES else DISK


@contextmanager
def run_folder(where: Path = DISK) -> Iterator[Path]:
    """A temporary folder with a short path that the server's user can enter, unlike pytest's."""
    folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=where))
    folder.chmod(0o755)
    with (folder / f"{MARK}.new").open("w") as mark:
        fcntl.flock(mark, fcntl.LOCK_EX)
        # It gets its name once it is locked, so that no other run takes this one for dead.
        (folder / f"{MARK}.new").rename(folder / MARK)
        yield folder
        # Still locked: another run would take a folder without its lock for that of a killed run.
        shutil.rmtree(folder, ignore_errors=True)


def end_dead_runs(*places: Path) -> list[Path]:
    """Kill the remaining processes of killed runs and delete their folders; returns the folders."""
    ended = []
    for mark in (mark for place in places for mark in place.glob(f"{PREFIX}*/{MARK}")):
        with suppress(OSError), mark.open() as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            _end_processes_in(mark.parent)
            shutil.rmtree(mark.parent, ignore_errors=True)
            ended.append(mark.parent)
    return ended


def processes_in(folder: Path) -> dict[int, bool]:
    """The processes with their working folder (True) or an open file (False) in a folder."""
    found: dict[int, bool] = {}
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            works_there = process.joinpath("cwd").readlink().is_relative_to(folder)
            links = [] if works_there else list(process.joinpath("fd").iterdir())
            if works_there or any(_leads_into(link, folder) for link in links):
                found[int(process.name)] = works_there
    found.pop(os.getpid(), None)
    return found


def _leads_into(link: Path, folder: Path) -> bool:
    with suppress(OSError):
        return link.readlink().is_relative_to(folder)
    return False


def _end_processes_in(folder: Path) -> None:
    """Stop PostgreSQL, which works in its data, so that it frees its memory; kill the others."""
    deadline = time.monotonic() + PATIENCE_S
    while (left := processes_in(folder)) and time.monotonic() < deadline:
        for number, works_there in left.items():
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGQUIT if works_there else signal.SIGKILL)
        time.sleep(0.1)
    for number in left:
        with suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
