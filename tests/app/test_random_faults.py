"""Processes killed at random moments: a small run of the benchmark `python -m benchmarks.faults`."""

from pathlib import Path

import pytest

from benchmarks.faults import Work, run

pytestmark = [pytest.mark.long, pytest.mark.endurance]

WORK = Work(registrations=4, ingestions=2, uploads=2, exports=1, backups=2)
KILL_EVERY_S = 2.0
SEED = 7


def test_whatever_is_killed_every_job_ends_once_and_nothing_is_incomplete(open_folder: Path):
    folder = open_folder / "faults"
    folder.mkdir(mode=0o755)
    outcome = run(folder, WORK, SEED, KILL_EVERY_S)
    assert outcome["wrong"] == [], outcome
    assert sum(outcome["ended"].values()) == WORK.registrations + WORK.ingestions + WORK.exports
    assert sum(outcome["killed"].values()) >= 1, "nobody was killed: this shows nothing"
