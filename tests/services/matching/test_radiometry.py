"""Ground whose contrast has changed is found by its gradients; points under clouds are recognised."""

import numpy as np
import pytest

from amers.services.matching.correlate import FOUND, CorrelationOptions, find_chip
from amers.services.matching.radiometry import cloud_mask, gradient_image, patch_statistics
from amers.services.types import Array, FloatImage
from tests.services.textures import as_pixels, moved, texture

a_tenth_of_a_pixel = 0.1
RADIUS_PX, SIDE = 6, 101
BY_GREY, BY_GRADIENT = CorrelationOptions(min_score=0.6), CorrelationOptions(min_score=0.5)


def patch_and_chip(seed: int, shift: tuple[float, float]) -> tuple[FloatImage, FloatImage]:
    ground = texture(np.random.default_rng(seed), 128, 2.5)
    side = SIDE + 2 * RADIUS_PX
    heart = slice(RADIUS_PX, RADIUS_PX + SIDE)
    return as_pixels(moved(ground, *shift)[:side, :side]), as_pixels(ground[heart, heart])


def test_an_inverted_chip_is_found_by_its_gradients_and_not_by_its_grey_values() -> None:
    for seed in range(10):
        patch, chip = patch_and_chip(seed, (1.3, -2.6))
        inverted = np.float32(4095.0) - patch
        assert find_chip(inverted, chip, BY_GREY).reason == "low_score"
        peak = find_chip(gradient_image(inverted), gradient_image(chip), BY_GRADIENT)
        assert peak.reason == FOUND
        np.testing.assert_allclose(peak.row_col, [1.3, -2.6], atol=a_tenth_of_a_pixel)


def test_gradients_of_other_ground_are_not_accepted() -> None:
    accepted = 0
    for seed in range(100):
        patch, _ = patch_and_chip(seed, (0.0, 0.0))
        _, other = patch_and_chip(1000 + seed, (0.0, 0.0))
        accepted += find_chip(gradient_image(patch), gradient_image(other), BY_GRADIENT).reason == FOUND
    assert accepted == 0


def test_gradients_beside_nodata_are_missing() -> None:
    pixels, _ = patch_and_chip(1, (0.0, 0.0))
    pixels[10, 10] = np.nan
    missing = ~np.isfinite(gradient_image(pixels))
    assert set(zip(*np.nonzero(missing), strict=True)) == {(8, 9), (10, 9), (9, 8), (9, 10)}


def ground_and_clouds(rng: np.random.Generator) -> tuple[list[Array], dict[str, int]]:
    """Statistics around 40 points, with the rows of some that show clouds, water or a bright field."""
    statistics = [
        np.column_stack([rng.normal(600.0, 50.0, 100), rng.normal(30.0, 5.0, 100)]) for _ in range(40)
    ]
    kinds = {"cloud": 25, "part of a cloud": 26, "rim of a cloud": 27, "water": 30, "bright field": 31}
    statistics[25][:] = [2500.0, 6.0]
    statistics[26][:30] = [2500.0, 6.0]
    statistics[27][:5] = [2500.0, 6.0]
    statistics[30][:] = [150.0, 6.0]
    statistics[31][:] = [2500.0, 30.0]
    statistics[39][:] = np.nan
    statistics[3][:] = [2500.0, 6.0]
    return statistics, kinds


@pytest.mark.parametrize("saturated", [False, True])
def test_bright_and_smooth_surroundings_of_a_missing_point_are_a_cloud(saturated: bool) -> None:
    statistics, kinds = ground_and_clouds(np.random.default_rng(0))
    if saturated:
        statistics[kinds["cloud"]][:] = [np.inf, 0.0]
        # The brightest ground found may be saturated too, and says nothing about the rest.
        statistics[0][:2] = [np.inf, 0.0]
    hidden = cloud_mask(statistics, np.arange(40) < 20)
    assert list(np.flatnonzero(hidden)) == [kinds["cloud"], kinds["part of a cloud"]]


def test_no_cloud_is_reported_where_too_few_points_were_found() -> None:
    statistics, _ = ground_and_clouds(np.random.default_rng(0))
    assert not cloud_mask(statistics, np.arange(40) < 4).any()


def test_squares_have_the_statistics_of_their_valid_pixels() -> None:
    pixels = np.tile(np.array([[1.0, 3.0]], dtype=np.float32), (20, 22))
    pixels[15, 14:16] = pixels[2, 22:24] = np.nan
    pixels[3, 26:28] = np.inf
    pixels[10:16, 20:30] = np.nan
    pixels[10:16, 30:40] = np.inf
    statistics = patch_statistics(pixels)
    assert statistics.shape == (8, 2)
    np.testing.assert_allclose(statistics[:6], [[2.0, 2.0]] * 6)
    assert np.isnan(statistics[6]).all()
    assert list(statistics[7]) == [np.inf, 0.0]
