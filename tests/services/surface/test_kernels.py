"""Matching of rectified images with known disparities, and the kernels below it."""

import numpy as np
import pytest
from scipy.stats import sem

from amers.services.surface.fill import filled_gaps
from amers.services.surface.fuse import alignment_sums, fuse, roughness_m
from amers.services.surface.match import Reason, RectifiedPair, SemiGlobal
from amers.services.surface.semi_global import best_disparities, census, differences, matching_costs
from amers.services.types import FloatImage
from tests.services.textures import as_pixels, moved, texture

SIDE = 160
INSIDE = np.s_[20:-20, 20:-20]


def pair(disparity: float, side: int = SIDE) -> RectifiedPair:
    """A texture, and the same moved to the left by the disparity."""
    pixels = texture(np.random.default_rng(3), side, 1.0)
    seen = np.ones((side, side), dtype=np.bool_)
    return RectifiedPair(
        as_pixels(pixels), as_pixels(moved(pixels, 0.0, -disparity)), seen, seen.copy(), -4, 20
    )


@pytest.mark.parametrize("disparity", [0.0, 3.0, 5.25, 7.5, -1.75])
def test_a_known_disparity_is_found_between_steps_in_both_directions(disparity: float) -> None:
    found = SemiGlobal().match(pair(disparity))
    for direction in (found.first, found.second):
        assert np.isfinite(direction[INSIDE]).mean() > 0.99
        # Penalties draw disparities that are the same everywhere towards whole steps.
        assert abs(np.nanmedian(direction[INSIDE]) - disparity) < 0.25
        assert np.nanstd(direction[INSIDE]) < 0.15


def test_costs_are_least_at_the_disparity() -> None:
    images = pair(6.0)
    valid = (images.first_valid, images.second_valid)
    costs = matching_costs(census(images.first), census(images.second), valid, -4, 20)
    assert (costs[INSIDE].argmin(axis=-1) - 4 == 6).mean() > 0.95
    assert abs(np.nanmedian(best_disparities(costs.astype(np.uint16), -4)[INSIDE]) - 6.0) < 0.1


def test_directions_are_compared_between_pixels() -> None:
    first = np.full((3, 40), 5.5, dtype=np.float32)
    second = np.full((3, 40), 5.5, dtype=np.float32)
    assert np.nanmax(differences(first, second)) == 0.0
    second[:, 10] = 9.0
    assert np.nanmax(differences(first, second)) > 1.0
    assert np.isnan(differences(first, second)[:, :5]).all()  # their matches lie outside


def test_reasons_of_missing_disparities() -> None:
    images = pair(5.0)
    images.first[40:70, 40:70] = images.second[40:70, 35:65] = 500.0
    images.first_valid[100:110, 60:90] = False
    found = SemiGlobal().match(images)
    assert (found.reason[46:64, 46:64] == Reason.NO_TEXTURE).all()
    assert (found.reason[100:110, 60:90] == Reason.OUTSIDE).all()
    assert (np.isfinite(found.first) == (found.reason == Reason.FOUND)).all()


def test_two_equal_costs_meet_in_the_middle() -> None:
    sums = np.array([[[9, 4, 4, 9], [9, 9, 2, 9], [8, 4, 6, 9]]], dtype=np.uint16)
    between = best_disparities(sums, 0)[0]
    assert between[0] == pytest.approx(1.5)
    assert between[1] == pytest.approx(2.0)
    assert 1.0 < between[2] < 1.5


def fused_of(*values: float, sigma_m: tuple[float, ...] = (0.2, 0.2, 0.2)) -> tuple[float, float, int]:
    heights = np.array(values, dtype=np.float32)[:, None, None]
    pairs = np.array([[0, 1], [1, 2], [3, 4]])[: len(values)]
    fused = fuse(heights, np.array(sigma_m)[: len(values)], pairs)
    return float(fused.height_m[0, 0]), float(fused.sigma_m[0, 0]), int(fused.agree[0, 0])


def test_the_lowest_surface_that_two_pairs_see_is_taken() -> None:
    assert fused_of(10.0, 10.2, 25.0)[::2] == (pytest.approx(10.1), 2)
    assert fused_of(10.0, 25.0, 25.2)[::2] == (pytest.approx(25.1), 2)
    assert fused_of(10.0, 25.0, np.nan, sigma_m=(0.4, 0.2, 0.2))[::2] == (pytest.approx(25.0), 1)


