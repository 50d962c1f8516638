"""Heights of a block against a height model: the errors put in are found, and honesty is seen."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from amers.services.geodesy import metres_per_degree, move_metres
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.quality.accuracy import effective_number, sample_quantile
from amers.services.quality.block_heights import HeightModel, height_errors, height_quality
from amers.services.quality.normal_law import LINEAR_LE90
from amers.services.terrain import Terrain
from amers.services.types import Array, ControlPoints, Frame, SurfaceHeights
from tests.factories import control_points

a_millimetre = 1e-3
five_percent = 0.05
BOX = (5.0, 43.0, 7.0, 44.0)
STEP_DEG = 0.01


def sloping_terrain(rise: float = 0.0, box: tuple[float, float, float, float] = BOX) -> Terrain:
    """Ground that rises by `rise` metres a metre to the east, from 100 m at the western edge."""
    west, south, east, north = box
    samples, lines = round((east - west) / STEP_DEG) + 21, round((north - south) / STEP_DEG) + 21
    grid = MapGrid(
        "EPSG:4326",
        np.array([west - 10 * STEP_DEG, north + 10 * STEP_DEG]),
        np.array([[0.0, STEP_DEG], [-STEP_DEG, 0.0]]),
        (lines, samples),
    )
    metres_east = (np.arange(samples) - 10) * STEP_DEG * metres_per_degree((south + north) / 2.0, 0.0)[0]
    heights = np.tile(100.0 + rise * metres_east, (lines, 1)).astype(np.float32)
    return Terrain(grid, ArrayImage(heights))


def true_points(terrain: Terrain, count: int, frame: Frame) -> ControlPoints:
    """Points on the ground, with random covariances."""
    points = control_points(count, np.random.default_rng(11), BOX)
    lon_lat_h = points.lon_lat_h.copy()
    lon_lat_h[:, 2] = terrain.height_m(lon_lat_h)
    return replace(points, lon_lat_h=lon_lat_h, frames=(frame,))


def with_errors(points: ControlPoints, rng: np.random.Generator, scale: float = 1.0) -> ControlPoints:
    """Points with errors drawn from their covariances, times a scale."""
    factor = np.linalg.cholesky(points.covariance_m2)
    error = scale * (factor @ rng.normal(size=(len(points), 3, 1)))[:, :, 0]
    return replace(points, lon_lat_h=move_metres(points.lon_lat_h, error))


@pytest.mark.parametrize("rise", [0.0, 0.3])
def test_honest_points_are_found_honest_on_flat_and_on_steep_ground(rise):
    rng, sigma_m = np.random.default_rng(12), 0.5
    terrain = sloping_terrain(rise)
    points = with_errors(true_points(terrain, 4000, Frame.from_sigmas(1.0, 2.0)), rng)
    points.lon_lat_h[:, 2] += rng.normal(0.0, sigma_m, len(points))
    model = HeightModel(replace(terrain, sigmas=sigma_m))
    quality = height_quality(height_errors(points, model), points, model, "a slope")
    assert quality.normalised.lower < quality.normalised.mean_square < quality.normalised.upper
    assert_allclose(quality.typical_ratio, 1.0, atol=five_percent)
    assert_allclose(quality.relative.le90_m.value, quality.declared_le90_m, rtol=2 * five_percent)
    too_good = replace(points, covariance_m2=points.covariance_m2 / 9.0)
    found = height_quality(height_errors(too_good, model), too_good, model, "a slope")
    assert found.normalised.mean_square > found.normalised.upper


def test_the_variance_of_a_height_is_that_of_the_way_from_the_slope_to_the_point() -> None:
    """A point goes east and up by one error: what it rises beside the slope is what counts."""
    rise, sigma_m = 0.4, 0.2
    terrain = sloping_terrain(rise)
    points = true_points(terrain, 50, Frame.from_sigmas(1.0, 2.0))
    root = np.random.default_rng(15).normal(size=(50, 3, 3))
    points = replace(points, covariance_m2=root @ root.transpose(0, 2, 1))
    errors = height_errors(points, HeightModel(replace(terrain, sigmas=sigma_m)))
    assert_allclose(terrain.slope(points.lon_lat_h)[:, 0], rise, rtol=0.01)
    off = np.column_stack([-terrain.slope(points.lon_lat_h), np.ones(50)])
    beside = (root.transpose(0, 2, 1) @ off[:, :, None])[:, :, 0]
    assert_allclose(errors.variance_m2, (beside**2).sum(axis=1) + sigma_m**2, rtol=1e-9)


def test_bias_spread_and_le90_put_in_are_found_and_the_frame_is_judged_by_its_own_sigma():
    rng = np.random.default_rng(13)
    terrain = sloping_terrain()
    points = true_points(terrain, 5000, Frame.from_sigmas(1.0, 2.0))
    error_m = rng.normal(0.0, 0.8, len(points))
    points.lon_lat_h[:, 2] += 1.5 + error_m
    model = HeightModel(replace(terrain, sigmas=0.8))
    quality = height_quality(height_errors(points, model), points, model, "flat")
    on_earth, relative = quality.on_the_earth, quality.relative
    assert_allclose([on_earth.bias_m, on_earth.median_m], 1.5, atol=five_percent)
    assert_allclose([on_earth.nmad_m, on_earth.std_m], 0.8, rtol=five_percent)
    assert_allclose(relative.le90_m.value, LINEAR_LE90 * 0.8, rtol=five_percent)
    true_le90_m = np.quantile(np.abs(1.5 + 0.8 * rng.normal(size=1_000_000)), 0.9)
    assert on_earth.le90_m.lower < true_le90_m < on_earth.le90_m.upper
    assert_allclose(quality.normalised_frame.mean_square, (1.5 / 2.0) ** 2, rtol=2 * five_percent)
    vague = replace(model, frame_sigma_m=1.5)
    of_both = height_quality(height_errors(points, vague), points, vague, "flat").normalised_frame
    assert_allclose(of_both.mean_square, 1.5**2 / (2.0**2 + 1.5**2), rtol=2 * five_percent)
    unknown = replace(points, frames=(Frame.from_sigmas(1.0, np.nan),))
    assert height_quality(height_errors(unknown, model), unknown, model, "f").normalised_frame.n == 0


def test_a_degree_cell_and_a_land_cover_with_larger_errors_are_told_apart():
    rng = np.random.default_rng(14)
    terrain = sloping_terrain()
    points = true_points(terrain, 2000, Frame.from_sigmas(1.0, 2.0))
    east = points.lon_lat_h[:, 0] >= 6.0
    points.lon_lat_h[:, 2] += np.where(east, 4.0, 0.0) + rng.normal(0.0, 0.5, len(points))
    model = HeightModel(replace(terrain, sigmas=0.5))
    errors = height_errors(points, model)
    cover = ["forest" if lon >= 6.0 else "fields" for lon in errors.lon_lat[:, 0].tolist()]
    quality = height_quality(errors, points, model, "flat", cover)
    west, eastern = quality.cells
    assert (west.west, eastern.west, west.south) == (5.0, 6.0, 43.0)
    assert west.accuracy.n + eastern.accuracy.n == 2000
    assert_allclose([west.accuracy.bias_m, eastern.accuracy.bias_m], [0.0, 4.0], atol=five_percent)
    assert [kind.name for kind in quality.land_cover] == ["fields", "forest"]
    assert_allclose(quality.land_cover[1].accuracy.median_m, 4.0, atol=five_percent)
    # Two cells, each with an error of its own, are worth a few points: nothing bounds LE90 from above.
    assert np.isnan(quality.on_the_earth.le90_m.upper)


def test_where_a_block_states_surfaces_they_are_compared_and_its_points_told_apart():
    terrain = sloping_terrain()
    points = true_points(terrain, 300, Frame.from_sigmas(1.0, 2.0))
    points.lon_lat_h[:, 2] += 7.0
    stated = np.arange(300) % 3 == 0
    surface_m = np.where(stated, 100.25, np.nan)
    points = replace(points, surface=SurfaceHeights(surface_m, np.where(stated, 0.3, np.nan)))
    model = HeightModel(replace(terrain, sigmas=0.4))
    errors = height_errors(points, model)
    assert (errors.compared, errors.unstated, len(errors.row)) == ("surface", 200, 100)
    assert_allclose(errors.error_m, 0.25, atol=a_millimetre)
    assert_allclose(errors.variance_m2, 0.3**2 + 0.4**2, atol=a_millimetre)
    quality = height_quality(errors, points, model, "flat")
    assert quality.point_heights is not None
    assert_allclose(quality.point_heights.median_m, 7.0, atol=a_millimetre)
    nowhere = replace(points, surface=SurfaceHeights(np.full(300, np.nan), np.full(300, np.nan)))
    assert height_errors(nowhere, model).compared == "point"


def test_excluded_ground_and_ground_without_heights_are_counted_apart():
    terrain = sloping_terrain(box=(5.0, 43.0, 6.5, 44.0))
    points = true_points(sloping_terrain(), 1000, Frame.from_sigmas(1.0, 2.0))

    def town(lon_lat: Array) -> np.ndarray:
        return lon_lat[:, 1] > 43.5

    errors = height_errors(points, HeightModel(replace(terrain, sigmas=0.5), excluded=town))
    beyond = (points.lon_lat_h[:, 0] > 6.61) & (points.lon_lat_h[:, 1] <= 43.5)
    assert errors.excluded == (points.lon_lat_h[:, 1] > 43.5).sum()
    assert errors.outside >= beyond.sum() > 0
    assert len(errors.row) + errors.excluded + errors.outside == 1000


def test_no_height_at_all_gives_no_figures_and_no_error():
    far = sloping_terrain(box=(50.0, 43.0, 50.5, 43.5))
    points = true_points(sloping_terrain(), 20, Frame.from_sigmas(1.0, 2.0))
    model = HeightModel(replace(far, sigmas=0.5))
    quality = height_quality(height_errors(points, model), points, model, "elsewhere")
    assert (quality.outside, quality.on_the_earth.n, quality.cells) == (20, 0, ())
    assert np.isnan(quality.on_the_earth.le90_m.value)


def test_intervals_of_errors_that_groups_share_hold_the_truth():
    """Of 300 campaigns of 40 sites with 50 places each, the interval holds the true quantile in 85 %."""
    rng = np.random.default_rng(15)
    site = np.repeat(np.arange(40), 50)
    true = np.quantile(np.hypot(*rng.normal(0.0, np.hypot(1.0, 0.5), (2, 2_000_000))), 0.9)
    held, plain = 0, 0
    for _ in range(300):
        error = rng.normal(0.0, 1.0, (40, 2))[site] + rng.normal(0.0, 0.5, (2000, 2))
        distance = np.hypot(*error.T)
        interval = sample_quantile(distance, effective_number(error, site))
        held += interval.lower <= true and not interval.upper < true
        independent = sample_quantile(distance)
        plain += independent.lower <= true <= independent.upper
    assert held >= 0.85 * 300
    assert plain < 0.6 * 300


def test_groups_that_share_all_of_their_errors_are_worth_what_their_mean_varies_by():
    """Of unequal groups, the largest makes most of the variance of the mean."""
    group = np.repeat(np.arange(31), [90] + [1] * 30)
    error = np.random.default_rng(3).normal(0.0, 1.0, (31, 1))[group]
    share_of_mean = np.bincount(group) / len(group)
    assert effective_number(error, group) == pytest.approx(1.0 / (share_of_mean**2).sum(), rel=1e-9)


def test_independent_errors_are_worth_their_number():
    rng = np.random.default_rng(16)
    worth = [effective_number(rng.normal(size=(500, 1)), np.arange(500) % 10) for _ in range(50)]
    assert 350.0 < np.mean(worth) <= 500.0
    assert effective_number(rng.normal(size=(7, 2)), np.zeros(7, dtype=np.int64)) == 7.0
