"""Killed runs of the tests: the next run ends what they left, and nothing else."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.run_folders import PREFIX, end_dead_runs, processes_in, run_folder

RUN = """
import sys
from pathlib import Path
from amers.app.db.cluster.embedded import Cluster
from tests.run_folders import run_folder
with run_folder(Path(sys.argv[1])) as folder, Cluster(folder / "postgres", durable=False).lease():
    print(folder, flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder that only runs of this test use."""
    with run_folder() as folder:
        place = folder / "place"
        place.mkdir(mode=0o755)
        yield place


@contextmanager
def running(place: Path) -> Iterator[tuple["subprocess.Popen[str]", Path]]:
    """A run with a database as a separate process, and its folder."""
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", RUN, str(place)]
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as run:
        assert run.stdout is not None
        yield run, Path(run.stdout.readline().strip())


@pytest.mark.database
def test_the_database_of_a_run_that_was_killed_is_ended_by_the_next(place: Path):
    with running(place) as (alive, its_folder), running(place) as (run, folder):
        assert folder.name.startswith(PREFIX)
        run.kill()
        run.wait()
        servers = [number for number, works_there in processes_in(folder).items() if works_there]
        assert servers, "PostgreSQL goes on without the run that started it"
        assert end_dead_runs(place) == [folder]
        assert processes_in(folder) == {}
        assert not folder.exists()
        assert processes_in(its_folder), "a run that lives keeps its database"
        alive.communicate("")
    assert not its_folder.exists()


@pytest.mark.database
def test_dead_runs_are_ended_wherever_they_have_their_databases(place: Path):
    places = [place / "memory", place / "disk"]
    dead = []
    for where in places:
        where.mkdir(mode=0o755)
        with running(where) as (run, folder):
            run.kill()
            dead.append(folder)
    assert end_dead_runs(*places, place / "missing") == dead
    assert all(processes_in(folder) == {} and not folder.exists() for folder in dead)


def test_a_folder_without_the_mark_of_a_run_is_left_alone(place: Path):
    other = place / f"{PREFIX}of-somebody-else"
    other.mkdir()
    stranger = subprocess.Popen(["sleep", "600"], cwd=other)
    try:
        assert end_dead_runs(place) == []
        assert stranger.poll() is None
    finally:
        os.kill(stranger.pid, signal.SIGKILL)
        stranger.wait()
    assert other.exists()
