"""Where a scene ends beside a point, the central square of its chip is searched."""

import numpy as np
import pytest

from amers.services.matching.chip_extent import MAX_OFF_CENTRE_PX, central_square, visible_half_side
from amers.services.matching.correlate import FOUND, CorrelationOptions, find_chip
from amers.services.types import FloatImage
from tests.services.textures import as_pixels, moved, texture

pytestmark = pytest.mark.long

HALF, RADIUS_PX = 50, 6
SIDE = 2 * (HALF + RADIUS_PX) + 1
a_twentieth_of_a_pixel = 0.05


def patch_without(columns: int) -> FloatImage:
    patch = np.ones((SIDE, SIDE), dtype=np.float32)
    patch[:, :columns] = np.nan
    return patch


def test_a_patch_without_gaps_shows_the_whole_chip() -> None:
    assert visible_half_side(patch_without(0), HALF, RADIUS_PX) == HALF


@pytest.mark.parametrize("missing", [10, 20, 25])
def test_a_gap_on_one_side_reduces_the_chip_on_all_sides(missing: int) -> None:
    half = visible_half_side(patch_without(missing), HALF, RADIUS_PX)
    beyond = half + RADIUS_PX - (SIDE // 2 - missing)
    # A gap of k columns on one side moves the centre of the others by k / 2.
    assert beyond / 2.0 <= MAX_OFF_CENTRE_PX < (beyond + 1) / 2.0


@pytest.mark.parametrize("missing", [30, 56, SIDE])
def test_a_chip_that_is_not_seen_around_its_point_is_not_searched(missing: int) -> None:
    assert visible_half_side(patch_without(missing), HALF, RADIUS_PX) == 0


def test_isolated_missing_pixels_do_not_reduce_a_chip() -> None:
    patch = patch_without(0)
    scattered = np.random.default_rng(0).random(patch.shape) < 0.05
    patch[scattered] = np.inf
    assert visible_half_side(patch, HALF, RADIUS_PX) == HALF


def test_gaps_on_opposite_sides_do_not_reduce_a_chip() -> None:
    patch = patch_without(20)
    patch[:, -20:] = np.nan
    assert visible_half_side(patch, HALF, RADIUS_PX) == HALF


def test_the_central_square_of_a_chip_is_found_where_the_whole_chip_would_be() -> None:
    ground = texture(np.random.default_rng(5), 128, 1.5)
    shift = 1.3, -2.4
    chip = as_pixels(ground[RADIUS_PX : RADIUS_PX + 2 * HALF + 1, RADIUS_PX : RADIUS_PX + 2 * HALF + 1])
    patch = as_pixels(moved(ground, *shift)[:SIDE, :SIDE])
    patch[:, :17] = np.nan
    half = visible_half_side(patch, HALF, RADIUS_PX)
    assert half < HALF
    peak = find_chip(
        central_square(patch, half + RADIUS_PX), central_square(chip, half), CorrelationOptions()
    )
    assert peak.reason == FOUND
    np.testing.assert_allclose(peak.row_col, shift, atol=a_twentieth_of_a_pixel)
