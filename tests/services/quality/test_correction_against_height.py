"""Corrections that grow up the slope of the ground, as those of another view's model do."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from amers.services.misfit.displacement_components import Component
from amers.services.quality.criteria import Criterion
from amers.services.quality.lack_of_fit import correction_against_height
from amers.services.quality.qualification import QualificationOptions, qualify
from amers.services.types import Array
from tests.services.conftest import Registered

GSD_M = 0.5
SIDE_PX = 2_000.0
LIMIT_PERCENT = 0.6


def places(rng: np.random.Generator, n: int = 60) -> Array:
    """Positions all over an image."""
    return rng.uniform(0.0, SIDE_PX, (n, 2))


def hillside(line_sample: Array, percent: float, towards_deg: float = 30.0) -> Array:
    """Heights of ground that rises towards some direction of the image, with bumps of 2 m."""
    towards = np.array([np.cos(np.radians(towards_deg)), np.sin(np.radians(towards_deg))])
    bumps_m = 2.0 * np.sin(line_sample[:, 0] / 150.0) * np.cos(line_sample[:, 1] / 110.0)
    return np.asarray(200.0 + percent / 100.0 * GSD_M * line_sample @ towards + bumps_m)


def seen_otherwise(height_m: Array, degrees: float, towards_deg: float = 80.0) -> Array:
    """Displacement of points whose lines of sight lean by more than those of the model."""
    towards = np.array([np.cos(np.radians(towards_deg)), np.sin(np.radians(towards_deg))])
    return np.asarray(height_m[:, None] * np.tan(np.radians(degrees)) / GSD_M * towards)


def judged(displacement_px: Array, line_sample: Array, height_m: Array) -> Criterion:
    """The criterion, on measures with an error of a fifth of a pixel."""
    noise_px = np.random.default_rng(9).normal(0.0, 0.2, displacement_px.shape)
    return correction_against_height(displacement_px + noise_px, line_sample, height_m, GSD_M)


@pytest.mark.parametrize(("slope_percent", "degrees"), [(10.0, 6.0), (4.0, 15.0), (-10.0, 6.0)])
def test_the_model_of_another_view_is_told_by_the_slope_of_a_hillside(
    slope_percent: float, degrees: float
) -> None:
    """An affine follows a hillside: the ground rises by some percent, and leans as it rises."""
    at = places(np.random.default_rng(1))
    height_m = hillside(at, slope_percent)
    criterion = judged(seen_otherwise(height_m, degrees), at, height_m)
    expected = abs(slope_percent) * np.tan(np.radians(degrees))
    assert criterion.value == pytest.approx(expected, rel=0.1)
    assert not criterion.met
    assert criterion.needed_for == "usable"
    assert f"{degrees:.0f} degrees" in criterion.note
    assert "another view" in criterion.note


@pytest.mark.parametrize("seed", range(10))
def test_drift_and_skew_of_an_own_model_are_not_accused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    at = places(rng)
    drift = rng.uniform(-0.002, 0.002, (2, 2))
    criterion = judged(30.0 + at @ drift, at, hillside(at, 20.0, rng.uniform(0.0, 360.0)))
    assert criterion.met
    assert criterion.note == ""
    assert criterion.value <= LIMIT_PERCENT


@pytest.mark.parametrize(
    "jacobian", [[[0.0, -0.02], [0.02, 0.0]], [[0.02, 0.0], [0.0, 0.02]], [[0.01, -0.02], [0.02, 0.01]]]
)
def test_an_image_that_is_turned_or_scaled_is_not_taken_for_another_view(
    jacobian: list[list[float]],
) -> None:
    """They grow as much across a slope as up it."""
    at = places(np.random.default_rng(2))
    assert judged(at @ np.array(jacobian), at, hillside(at, 10.0)).value == 0.0


def rough_hillside(at: Array) -> Array:
    """Heights of ground that rises by 10 %, with hills of 30 m."""
    hills_m = 30.0 * np.sin(at[:, 0] / 200.0) * np.cos(at[:, 1] / 170.0)
    return np.asarray(hillside(at, 10.0) + hills_m)


def test_a_drift_up_a_slope_that_hills_beside_it_do_not_follow_is_a_drift() -> None:
    """The same displacement of the plane, with and without that of the hills."""
    at = places(np.random.default_rng(10))
    height_m = rough_hillside(at)
    design = np.column_stack([np.ones(len(at)), at])
    plane_m = design @ np.linalg.lstsq(design, height_m, rcond=None)[0]
    drift = judged(seen_otherwise(plane_m, 6.0), at, height_m)
    of_another_view = judged(seen_otherwise(height_m, 6.0), at, height_m)
    assert drift.met
    assert drift.value == 0.0
    assert not of_another_view.met


@pytest.mark.parametrize("drift", [0.006, 0.02])
def test_another_view_that_drifts_up_the_slope_too_is_another_view(drift: float) -> None:
    """Residuals then grow with the heights by less than would explain all of the correction."""
    at = places(np.random.default_rng(12))
    height_m = rough_hillside(at)
    up = np.array([np.cos(np.radians(30.0)), np.sin(np.radians(30.0))])
    along = np.array([np.cos(np.radians(80.0)), np.sin(np.radians(80.0))])
    assert not judged(seen_otherwise(height_m, 6.0) + drift * np.outer(at @ up, along), at, height_m).met


def test_hills_too_low_to_be_seen_in_the_residuals_refute_nothing() -> None:
    at = places(np.random.default_rng(11))
    design = np.column_stack([np.ones(len(at)), at])
    height_m = hillside(at, 10.0)
    plane_m = design @ np.linalg.lstsq(design, height_m, rcond=None)[0]
    low_m = plane_m + 0.1 * (height_m - plane_m)
    assert not judged(seen_otherwise(plane_m, 6.0), at, low_m).met


def test_level_ground_explains_no_correction() -> None:
    """Its points differ by centimetres: no line of sight leans by as much as they would ask for."""
    rng = np.random.default_rng(3)
    at = places(rng)
    height_m = 50.0 + 1e-4 * GSD_M * at[:, 0] + rng.normal(0.0, 0.01, len(at))
    skew = at @ np.array([[0.0, 0.02], [0.0, 0.0]])
    assert judged(skew, at, height_m).value == 0.0
    assert judged(skew, at, np.full(len(at), 50.0)).value == 0.0


def test_a_few_points_close_together_say_too_little() -> None:
    """The same hillside and lean, seen in full and in a corner by six points of a pixel."""
    wide = SIDE_PX * np.array([[0.1, 0.1], [0.1, 0.9], [0.5, 0.4], [0.6, 0.7], [0.9, 0.2], [0.9, 0.8]])
    narrow = wide / 20.0
    noise_px = np.random.default_rng(4).normal(0.0, 1.0, (6, 2))
    for at, met in ((wide, False), (narrow, True)):
        height_m = hillside(at, 10.0)
        displacement_px = seen_otherwise(height_m, 6.0) + noise_px
        assert correction_against_height(displacement_px, at, height_m, GSD_M).met == met


@pytest.mark.parametrize("n", [0, 1, 3])
def test_a_plane_through_all_points_says_nothing(n: int) -> None:
    at = places(np.random.default_rng(5), n)
    height_m = hillside(at, 20.0)
    criterion = correction_against_height(seen_otherwise(height_m, 20.0), at, height_m, GSD_M)
    assert criterion.met
    assert criterion.value == 0.0


def test_the_criterion_knows_no_axes_no_origin_and_no_datum() -> None:
    at = places(np.random.default_rng(6))
    height_m = hillside(at, 10.0)
    moved_px = seen_otherwise(height_m, 6.0) + np.random.default_rng(7).normal(0.0, 0.5, at.shape)
    value = correction_against_height(moved_px, at, height_m, GSD_M).value
    for other in (
        correction_against_height(moved_px[:, ::-1], at[:, ::-1], height_m, GSD_M),
        correction_against_height(moved_px + 500.0, at - 300.0, height_m - 1_000.0, GSD_M),
        correction_against_height(2.0 * moved_px, 2.0 * at, height_m, GSD_M / 2.0),
    ):
        assert other.value == pytest.approx(value, rel=1e-9)


def test_the_registration_of_a_hillside_with_the_model_of_another_view_does_not_meet_it(
    registered: Callable[..., Registered],
) -> None:
    """Its residuals are those of a good one: the affine has followed the hillside."""
    scene = registered()
    measures = scene.measures
    at = measures.line_sample
    height_m = hillside(at, 10.0)
    lon_lat_h = np.column_stack([measures.lon_lat_h[:, :2], height_m])
    for degrees, verdict in ((0.0, "good"), (6.0, "failed")):
        predicted = at - seen_otherwise(height_m, degrees)
        seen = replace(scene, measures=replace(measures, predicted=predicted, lon_lat_h=lon_lat_h))
        result = qualify(seen.adjusted(), QualificationOptions(), np.random.default_rng(3))
        assert result.verdict == verdict
        unmet = {c.name for c in result.criteria if not c.met}
        assert unmet == ({"correction_against_height"} if verdict == "failed" else set())


def test_repeated_lines_on_a_hillside_are_no_other_view(registered: Callable[..., Registered]) -> None:
    """Sixty lines that are repeated in the middle displace what lies behind them up the slope."""
    scene = registered()
    measures = scene.measures
    at = measures.line_sample
    height_m = hillside(at, 10.0, towards_deg=0.0)
    lon_lat_h = np.column_stack([measures.lon_lat_h[:, :2], height_m])
    middle = np.nanmedian(at[:, 0])
    behind = at[:, 0] > middle
    seen = replace(measures, predicted=at - 60.0 * behind[:, None] * [1.0, 0.0], lon_lat_h=lon_lat_h)
    followed = Component("break", 1.0, float(middle), np.full(2, 1e4))
    for components, verdict in (((), "failed"), ((followed,), "good")):
        adjustment = replace(scene.adjustment, components=components)
        registration = replace(scene, measures=seen, adjustment=adjustment)
        result = qualify(registration.adjusted(), QualificationOptions(), np.random.default_rng(3))
        assert result.verdict == verdict
