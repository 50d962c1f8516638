"""Shadows that differ under another sun do not displace a chip."""

from dataclasses import replace
from functools import cache
from math import radians, tan

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from amers.services.matching.correlate import FOUND, CorrelationOptions, find_chip
from amers.services.matching.shadows import (
    CASTER_M,
    ShadowShift,
    shadow_shift,
    shadow_vector,
    shadow_weights,
)
from amers.services.types import Acquisition, Array, FloatImage
from tests.services.textures import texture

pytestmark = pytest.mark.long

SOUTH, WEST = 180.0, 270.0
JUNE = Acquisition("june", "", None, 5.0, 0.0, 63.0, SOUTH)
OCTOBER = replace(JUNE, sun_elevation_deg=38.0)
EVENING = replace(JUNE, sun_elevation_deg=38.0, sun_azimuth_deg=WEST)
GSD_M = 2.0
OPTIONS = CorrelationOptions(min_score=0.6)
SIDE, RADIUS_PX, FINER = 101, 6, 4

remaining_bias = 0.5
a_twentieth_of_a_pixel = 0.05


@cache
def village(seed: int, image: Acquisition) -> FloatImage:
    """Houses of 6 to 10 m on grass with the shadows of an acquisition, rendered on a finer grid."""
    rng = np.random.default_rng(seed)
    cells = (SIDE + 2 * RADIUS_PX) * FINER
    land = 0.5 + 0.08 * texture(rng, cells, 12.0)
    east, north = shadow_vector(image) * FINER / GSD_M
    lit = np.ones((cells, cells))
    houses = []
    for row, column in rng.integers(30, cells - 60, (60, 2)):
        height_m, depth, width = rng.uniform(6.0, 10.0), *rng.integers(16, 30, 2)
        houses.append((slice(row, row + depth), slice(column, column + width), rng.uniform(0.4, 0.8)))
        for share in np.linspace(0.0, 1.0, 40):
            down, right = round(-north * height_m * share), round(east * height_m * share)
            lit[row + down : row + down + depth, column + right : column + right + width] = 0.3
    seen = land * lit
    for rows, columns, albedo in houses:
        seen[rows, columns] = albedo
    smooth = gaussian_filter(seen, 0.4 * FINER)
    squares = smooth.reshape(cells // FINER, FINER, cells // FINER, FINER)
    return np.asarray(4095.0 * squares.mean(axis=(1, 3)), dtype=np.float32)


def bias_px(chip_of: Acquisition, patch_of: Acquisition, known: bool) -> Array:
    """Mean position (2,) of chips whose true position is zero."""
    shift = shadow_shift(chip_of, patch_of, GSD_M) if known else None
    inner = slice(RADIUS_PX, RADIUS_PX + SIDE)
    positions = []
    for seed in range(12):
        chip = np.ascontiguousarray(village(seed, chip_of)[inner, inner])
        peak = find_chip(village(seed, patch_of), chip, OPTIONS, shadows=shift)
        assert peak.reason == FOUND
        positions.append(peak.row_col)
    return np.asarray(np.mean(positions, axis=0))


@pytest.mark.parametrize(("chip_of", "patch_of", "sign"), [(JUNE, OCTOBER, -1), (OCTOBER, JUNE, 1)])
def test_shadow_weights_remove_most_of_the_bias_of_another_sun(
    chip_of: Acquisition, patch_of: Acquisition, sign: int
) -> None:
    ignored, corrected = (bias_px(chip_of, patch_of, known)[0] for known in (False, True))
    assert sign * ignored > a_twentieth_of_a_pixel
    assert abs(corrected) < remaining_bias * abs(ignored)


def test_gradients_that_no_sun_moves_keep_their_weight() -> None:
    chip = village(0, JUNE)
    away_from_a_southern_sun = chip[2:, 1:-1] < chip[:-2, 1:-1]
    weights = shadow_weights(chip, 0.9, shadow_shift(JUNE, OCTOBER, GSD_M))
    assert (weights[~away_from_a_southern_sun] == 1.0).all()
    assert weights[away_from_a_southern_sun].min() < 0.1


def test_under_the_same_sun_all_pixels_have_the_same_weight() -> None:
    assert (shadow_weights(village(0, JUNE), 0.9, shadow_shift(JUNE, JUNE, GSD_M)) == 1.0).all()


def test_the_shift_of_a_shadow_is_proportional_to_the_height_of_its_caster() -> None:
    shift = shadow_shift(JUNE, EVENING, GSD_M)
    assert shift is not None
    north = CASTER_M / tan(radians(63.0)) / GSD_M
    east = CASTER_M / tan(radians(38.0)) / GSD_M
    np.testing.assert_allclose(shift.shift_px, [north, east])
    np.testing.assert_allclose(shift.away / np.linalg.norm(shift.away), [-1.0, 0.0], atol=1e-12)


def test_an_unknown_sun_gives_no_shadow_shift() -> None:
    unknown = replace(JUNE, sun_elevation_deg=float("nan"))
    assert shadow_shift(unknown, OCTOBER, GSD_M) is None
    assert shadow_shift(JUNE, unknown, GSD_M) is None


@pytest.mark.parametrize("shift_px", [(0.3, 0.0), (1.2, -0.7), (2.5, 4.0)])
def test_the_noise_of_a_shadow_is_the_change_of_grey_values_under_its_shift(
    shift_px: tuple[float, float],
) -> None:
    """Of a plane, which a shift changes by the same amount everywhere; the other noise is white."""
    score, slope = 0.8, np.array([3.0, -2.0])
    rows, columns = np.indices((21, 21), dtype=np.float64)
    plane = slope[0] * rows + slope[1] * columns
    moved = slope[0] * (rows - shift_px[0]) + slope[1] * (columns - shift_px[1])
    of_shadows, of_all = (moved - plane)[0, 0] ** 2, (1.0 - score**2) * plane.var()
    shadows = ShadowShift(slope, np.array(shift_px))
    weights = shadow_weights(plane.astype(np.float32), score, shadows)
    np.testing.assert_allclose(weights, of_all / (of_all + of_shadows), rtol=1e-4)


def test_rows_and_columns_of_a_chip_are_alike_to_shadows() -> None:
    chip, shadows = village(1, JUNE), shadow_shift(JUNE, EVENING, GSD_M)
    assert shadows is not None
    swapped = ShadowShift(shadows.away[::-1].copy(), shadows.shift_px[::-1].copy())
    turned = shadow_weights(np.ascontiguousarray(chip.T), 0.9, swapped).T
    np.testing.assert_allclose(turned, shadow_weights(chip, 0.9, shadows), rtol=1e-4)


def test_finer_chips_show_shadows_that_move_by_as_many_metres() -> None:
    fine, coarse = (shadow_shift(JUNE, EVENING, gsd_m) for gsd_m in (0.5, 2.0))
    assert fine is not None
    assert coarse is not None
    np.testing.assert_allclose(fine.shift_px * 0.5, coarse.shift_px * 2.0)