@pytest.mark.parametrize("other", [[0, 2], [2, 0], [1, 2], [2, 1], [2, 3]])
def test_half_of_the_noise_of_pairs_is_that_of_the_image_they_share(other: list[int]) -> None:
    heights, pairs = np.full((2, 1, 1), 10.0, dtype=np.float32), np.array([[0, 1], other])
    found = fuse(heights, np.full(2, 0.2), pairs)
    images = len(set(pairs.ravel().tolist()))
    correlation = 0.5 if images == 3 else 0.0
    assert found.sigma_m[0, 0] == pytest.approx(0.2 * np.sqrt((1.0 + correlation) / 2.0))
    assert found.views[0, 0] == images


def test_pairs_that_see_something_else_widen_the_sigma() -> None:
    assert fused_of(10.0, 10.0, 20.0)[1] > 1.5 * fused_of(10.0, 10.0, np.nan)[1]


@pytest.mark.parametrize("apart_m", [(0.0, 0.6), (0.0, 0.5, 0.7), (-0.3, 0.0, 0.4, 0.1)])
def test_pairs_that_scatter_more_than_they_state_have_the_standard_error_of_their_mean(
    apart_m: tuple[float, ...],
) -> None:
    """No two of them share an image."""
    count = len(apart_m)
    heights = (50.0 + np.array(apart_m, dtype=np.float32))[:, None, None]
    pairs = np.arange(2 * count).reshape(count, 2)
    found = fuse(heights, np.full(count, 0.01), pairs)
    assert found.sigma_m[0, 0] == pytest.approx(sem(apart_m), rel=1e-4)
    assert found.height_m[0, 0] == pytest.approx(50.0 + np.mean(apart_m), abs=1e-4)
    assert (found.views[0, 0], found.agree[0, 0]) == (2 * count, count)


def test_a_plane_is_not_rough() -> None:
    rows, columns = np.indices((40, 40))
    plane = (300.0 + 0.3 * rows - 0.2 * columns).astype(np.float32)
    assert roughness_m(plane, 9)[8:-8, 8:-8].max() < 0.02
    step = np.where(columns < 20, 0.0, 8.0).astype(np.float32)
    assert (roughness_m(step, 9)[10:30, 18:22] > 1.0).all()


def test_sums_tell_the_shift_of_a_pair() -> None:
    rng = np.random.default_rng(1)
    rows, columns = np.indices((120, 120)).astype(np.float64)
    ground = 5.0 * np.sin(rows / 15.0) + 4.0 * np.sin(columns / 11.0)
    east, north, up = 0.3, -0.2, 0.25
    there = 5.0 * np.sin((rows + north) / 15.0) + 4.0 * np.sin((columns - east) / 11.0) + up
    heights = (there + rng.normal(0.0, 0.05, there.shape)).astype(np.float32)[None]
    normal, right, distances = alignment_sums(heights, ground.astype(np.float32), 1.0)
    shift = np.linalg.solve(normal[0], right[0])
    assert shift == pytest.approx([-east, -north, -up], abs=0.05)
    assert distances.sum() == 118 * 118


def gap(inside: FloatImage, reach: int = 5) -> tuple[FloatImage, FloatImage]:
    return filled_gaps(inside, np.full(inside.shape, 0.1, dtype=np.float32), reach)


def test_hidden_ground_is_filled_with_the_lower_side() -> None:
    heights = np.full((9, 12), 10.0, dtype=np.float32)
    heights[:, 8:] = 30.0
    heights[:, 5:8] = np.nan
    filled, sigma = gap(heights)
    assert (filled[2:-2, 5:8] == 10.0).all()
    assert (sigma[2:-2, 5:8] > 9.0).all()  # it may be the other side


def test_a_filled_cell_is_as_unsure_as_the_second_lowest_beside_it_and_half_their_range() -> None:
    heights = np.array([[7.0, 3.0, 5.0], [9.0, np.nan, 4.0], [8.0, 6.0, 2.0]], dtype=np.float32)
    sigmas = heights / np.float32(10.0)
    filled, sigma = filled_gaps(heights, sigmas, 2)
    assert filled[1, 1] == 3.0
    assert sigma[1, 1] == pytest.approx(np.hypot(0.3, (9.0 - 2.0) / 2.0))
    known = np.isfinite(heights)
    np.testing.assert_array_equal(filled[known], heights[known])
    np.testing.assert_array_equal(sigma[known], sigmas[known])
    heights[0] = heights[1, 0] = np.nan
    assert np.isnan(filled_gaps(heights, sigmas, 2)[0][1, 1])


def test_borders_are_not_moved_and_far_gaps_stay() -> None:
    heights = np.full((30, 30), np.nan, dtype=np.float32)
    heights[:, :10] = 5.0
    assert np.isnan(gap(heights)[0][:, 10:]).all()
    heights[:, 24:] = 5.0
    assert np.isnan(gap(heights)[0][:, 16:18]).all()
