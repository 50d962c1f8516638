"""Scenes of the campaign: drawn as stated, rendered as drawn, judged by their own truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amers.services.geodesy import move_metres
from amers.services.registration.options import RegistrationOptions
from benchmarks._campaign import Log
from benchmarks._distorted_tables import accused, by_kind, distorted_acceptance, figures_of
from benchmarks._distortions import (
    JITTER_PX,
    LONGEST_PERIOD,
    MOVED_M,
    MOVED_SHARE,
    SEAMS,
    SHORTEST_PERIOD_PX,
    STEP_LINES,
    Drawn,
    distortion_of,
)
from benchmarks._outcome import Outcome, attempt, outcome_of
from benchmarks._scenes import Prepared, prepare
from benchmarks._trials import DISTORTED, Trial, distorted_trial, draw_trial
from benchmarks._worlds import Block, Place, block_of

pytestmark = pytest.mark.long

SMALL = Place("small", 5, 1_700.0, 1.0, 40.0, 0.0, (0.8, 1.4), 1150, points=22)
OPTIONS = RegistrationOptions(max_points=100)
SEED = 3
RIGHT = Outcome(
    "good", "", 9, 9, 9, "drift", 9.0, 0.4, 0.9, 0.4, 0.5, 1.0, 0.1, 1.0, 1.0, 1.0, 0.0, 1.0, 9.0, 99.0
)
REFUSED = Outcome("refused", "why", 0, 0, 0, "", *[float("nan")] * 7, 1.5)
few_pixels = 1e-6


@pytest.fixture(scope="module")
def block() -> Block:
    return block_of(SMALL)


def drawn(family: str, count: int = 200) -> list[Drawn]:
    return [distorted_trial(family, SEED, k, (SMALL,)).distortion for k in range(count)]


def prepared_with(block: Block, distortion: Drawn, number: int = 1) -> Prepared:
    trial = replace(distorted_trial("jitter", SEED, number, (SMALL,)), distortion=distortion)
    return prepare(SMALL, trial, block, SEED)


def test_sizes_are_drawn_from_the_whole_of_their_ranges() -> None:
    def covers(values: list[float], low: float, high: float) -> bool:
        inside = low <= min(values) and max(values) <= high
        return inside and min(values) < 1.5 * low and max(values) > high / 1.5

    jitter = drawn("jitter")
    assert covers([d.amplitude_px for d in jitter], *JITTER_PX)
    sines = [d.period_px for d in jitter if d.kind == "sines"]
    assert covers(sines, SHORTEST_PERIOD_PX, LONGEST_PERIOD * SMALL.lines)
    assert covers([d.step_lines for d in drawn("steps")], *STEP_LINES)
    assert covers([d.moved_share for d in drawn("moved")], *MOVED_SHARE)
    assert covers([d.moved_m for d in drawn("moved")], *MOVED_M)


@pytest.mark.parametrize("family", DISTORTED)
def test_a_scene_is_the_ordinary_one_made_mild_and_distorted(family: str) -> None:
    trial, ordinary = distorted_trial(family, SEED, 4, (SMALL,)), draw_trial(SEED, 4, (SMALL,))
    assert trial == distorted_trial(family, SEED, 4, (SMALL,))
    assert (trial.gsd_m, trial.location_error_m) == (ordinary.gsd_m, ordinary.location_error_m)
    assert trial.cloud_cover <= 0.1
    assert trial.understated == 1.0
    assert trial.distortion.kind


@pytest.mark.parametrize("kind", ["sines", "random"])
def test_jitter_has_the_drawn_amplitude(kind: str) -> None:
    distortion = distortion_of(Drawn(kind, 3.0, 150.0), (3000, 50), 1.0, np.random.default_rng(1))
    pixels = np.column_stack([np.arange(3000.0), np.full(3000, 20.0)])
    moved = distortion.undistorted(pixels) - pixels
    assert np.sqrt(2.0 * (moved**2).sum(axis=1).mean()) == pytest.approx(3.0, rel=0.1)
    spectrum = (np.abs(np.fft.rfft(moved * np.hanning(3000)[:, None], axis=0)) ** 2).sum(axis=1)
    shorter = np.fft.rfftfreq(3000) > 1.0 / 150.0 + 2.0 / 3000.0
    assert spectrum[shorter].sum() < 0.01 * spectrum.sum()


@pytest.mark.parametrize("family", DISTORTED)
def test_every_distortion_has_an_inverse_where_pixels_show_their_place_once(family: str) -> None:
    pixels = np.random.default_rng(2).uniform(0.0, SMALL.lines - 1.0, (400, 2))
    for number, distortion in enumerate(drawn(family, 25)):
        shape = SMALL.lines, SMALL.lines
        made = distortion_of(distortion, shape, 1.0, np.random.default_rng(number))
        unique = made.is_unique(pixels)
        assert unique.mean() > 0.2
        back = made.distorted(made.undistorted(pixels[unique]))
        np.testing.assert_allclose(back, pixels[unique], atol=few_pixels)


def test_the_sides_of_seams_are_as_far_apart_as_drawn() -> None:
    shape = SMALL.lines, SMALL.lines
    for number, distortion in enumerate(drawn("parts", 40)):
        made = distortion_of(distortion, shape, 1.0, np.random.default_rng(number))
        assert len(made.seams) == (distortion.parts - 1 if distortion.kind in SEAMS else 0)
        for seam in made.seams:
            sides = np.full((2, 2), 0.0)
            sides[:, seam.axis] = [seam.at - 1.0, seam.at]
            apart = np.diff(made.undistorted(sides) - sides, axis=0)
            assert np.hypot(*apart[0]) == pytest.approx(distortion.amplitude_px)


def test_moved_ground_is_as_large_and_as_far_as_drawn() -> None:
    shape = SMALL.lines, SMALL.lines
    pixels = np.random.default_rng(2).uniform(0.0, SMALL.lines - 1.0, (20_000, 2))
    for number, distortion in enumerate(drawn("moved", 10)):
        made = distortion_of(distortion, shape, 0.5, np.random.default_rng(number))
        share = made.is_moved(pixels).mean()
        assert share == pytest.approx(distortion.moved_share, rel=0.05, abs=0.01)
        assert made.moved is not None
        assert np.hypot(*made.moved.shift_px) * 0.5 == pytest.approx(distortion.moved_m)


@pytest.mark.thorough
def test_the_truth_of_a_distorted_scene_is_that_of_its_pixels(block: Block) -> None:
    """What the undistorted scene shows at the undistorted place."""
    straight, bent = (prepared_with(block, d) for d in (Drawn(), Drawn("bow", 6.0)))
    truth = bent.truth()
    pixels, shown = truth.line_sample, truth.on_earth
    assert truth.judged_share == 1.0
    np.testing.assert_allclose(shown, straight.shown(bent.distortion.undistorted(pixels)), atol=1e-9)
    apart_px = straight.geometry.true_model.project(shown) - pixels
    assert np.linalg.norm(apart_px, axis=1).max() == pytest.approx(6.0, rel=0.02)


def test_the_model_of_another_view_is_right_about_the_middle_only(block: Block) -> None:
    own, other = (
        prepared_with(block, d).scene.model for d in (Drawn(), Drawn("another view", tilt_deg=10.0))
    )
    middle = np.array([[(SMALL.lines - 1.0) / 2.0] * 2])
    low_m, high_m = own.height_range_m
    low_m, high_m = 0.9 * low_m + 0.1 * high_m, 0.1 * low_m + 0.9 * high_m
    apart_m = [
        (own.locate(middle, height)[0] - other.locate(middle, height)[0])[:2] * [80_600.0, 111_100.0]
        for height in (np.array([low_m]), np.array([high_m]))
    ]
    lean = np.hypot(*(apart_m[1] - apart_m[0])) / (high_m - low_m)
    assert lean == pytest.approx(np.tan(np.radians(10.0)), rel=0.1)


@pytest.mark.thorough
def test_a_scene_without_distortion_is_right_and_a_mirrored_one_refused(block: Block) -> None:
    trial = replace(distorted_trial("jitter", SEED, 1, (SMALL,)), point_ce90_m=1.0)
    clean = attempt(SMALL, replace(trial, distortion=Drawn()), block, SEED, OPTIONS)
    assert clean.delivered
    assert clean.wrong_share == 0.0
    assert clean.judged_share == 1.0
    assert 0.0 < clean.line_gap_px < clean.spacing_px < SMALL.lines
    mirrored = attempt(SMALL, replace(trial, distortion=Drawn("mirrored")), block, SEED, OPTIONS)
    assert not mirrored.delivered
    assert mirrored.spacing_px == clean.spacing_px


@pytest.mark.thorough
def test_points_of_one_block_of_several_are_judged_in_its_frame(block: Block) -> None:
    """Points of a block 20 m off give a model 20 m off the Earth, but not off these points."""
    trial = distorted_trial("jitter", SEED, 1, (SMALL,))
    trial = replace(trial, distortion=Drawn(), blocks=2, frame_sigma_m=1.0, point_ce90_m=1.0)
    prepared = prepare(SMALL, trial, block, SEED)
    first = np.flatnonzero(prepared.points.block == 0)
    assert 0 < len(first) < len(prepared.points)
    away_m = np.array([20.0, 0.0, 0.0])
    offset_m = np.array([away_m, -away_m])
    errors = replace(prepared.errors, offset_m=offset_m)
    moved_m = (offset_m - prepared.errors.offset_m)[prepared.points.block]
    points = replace(prepared.points, lon_lat_h=move_metres(prepared.points.lon_lat_h, moved_m))
    truth = replace(prepared, points=points, errors=errors).truth()
    chips = replace(block, points=points)
    scene = replace(prepared.scene, sigma_m=30.0)
    outcome, _ = outcome_of(scene, points.take(first), chips, OPTIONS, truth)
    assert outcome.delivered
    assert not outcome.wrong
    assert outcome.normalised < 4.0
    assert outcome.ground_ce90_m == pytest.approx(20.0, abs=3.0)


def test_the_frame_of_points_of_several_blocks_is_the_earth(block: Block) -> None:
    trial = replace(distorted_trial("jitter", SEED, 1, (SMALL,)), blocks=3, frame_sigma_m=3.0)
    errors = prepare(SMALL, trial, block, SEED).errors
    ground = np.array([[*errors.centre_lon_lat, 100.0]])
    of_one = [errors.in_frame(ground, np.full(4, k)) for k in range(3)]
    for k in range(3):
        np.testing.assert_array_equal(of_one[k], move_metres(ground, errors.offset_m[[k]]))
    np.testing.assert_array_equal(errors.in_frame(ground, np.array([2, 0, 2])), ground)


def test_outcomes_of_distorted_scenes_are_read_back(tmp_path: Path) -> None:
    trial = distorted_trial("steps", SEED, 2, (SMALL,))
    log = Log(tmp_path / "outcomes.jsonl", (Trial, Outcome), "a")
    log.append("steps_00002", (trial, RIGHT))
    assert log.read() == {"steps_00002": (trial, RIGHT)}


def test_what_distorted_scenes_must_show_is_told_from_their_outcomes() -> None:
    in_part = replace(RIGHT, wrong_share=0.2)
    named = replace(RIGHT, verdict="failed", reason="coverage_percent; structure_lines", ce90_m=99.0)
    uncertain = replace(RIGHT, verdict="failed", reason="coverage_percent")
    followable = replace(RIGHT, followable=True)

    def holds(outcomes: list[Outcome]) -> list[bool]:
        return [line[1] for line in distorted_acceptance("jitter", outcomes)]

    assert holds([RIGHT]) == [True]
    assert holds([in_part, RIGHT]) == [False, False]
    assert holds([named] * 9 + [REFUSED]) == [True, True]
    assert holds([named] * 8 + [REFUSED] * 2) == [True, False]
    assert holds([uncertain]) == [True], "what is followed and too uncertain need not be named"
    assert holds([followable] * 4 + [replace(named, followable=True)]) == [True, True, True]
    assert not holds([followable] * 3 + [replace(named, followable=True)])[1]
    rows = by_kind("jitter", [(Drawn("sines"), RIGHT), (Drawn("random"), named)])
    assert [rows[kind].right for kind in ("all", "sines", "random")] == [1, 1, 0]
    assert figures_of("jitter", [named]).told_by == {"coverage_percent": 1, "structure_lines": 1}
    assert accused([RIGHT] * 200 + [named])[1]
    assert not accused([RIGHT] * 50 + [named])[1]
