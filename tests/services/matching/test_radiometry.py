"""Ground whose contrast has changed is found by its edges; what clouds hide is said to be hidden."""

import numpy as np
import pytest

from services.matching.correlate import FOUND, CorrelationOptions, find_chip
from services.matching.radiometry import brightness_and_roughness, clouded, edges
from services.types import FloatImage
from tests.services.textures import as_pixels, moved, texture

a_tenth_of_a_pixel = 0.1
RADIUS_PX, SIDE = 6, 101
BY_GREY, BY_EDGES = CorrelationOptions(min_score=0.6), CorrelationOptions(min_score=0.5)


def patch_and_chip(seed: int, shift: tuple[float, float]) -> tuple[FloatImage, FloatImage]:
    ground = texture(np.random.default_rng(seed), 128, 2.5)
    side = SIDE + 2 * RADIUS_PX
    heart = slice(RADIUS_PX, RADIUS_PX + SIDE)
    return as_pixels(moved(ground, *shift)[:side, :side]), as_pixels(ground[heart, heart])


def test_what_is_inverted_is_found_by_its_edges_and_not_by_its_grey_values() -> None:
    for seed in range(10):
        patch, chip = patch_and_chip(seed, (1.3, -2.6))
        inverted = np.float32(4095.0) - patch
        assert find_chip(inverted, chip, BY_GREY).reason == "low_score"
        peak = find_chip(edges(inverted), edges(chip), BY_EDGES)
        assert peak.reason == FOUND
        np.testing.assert_allclose(peak.row_col, [1.3, -2.6], atol=a_tenth_of_a_pixel)


def test_edges_of_other_ground_are_not_believed() -> None:
    believed = 0
    for seed in range(100):
        patch, _ = patch_and_chip(seed, (0.0, 0.0))
        _, other = patch_and_chip(1000 + seed, (0.0, 0.0))
        believed += find_chip(edges(patch), edges(other), BY_EDGES).reason == FOUND
    assert believed == 0


def test_edges_beside_nodata_are_unknown() -> None:
    pixels, _ = patch_and_chip(1, (0.0, 0.0))
    pixels[10, 10] = np.nan
    unknown = ~np.isfinite(edges(pixels))
    assert set(zip(*np.nonzero(unknown), strict=True)) == {(8, 9), (10, 9), (9, 8), (9, 10)}


def test_a_cloud_is_bright_and_smooth_and_was_not_found() -> None:
    rng = np.random.default_rng(0)
    found = np.arange(40) < 20
    looks = np.column_stack([rng.normal(600.0, 50.0, 40), rng.normal(30.0, 3.0, 40)])
    cloud, water, field = [25, 26, 27], [30, 31], [35]
    looks[cloud] = [2500.0, 6.0]
    looks[water] = [150.0, 6.0]
    looks[field] = [2500.0, 30.0]
    looks[39] = np.nan
    looks[3] = [2500.0, 6.0]
    assert list(np.flatnonzero(clouded(looks, found))) == cloud
    few = np.arange(40) < 4
    assert not clouded(looks, few).any()


def test_brightness_and_roughness_leave_out_what_is_not_seen() -> None:
    pixels = np.full((5, 5), np.nan, dtype=np.float32)
    assert np.isnan(brightness_and_roughness(pixels)).all()
    pixels[:, :3] = [[1.0, 3.0, 5.0]]
    assert brightness_and_roughness(pixels) == pytest.approx((3.0, 2.0))
