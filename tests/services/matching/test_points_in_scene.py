"""Control points are found where a scene shows them, each in its own row, with honest sigmas."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window
from amers.services.matching.control_points import (
    ChipSearch,
    MatchingOptions,
    PointMatches,
    match_points,
    with_matches,
)
from amers.services.matching.correlate import FOUND
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Array, ChipArray, ControlPoints
from tests.services.registration.small_ground import GSD_M, points_at, scene
from tests.services.simulated import MemoryChips, views_of_points

SIDE = 400
FIRST = (1024 - SIDE) // 2
OFF_M = np.array([7.3, -4.1])
"""East and north of where the model expects them the scene shows the points, metres."""
AXIS = FIRST + np.linspace(70.0, 330.0, 5)
GRID = np.stack(np.meshgrid(AXIS, AXIS, indexing="ij"), -1).reshape(-1, 2)
a_tenth_of_a_pixel = 0.1


def matched(
    of: Scene,
    points: ControlPoints,
    chips: MemoryChips,
    radius_px: int = 8,
    gsd_m: float = GSD_M,
) -> PointMatches:
    search = ChipSearch(of.image, of.model, of.acquisition, gsd_m, radius_px)
    return match_points(search, points, chips, MatchingOptions())


def shown_at(row_col: Array) -> Array:
    """Where the scene really shows pixels of the ground."""
    return np.asarray(row_col - FIRST, dtype=np.float64)


def test_points_are_found_where_the_scene_shows_them() -> None:
    points, chips = points_at(GRID)
    of = scene(OFF_M, 10.0)
    matches = matched(of, points, chips)
    assert (matches.reason == FOUND).all()
    np.testing.assert_allclose(matches.line_sample, shown_at(GRID), atol=a_tenth_of_a_pixel)
    np.testing.assert_allclose(matches.displacement_m, np.tile(OFF_M, (25, 1)), atol=0.2)
    expected = of.model.project(points.lon_lat_h)
    moved_m = (matches.line_sample - expected)[:, ::-1] * [GSD_M, -GSD_M]
    np.testing.assert_allclose(matches.displacement_m, moved_m, rtol=2e-3)
    assert (matches.score > 0.7).all()
    assert (matches.views == 1).all()
    assert not matches.by_gradient.any()


@pytest.mark.parametrize("noise", [60.0, 120.0])
def test_the_stated_sigma_is_that_of_the_positions(noise: float) -> None:
    points, chips = points_at(GRID)
    of, squares = scene(OFF_M, 10.0), []
    for seed in range(4):
        added = np.random.default_rng(seed).normal(0.0, noise, (SIDE, SIDE)).astype(np.float32)
        noisy = replace(of, image=ArrayImage(of.image.read(Window(0, 0, SIDE, SIDE)) + added))
        matches = matched(noisy, points, chips)
        found = matches.reason == FOUND
        error_px = matches.line_sample[found] - shown_at(GRID)[found]
        squares.append(np.square(error_px / matches.sigma_px[found, None]))
    assert 0.6 < np.concatenate(squares).mean() < 1.6


@pytest.mark.parametrize("factor", [2, 3])
def test_a_coarser_scene_has_positions_and_sigmas_in_its_own_pixels(factor: int) -> None:
    points, chips = points_at(GRID)
    fine = scene(OFF_M, 10.0, 402, 402)
    means = fine.image.read(Window(0, 0, 402, 402)).reshape(402 // factor, factor, -1, factor)
    grid = fine.model.grid  # type: ignore[attr-defined]
    origin = grid.origin_xy + grid.step_xy @ np.full(2, (factor - 1) / 2.0)
    shape = (402 // factor, 402 // factor)
    model = OrthoModel(replace(grid, origin_xy=origin, step_xy=factor * grid.step_xy, shape=shape))
    coarse = replace(fine, image=ArrayImage(means.mean(axis=(1, 3))), model=model)
    of_fine, of_coarse = matched(fine, points, chips), matched(coarse, points, chips)
    assert (of_coarse.reason == FOUND).all()
    expected = (shown_at(GRID) + 1.0 - (factor - 1) / 2.0) / factor
    np.testing.assert_allclose(of_coarse.line_sample, expected, atol=a_tenth_of_a_pixel)
    np.testing.assert_allclose(of_coarse.displacement_m, of_fine.displacement_m, atol=0.2)
    ratio = np.median(of_coarse.sigma_px * factor / of_fine.sigma_px)
    assert 0.5 < ratio < 3.0


def test_matches_are_in_the_rows_of_their_points() -> None:
    """Points of several tiles of the image, in another order, some of which have no chip there."""
    points, chips = points_at(GRID)
    order = np.random.default_rng(2).permutation(25)
    other = points.take(order)
    of = scene(OFF_M, 10.0)
    plain, drawn = matched(of, points, chips), matched(of, other, chips)
    np.testing.assert_array_equal(drawn.line_sample, plain.line_sample[order])
    np.testing.assert_array_equal(drawn.sigma_px, plain.sigma_px[order])
    np.testing.assert_array_equal(drawn.view_measures.point, np.arange(25))
    np.testing.assert_array_equal(drawn.view_measures.score, plain.view_measures.score[order])
    assert (matched(of, points, chips, gsd_m=3.0 * GSD_M).reason == "no_chip").all()


def test_points_beyond_the_scene_and_in_what_it_lost_have_their_reasons() -> None:
    beside = np.array([[FIRST - 200.0, 500.0], [512.0, 512.0], [FIRST + 90.0, FIRST + 90.0]])
    points, chips = points_at(beside)
    of = scene(OFF_M, 10.0)
    pixels = of.image.read(Window(0, 0, SIDE, SIDE))
    pixels[20:170, 20:170] = np.inf
    matches = matched(replace(of, image=ArrayImage(pixels)), points, chips)
    assert matches.reason.tolist() == ["nodata", FOUND, "saturated"]
    np.testing.assert_array_equal(np.isfinite(matches.line_sample).all(axis=1), [False, True, False])


def test_an_image_of_the_other_contrast_is_matched_by_its_gradients() -> None:
    points, chips = points_at(GRID[:5])
    of = scene(OFF_M, 10.0)
    negative = ArrayImage(1000.0 - of.image.read(Window(0, 0, SIDE, SIDE)))
    matches = matched(replace(of, image=negative), points, chips)
    assert matches.by_gradient.all()
    assert (matches.reason == FOUND).all()
    np.testing.assert_allclose(matches.line_sample, shown_at(GRID[:5]), atol=0.2)


def several_views() -> tuple[ControlPoints, MemoryChips]:
    """Points of three chips each: the first and the last show the point, that between other ground."""
    points, chips = points_at(GRID)
    n, rng = len(points), np.random.default_rng(7)
    noise = rng.normal(0.0, 30.0, (2, *chips.chips.shape))
    shown = [np.maximum(chips.chips + one, 1.0).astype(np.uint16) for one in noise]
    stacked = np.stack([shown[0], np.roll(chips.chips, 3, axis=0), shown[1]], axis=1)
    views = views_of_points(n, [GSD_M] * 3, [9.0, 3.0, 6.0])
    rows: ChipArray = stacked.reshape(-1, *stacked.shape[2:])
    return replace(points, views=views, chip_row=3 * np.arange(n)), MemoryChips(rows)


def test_of_several_views_those_that_agree_count() -> None:
    points, chips = several_views()
    of = scene(OFF_M, 10.0)
    of = replace(of, acquisition=replace(of.acquisition, incidence_deg=0.0, azimuth_deg=0.0))
    matches = matched(of, points, chips)
    assert (matches.reason == FOUND).all()
    assert (matches.views == 2).all()
    np.testing.assert_allclose(matches.line_sample, shown_at(GRID), atol=a_tenth_of_a_pixel)
    tried = matches.view_measures
    np.testing.assert_array_equal(tried.point, np.repeat(np.arange(25), 3))
    np.testing.assert_array_equal(tried.view, np.tile([0, 1, 2], 25))
    np.testing.assert_array_equal(tried.agreed, np.tile([True, False, True], 25))
    np.testing.assert_array_equal(tried.reason == FOUND, tried.agreed)
    of_points = tried.score.reshape(25, 3)
    np.testing.assert_allclose(matches.score, of_points.max(axis=1))
    assert (of_points[:, [0, 2]].min(axis=1) > of_points[:, 1]).all()


def common_px(off_px: float) -> float:
    """What all measures share by two images, of which the second shows all points so far off."""
    points, chips = points_at(GRID)
    _, displaced = points_at(GRID + [0.0, off_px])
    n = len(points)
    stacked = np.stack([chips.chips, displaced.chips], axis=1)
    images = (points.views.images[0], replace(points.views.images[0], image_id="second"))
    views = views_of_points(n, [GSD_M] * 2, image=[0, 1], images=images)
    both = replace(points, views=views, chip_row=2 * np.arange(n))
    of = scene(OFF_M, 10.0)
    of = replace(of, acquisition=replace(of.acquisition, incidence_deg=0.0, azimuth_deg=0.0))
    two = MemoryChips(stacked.reshape(-1, *stacked.shape[2:]))
    covariance_m2 = matched(of, both, two).common_covariance_m2
    np.testing.assert_allclose(covariance_m2, covariance_m2[0, 0] * np.eye(2), atol=1e-9)
    return float(np.sqrt(covariance_m2[0, 0])) / GSD_M


def test_all_measures_share_what_their_images_are_off_by() -> None:
    """A twentieth of a chip pixel at least, and more where two images differ from their mean."""
    assert 0.05 < common_px(0.0) < 0.15
    assert 0.6 * 0.3 < common_px(0.6) < 1.6 * 0.3


def test_progress_grows_from_nothing_to_less_than_all() -> None:
    told = list[float]()

    def progress(fraction: float, message: str) -> None:
        told.append(fraction)
        assert "searching 100 points with chips of 2 m" in message

    points, chips = points_at(np.repeat(GRID[:1], 100, axis=0))
    of = scene(OFF_M, 10.0)
    search = ChipSearch(of.image, of.model, of.acquisition, GSD_M, 4)
    match_points(search, points, chips, MatchingOptions(), progress)
    np.testing.assert_allclose(told, [0.0, 0.64])


def test_points_that_are_searched_again_replace_those_that_are_found_then() -> None:
    """Half of them lie beyond the first search; of four that are searched again one is not found."""
    points, chips = several_views()
    of = scene(OFF_M, 10.0)
    rows = np.array([2, 3, 11, 20])
    near = matched(of, points, chips, radius_px=2)
    assert (near.reason != FOUND).all()
    again_points = points.take(rows)
    beside = again_points.lon_lat_h + np.array([[0.0] * 3, [0.0] * 3, [0.1, 0.0, 0.0], [0.0] * 3])
    again = matched(of, replace(again_points, lon_lat_h=beside), chips)
    assert (again.reason == FOUND).tolist() == [True, True, False, True]
    both = with_matches(near, rows, again)
    replaced = np.isin(np.arange(25), [2, 3, 20])
    np.testing.assert_array_equal(both.reason == FOUND, replaced)
    np.testing.assert_array_equal(both.line_sample[[2, 3, 20]], again.line_sample[[0, 1, 3]])
    np.testing.assert_array_equal(both.displacement_m[[2, 3, 20]], again.displacement_m[[0, 1, 3]])
    np.testing.assert_array_equal(both.sigma_px[[2, 3, 20]], again.sigma_px[[0, 1, 3]])
    np.testing.assert_array_equal(both.views, np.where(replaced, 2, 0))
    assert both.reason[11] == near.reason[11]
    np.testing.assert_array_equal(both.score[~replaced], near.score[~replaced])
    views = both.view_measures
    np.testing.assert_array_equal(views.point, np.repeat(np.arange(25), 3))
    np.testing.assert_array_equal(views.view, np.tile([0, 1, 2], 25))
    np.testing.assert_array_equal(
        views.agreed, np.repeat(replaced, 3) & np.tile([True, False, True], 25)
    )
    assert not (near.reason == FOUND).any(), "the first search stays as it was"
