"""A few concurrent clients for a few seconds; the large run is `python -m benchmarks.load`."""

from pathlib import Path

import pytest

from benchmarks.load import run

pytestmark = [pytest.mark.long, pytest.mark.endurance]

CLIENTS, SECONDS, SEED = 8, 5.0, 1
KINDS = {"chips", "footprint", "point", "tile"}


def test_clients_are_all_answered_while_a_block_is_ingested_and_a_scene_registered(open_folder: Path):
    folder = open_folder / "load"
    folder.mkdir(mode=0o755)
    outcome = run(folder, CLIENTS, SECONDS, SEED)
    assert outcome["errors"] == {}
    assert set(outcome["jobs"]) == {"ingestion successful", "registration successful"}
    assert set(outcome["milliseconds"]) == KINDS
