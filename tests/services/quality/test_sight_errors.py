"""Heights that move points otherwise than the model says: what tells them, and what they harm."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.misfit.displacement_components import Component
from amers.services.quality.findings import with_findings
from amers.services.quality.qualification import QualificationOptions, qualify
from amers.services.quality.sight_errors import slope_of_growth
from amers.services.types import Array
from tests.services.conftest import Make

GSD_M = 0.5
SIDE_PX = 2_000.0


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


def told(displacement_px: Array, line_sample: Array, height_m: Array) -> Array | None:
    """Pixels that a metre of height moves points, by measures with an error of a fifth of a pixel."""
    noise_px = np.random.default_rng(9).normal(0.0, 0.2, displacement_px.shape)
    return slope_of_growth(displacement_px + noise_px, line_sample, height_m, GSD_M)


@pytest.mark.parametrize(("slope_percent", "degrees"), [(10.0, 6.0), (4.0, 15.0), (-10.0, 6.0)])
def test_the_model_of_another_view_is_told_by_the_slope_of_a_hillside(
    slope_percent: float, degrees: float
) -> None:
    """An affine follows a hillside: the ground rises by some percent, and leans as it rises."""
    at = places(np.random.default_rng(1))
    height_m = hillside(at, slope_percent)
    slope_px = told(seen_otherwise(height_m, degrees), at, height_m)
    assert slope_px is not None
    assert np.hypot(*slope_px) == pytest.approx(np.tan(np.radians(degrees)) / GSD_M, rel=0.1)


@pytest.mark.parametrize("seed", range(10))
def test_drift_and_skew_of_an_own_model_are_not_accused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    at = places(rng)
    drift = rng.uniform(-0.002, 0.002, (2, 2))
    assert told(30.0 + at @ drift, at, hillside(at, 20.0, rng.uniform(0.0, 360.0))) is None


@pytest.mark.parametrize(
    "jacobian", [[[0.0, -0.02], [0.02, 0.0]], [[0.02, 0.0], [0.0, 0.02]], [[0.01, -0.02], [0.02, 0.01]]]
)
def test_an_image_that_is_turned_or_scaled_is_not_taken_for_another_view(
    jacobian: list[list[float]],
) -> None:
    """They grow as much across a slope as up it."""
    at = places(np.random.default_rng(2))
    assert told(at @ np.array(jacobian), at, hillside(at, 10.0)) is None


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
    assert told(seen_otherwise(plane_m, 6.0), at, height_m) is None
    assert told(seen_otherwise(height_m, 6.0), at, height_m) is not None


@pytest.mark.parametrize("drift", [0.006, 0.02])
def test_another_view_that_drifts_up_the_slope_too_is_another_view(drift: float) -> None:
    """Residuals then grow with the heights by less than would explain all of the correction."""
    at = places(np.random.default_rng(12))
    height_m = rough_hillside(at)
    up = np.array([np.cos(np.radians(30.0)), np.sin(np.radians(30.0))])
    along = np.array([np.cos(np.radians(80.0)), np.sin(np.radians(80.0))])
    moved_px = seen_otherwise(height_m, 6.0) + drift * np.outer(at @ up, along)
    assert told(moved_px, at, height_m) is not None


def test_hills_too_low_to_be_seen_in_the_residuals_refute_nothing() -> None:
    at = places(np.random.default_rng(11))
    design = np.column_stack([np.ones(len(at)), at])
    height_m = hillside(at, 10.0)
    plane_m = design @ np.linalg.lstsq(design, height_m, rcond=None)[0]
    low_m = plane_m + 0.1 * (height_m - plane_m)
    assert told(seen_otherwise(plane_m, 6.0), at, low_m) is not None


@pytest.mark.parametrize(("sigmas", "is_told"), [(1.9, False), (2.1, True)])
def test_a_growth_up_a_slope_is_told_where_it_exceeds_drift_by_two_standard_deviations(
    sigmas: float, is_told: bool
) -> None:
    """Errors that an affine does not follow leave the growth as it was put in."""
    rng, up = np.random.default_rng(11), np.array([0.8, 0.6])
    at = places(rng)
    design = np.column_stack([np.ones(len(at)), at])
    error_px = rng.normal(0.0, 0.2, (len(at), 2))
    error_px -= design @ np.linalg.lstsq(design, error_px, rcond=None)[0]
    of_gradient = np.linalg.inv(design.T @ design)[1:, 1:]
    sigma = np.sqrt((error_px**2).sum() / (len(at) - 3) * (up @ of_gradient @ up))
    growth = (0.006 + sigmas * sigma) * np.outer(at @ up, [0.6, -0.8])
    found = slope_of_growth(error_px + growth, at, 0.05 * at @ up, GSD_M)
    assert (found is not None) == is_told


def test_level_ground_explains_no_correction() -> None:
    """Its points differ by centimetres: no line of sight leans by as much as they would ask for."""
    rng = np.random.default_rng(3)
    at = places(rng)
    height_m = 50.0 + 1e-4 * GSD_M * at[:, 0] + rng.normal(0.0, 0.01, len(at))
    skew = at @ np.array([[0.0, 0.02], [0.0, 0.0]])
    assert told(skew, at, height_m) is None
    assert told(skew, at, np.full(len(at), 50.0)) is None


def test_a_few_points_close_together_say_too_little() -> None:
    """The same hillside and lean, seen in full and in a corner by six points of a pixel."""
    wide = SIDE_PX * np.array([[0.1, 0.1], [0.1, 0.9], [0.5, 0.4], [0.6, 0.7], [0.9, 0.2], [0.9, 0.8]])
    narrow = wide / 20.0
    noise_px = np.random.default_rng(4).normal(0.0, 1.0, (6, 2))
    for at, tells in ((wide, True), (narrow, False)):
        height_m = hillside(at, 10.0)
        displacement_px = seen_otherwise(height_m, 6.0) + noise_px
        assert (slope_of_growth(displacement_px, at, height_m, GSD_M) is not None) == tells


def test_the_slope_knows_no_axes_no_origin_and_no_datum() -> None:
    at = places(np.random.default_rng(6))
    height_m = hillside(at, 10.0)
    moved_px = seen_otherwise(height_m, 6.0) + np.random.default_rng(7).normal(0.0, 0.5, at.shape)
    slope_px = slope_of_growth(moved_px, at, height_m, GSD_M)
    assert slope_px is not None
    for other, expected in (
        (slope_of_growth(moved_px[:, ::-1], at[:, ::-1], height_m, GSD_M), slope_px[::-1]),
        (slope_of_growth(moved_px + 500.0, at - 300.0, height_m - 1_000.0, GSD_M), slope_px),
        (slope_of_growth(2.0 * moved_px, 2.0 * at, height_m, GSD_M / 2.0), 2.0 * slope_px),
    ):
        assert other is not None
        np.testing.assert_allclose(other, expected, rtol=1e-9)


@pytest.mark.parametrize(("relief_m", "verdict"), [(1.0, "good"), (60.0, "failed")])
def test_another_line_of_sight_harms_by_the_relief_that_no_plane_follows(
    registered: Make, relief_m: float, verdict: str
) -> None:
    """Points that were found lie on a plane, which the affine follows; some that were not lie beside."""
    scene = registered()
    measures = scene.measures
    at = scene.truth.apply(measures.predicted)
    height_m = 200.0 + 0.05 * at[:, 0] + 0.02 * at[:, 1]
    beside = np.isnan(measures.line_sample[:, 0])
    seen_m = height_m + np.where(beside, relief_m * (-1.0) ** np.arange(len(at)), 0.0)
    lon_lat_h = np.column_stack([measures.lon_lat_h[:, :2], seen_m])
    predicted = measures.line_sample - seen_otherwise(height_m, 6.0)
    seen = replace(scene, measures=replace(measures, predicted=predicted, lon_lat_h=lon_lat_h))
    (found,) = with_findings(seen.adjusted()).findings
    assert found.name == "line_of_sight"
    assert "6 degrees" in found.words
    assert "another view" in found.words
    harm_px = np.tan(np.radians(6.0)) / GSD_M * relief_m * np.sqrt(beside.mean())
    assert np.hypot(*found.harm_px) == pytest.approx(harm_px, rel=0.1)
    result = qualify(seen.adjusted(), QualificationOptions(), np.random.default_rng(3))
    assert result.verdict == verdict


def test_repeated_lines_on_a_hillside_are_no_other_view(registered: Make) -> None:
    """Sixty lines that are repeated in the middle displace what lies behind them up the slope."""
    scene = registered()
    measures = scene.measures
    at = measures.line_sample
    height_m = hillside(at, 10.0, towards_deg=0.0)
    lon_lat_h = np.column_stack([measures.lon_lat_h[:, :2], np.nan_to_num(height_m, nan=200.0)])
    middle = np.nanmedian(at[:, 0])
    behind = at[:, 0] > middle
    seen = replace(measures, predicted=at - 60.0 * behind[:, None] * [1.0, 0.0], lon_lat_h=lon_lat_h)
    followed = Component("break", 1.0, float(middle), np.full(2, 1e4))
    for components, accused in (((), True), ((followed,), False)):
        adjustment = replace(scene.adjustment, components=components)
        adjusted = replace(scene, measures=seen, adjustment=adjustment).adjusted()
        assert bool(with_findings(adjusted).findings) == accused
