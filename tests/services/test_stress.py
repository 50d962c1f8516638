"""The stress campaign in small: hard scenes of a small world, and the conditions SRP is described by."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks._campaign import Outcome, attempt, prepare
from benchmarks._trials import draw_trial, nominal_trial
from benchmarks._worlds import Block, Place, block_of
from benchmarks.stress import by_factor, read_outcomes, summary
from services.imagery import Window
from services.registration import RegistrationOptions

SMALL = Place("small", 5, 1_700.0, 1.0, 40.0, 0.0, (0.8, 1.4), 1150, points=15)
NOMINAL = replace(SMALL, gsd_m=(0.5, 0.5), lines=2900)
SEED = 3
SCENES = 8
a_fifth_of_what_points_have = 0.2
what_srp_publishes_for_corners_m = 0.3


@pytest.fixture(scope="module")
def block() -> Block:
    return block_of(SMALL)


@pytest.fixture(scope="module")
def results(block: Block) -> list:
    trials = [draw_trial(SEED, number, (SMALL,)) for number in range(SCENES)]
    options = RegistrationOptions(max_points=100)
    return [(trial, attempt(SMALL, trial, block, SEED, options)) for trial in trials]


def test_no_scene_called_good_is_wrong_by_more_than_it_says(results: list) -> None:
    good = [outcome for _, outcome in results if outcome.verdict == "good"]
    assert not [outcome for outcome in good if outcome.wrong]


def test_nominal_conditions_give_a_model_five_times_better_than_its_points(block: Block) -> None:
    trial = nominal_trial(SEED, 0, NOMINAL)
    outcome = attempt(NOMINAL, trial, block, SEED, RegistrationOptions())
    assert not outcome.wrong
    assert outcome.ce90_m < a_fifth_of_what_points_have * trial.point_ce90_m
    assert outcome.displacement_m < what_srp_publishes_for_corners_m


def test_a_scene_follows_from_the_seed_and_its_number(block: Block) -> None:
    trials = [draw_trial(SEED, 4, (SMALL,)) for _ in range(2)]
    assert trials[0] == trials[1]
    assert draw_trial(SEED, 5, (SMALL,)) != trials[0]
    first, again = (prepare(SMALL, trial, block, SEED) for trial in trials)
    np.testing.assert_array_equal(first.points.lon_lat_h, again.points.lon_lat_h)
    np.testing.assert_array_equal(first.points.chip_row, again.points.chip_row)
    window = Window(500, 600, 64, 64)
    np.testing.assert_array_equal(first.scene.image.read(window), again.scene.image.read(window))


def test_points_are_wrong_by_as_much_as_the_trial_says(block: Block) -> None:
    calm = replace(nominal_trial(SEED, 1, SMALL), point_ce90_m=3.0, understated=2.0)
    prepared = prepare(SMALL, calm, block, SEED)
    degrees = prepared.points.lon_lat_h[:, 1] - block.points.lon_lat_h[:, 1]
    north_m = degrees * 111_100.0 - prepared.frame_shift_m[1]
    declared_m = 3.0 / np.sqrt(2.0 * np.log(10.0))
    few = 4.0 / np.sqrt(2.0 * len(north_m))
    assert north_m.std() == pytest.approx(2.0 * declared_m, rel=few)


def test_what_was_done_is_read_again_and_a_cut_off_line_is_not(tmp_path: Path) -> None:
    trial = draw_trial(SEED, 0, (SMALL,))
    nothing = float("nan")
    outcome = Outcome("refused", "why", 0, 0, 0, "", *[nothing] * 7, 1.5)
    line = json.dumps(
        {"name": "trial_00000", "code": "a", "trial": asdict(trial), "outcome": asdict(outcome)}
    )
    file = tmp_path / "outcomes.jsonl"
    file.write_text(line + "\n" + line[: len(line) // 2])
    done = read_outcomes(file, "a")
    assert list(done) == ["trial_00000"]
    assert done["trial_00000"][0] == trial
    assert read_outcomes(file, "b") == {}


def test_every_scene_is_in_one_class_of_each_factor(results: list) -> None:
    for classes in by_factor(results).values():
        assert sum(row["scenes"] for row in classes) == len(results)
    whole = summary(results)
    assert whole["good"] + whole["usable"] + whole["failed"] + whole["refused"] == SCENES
