"""A small stress campaign: difficult scenes of a small world, and the conditions that describe SRP."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks._campaign import Outcome, attempt, prepare
from benchmarks._trials import Trial, draw_trial, nominal_trial
from benchmarks._worlds import Block, Place, block_of
from benchmarks.stress import by_factor, read_outcomes, summary
from services.imagery.source import Window
from services.registration.on_points import Registration, register_scene
from services.registration.options import RegistrationOptions

pytestmark = pytest.mark.long

SMALL = Place("small", 5, 1_700.0, 1.0, 40.0, 0.0, (0.8, 1.4), 1150, points=22)
NOMINAL = replace(SMALL, gsd_m=(0.5, 0.5), lines=2900)
OPTIONS = RegistrationOptions(max_points=100)
SEED = 3
SCENES = 6
CLEAR = {
    "haze": 0.0,
    "cloud_cover": 0.0,
    "inverted": False,
    "season": 0.0,
    "noise": 4.0,
    "vanished": 0.0,
    "moved": 0.0,
    "understated": 1.0,
    "drift_px": 0.5,
    "point_ce90_m": 1.0,
}
FREE_ERRORS = 6
"""Parameters of a correction: the errors over an image are no more independent than these."""
a_fifth_of_what_points_have = 0.2
what_srp_publishes_for_corners_m = 0.3
half_a_pixel_of_the_chips_m = 1.0


@pytest.fixture(scope="module")
def block() -> Block:
    return block_of(SMALL)


@pytest.fixture(scope="module")
def hard(block: Block) -> list:
    trials = [draw_trial(SEED, number, (SMALL,)) for number in range(SCENES)]
    return [(trial, attempt(SMALL, trial, block, SEED, OPTIONS)) for trial in trials]


@pytest.fixture(scope="module")
def clear(block: Block) -> list:
    return [(trial, attempt(SMALL, trial, block, SEED, OPTIONS)) for trial in map(clear_trial, range(4))]


def clear_trial(number: int, **changes: object) -> Trial:
    """The trial of a number without its difficult conditions."""
    return replace(draw_trial(SEED, number, (SMALL,)), **{**CLEAR, **changes})


def registration_of(trial: Trial, block: Block) -> Registration:
    prepared = prepare(SMALL, trial, block, SEED)
    return register_scene(
        prepared.scene, prepared.points, replace(block, points=prepared.points), OPTIONS
    )


def test_no_delivered_scene_has_a_larger_error_than_stated(hard: list, clear: list) -> None:
    assert not [trial.number for trial, outcome in hard + clear if outcome.delivered and outcome.wrong]


def test_clear_scenes_are_delivered_and_most_are_good(clear: list) -> None:
    assert all(outcome.delivered for _, outcome in clear)
    assert sum(outcome.verdict == "good" for _, outcome in clear) > len(clear) / 2
    assert all(outcome.ce90_m < half_a_pixel_of_the_chips_m for _, outcome in clear)


def test_most_hard_scenes_are_delivered_too(hard: list) -> None:
    assert sum(outcome.delivered for _, outcome in hard) > SCENES / 2


def test_errors_agree_with_the_stated_accuracy(hard: list, clear: list) -> None:
    squares = [outcome.normalised for _, outcome in hard + clear if outcome.delivered]
    low, high = chi2.interval(0.999, FREE_ERRORS * len(squares)) / np.float64(FREE_ERRORS * len(squares))
    assert low < np.mean(squares) < high


def test_nominal_conditions_give_a_model_five_times_better_than_its_points(block: Block) -> None:
    trial = nominal_trial(SEED, 0, NOMINAL)
    outcome = attempt(NOMINAL, trial, block, SEED, RegistrationOptions())
    assert outcome.delivered
    assert not outcome.wrong
    assert outcome.ce90_m < a_fifth_of_what_points_have * trial.point_ce90_m
    assert outcome.displacement_m < what_srp_publishes_for_corners_m


def test_inverted_contrast_is_found_by_its_gradient_and_reported(block: Block) -> None:
    result = registration_of(clear_trial(1, inverted=True), block)
    assert result.qualification.verdict != "failed"
    assert result.measures.by_gradient[result.measures.active].all()
    as_it_was = registration_of(clear_trial(1), block).measures
    assert as_it_was.by_gradient[as_it_was.active].mean() < 0.1


def test_points_hidden_by_clouds_are_reported_as_cloudy(block: Block) -> None:
    without = registration_of(clear_trial(1), block).measures
    below = registration_of(clear_trial(1, cloud_cover=0.4), block).measures
    hidden = without.matched & ~below.matched
    assert hidden.sum() > 10
    assert (below.reason[hidden] == "cloud").mean() > 0.5
    assert not (without.reason == "cloud").any()


def test_a_scene_is_determined_by_the_seed_and_its_number(block: Block) -> None:
    trials = [draw_trial(SEED, 4, (SMALL,)) for _ in range(2)]
    assert trials[0] == trials[1]
    assert draw_trial(SEED, 5, (SMALL,)) != trials[0]
    first, again = (prepare(SMALL, trial, block, SEED) for trial in trials)
    np.testing.assert_array_equal(first.points.lon_lat_h, again.points.lon_lat_h)
    np.testing.assert_array_equal(first.points.chip_row, again.points.chip_row)
    window = Window(500, 600, 64, 64)
    np.testing.assert_array_equal(first.scene.image.read(window), again.scene.image.read(window))


def test_points_have_the_errors_of_the_trial(block: Block) -> None:
    calm = replace(nominal_trial(SEED, 1, SMALL), point_ce90_m=3.0, understated=2.0)
    prepared = prepare(SMALL, calm, block, SEED)
    degrees = prepared.points.lon_lat_h[:, 1] - block.points.lon_lat_h[:, 1]
    north_m = degrees * 111_100.0 - prepared.frame_shift_m[1]
    declared_m = 3.0 / np.sqrt(2.0 * np.log(10.0))
    few = 4.0 / np.sqrt(2.0 * len(north_m))
    assert north_m.std() == pytest.approx(2.0 * declared_m, rel=few)


def test_outcomes_are_read_back_without_a_broken_line(tmp_path: Path) -> None:
    trial = draw_trial(SEED, 0, (SMALL,))
    nothing = float("nan")
    outcome = Outcome("refused", "why", 0, 0, 0, "", *[nothing] * 7, 1.5)
    line = json.dumps(
        {"name": "trial_00000", "code": "a", "trial": asdict(trial), "outcome": asdict(outcome)}
    )
    file = tmp_path / "outcomes.jsonl"
    file.write_text(line + "\n" + line[: len(line) // 2])
    outcomes = read_outcomes(file, "a")
    assert list(outcomes) == ["trial_00000"]
    assert outcomes["trial_00000"][0] == trial
    assert read_outcomes(file, "b") == {}


def test_every_scene_is_in_one_class_of_each_factor(hard: list) -> None:
    for classes in by_factor(hard).values():
        assert sum(row["scenes"] for row in classes) == len(hard)
    whole = summary(hard)
    assert whole["good"] + whole["usable"] + whole["failed"] + whole["refused"] == SCENES
