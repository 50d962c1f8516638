"""Where a scene ends beside a point, the central square of its chip is searched."""

import numpy as np
import pytest

from services.matching.chip_extent import central_square, visible_half_side
from services.matching.correlate import FOUND, CorrelationOptions, find_chip
from services.types import FloatImage
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


@pytest.mark.parametrize("missing", [1, 10, 25])
def test_a_gap_on_one_side_reduces_the_chip_on_all_sides(missing: int) -> None:
    assert visible_half_side(patch_without(missing), HALF, RADIUS_PX) == HALF - missing


@pytest.mark.parametrize("missing", [26, 56, SIDE])
def test_a_chip_is_not_reduced_to_less_than_half(missing: int) -> None:
    assert visible_half_side(patch_without(missing), HALF, RADIUS_PX) == HALF


def test_the_nearest_missing_pixel_limits_the_visible_square() -> None:
    patch = patch_without(0)
    patch[SIDE // 2 + 40, SIDE // 2 - 3] = np.nan
    assert visible_half_side(patch, HALF, RADIUS_PX) == 39 - RADIUS_PX


def test_the_central_square_of_a_chip_is_found_where_the_whole_chip_would_be() -> None:
    ground = texture(np.random.default_rng(5), 128, 1.5)
    shift = 1.3, -2.4
    chip = as_pixels(ground[RADIUS_PX : RADIUS_PX + 2 * HALF + 1, RADIUS_PX : RADIUS_PX + 2 * HALF + 1])
    patch = as_pixels(moved(ground, *shift)[:SIDE, :SIDE])
    patch[:, :17] = np.nan
    half = visible_half_side(patch, HALF, RADIUS_PX)
    peak = find_chip(
        central_square(patch, half + RADIUS_PX), central_square(chip, half), CorrelationOptions()
    )
    assert peak.reason == FOUND
    np.testing.assert_allclose(peak.row_col, shift, atol=a_twentieth_of_a_pixel)
    assert find_chip(patch, chip, CorrelationOptions()).reason == "nodata"
