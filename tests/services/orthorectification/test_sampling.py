"""Values of an image at positions: exact for a plane, and the same however the positions are divided."""

from itertools import product

import numpy as np
import pytest

from amers.services.imagery.source import ArrayImage
from amers.services.orthorectification.sampling import drop_outside, sampled
from amers.services.types import Array, FloatImage

LINES, SAMPLES = 150, 160
ROUNDING = 2e-3
"""Of pixels around 500 with 24 bits."""


def positions(ratio: float, count: int = 14) -> Array:
    """Positions `ratio` pixels apart, on rows that are turned by some degrees, inside the image."""
    turn = np.deg2rad(11.0)
    axes = ratio * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    index = np.stack(np.meshgrid(*[np.arange(count) - count / 2.0] * 2, indexing="ij"), axis=-1)
    return index @ axes + (LINES / 2.0 + 0.3, SAMPLES / 2.0 + 0.2)


def values(pixels: FloatImage, line_sample: Array, ratio: float, cubic: bool) -> FloatImage:
    first = np.floor(line_sample.min(axis=(0, 1))).astype(np.int64)
    size = np.ceil(line_sample.max(axis=(0, 1))).astype(np.int64) - first + 1
    return sampled(ArrayImage(pixels), line_sample, first, size, ratio=ratio, cubic=cubic)


in_both_ways = pytest.mark.parametrize("cubic", [True, False])
at_all_ratios = pytest.mark.parametrize("ratio", [0.4, 1.0, 1.9, 2.0, 3.3, 4.0, 5.1, 6.0, 8.7])


@at_all_ratios
@in_both_ways
def test_a_plane_stays_a_plane(ratio: float, cubic: bool) -> None:
    line, sample = np.indices((LINES, SAMPLES))
    plane = (300.0 + 0.7 * line + 1.3 * sample).astype(np.float32)
    line_sample = positions(ratio, 8)
    expected = 300.0 + line_sample @ (0.7, 1.3)
    np.testing.assert_allclose(values(plane, line_sample, ratio, cubic), expected, atol=ROUNDING)


@at_all_ratios
@in_both_ways
def test_the_values_at_positions_do_not_depend_on_the_others_asked_for(
    ratio: float, cubic: bool
) -> None:
    noise = np.random.default_rng(4).normal(500.0, 50.0, (LINES, SAMPLES)).astype(np.float32)
    line_sample = positions(ratio)
    whole = values(noise, line_sample, ratio, cubic)
    for rows, columns in product((slice(0, 3), slice(3, None)), (slice(0, 5), slice(5, None))):
        part = values(noise, line_sample[rows, columns], ratio, cubic)
        np.testing.assert_allclose(part, whole[rows, columns], atol=ROUNDING)


@in_both_ways
def test_at_whole_pixels_their_own_values_stand_to_the_border_of_the_image(cubic: bool) -> None:
    noise = np.random.default_rng(5).normal(500.0, 50.0, (9, 11)).astype(np.float32)
    line_sample = np.stack(np.indices(noise.shape), axis=-1).astype(np.float64)
    np.testing.assert_array_equal(values(noise, line_sample, 1.0, cubic), noise)
    # Half a pixel beyond its middle the outermost pixel ends.
    np.testing.assert_array_equal(values(noise, line_sample - (0.5, 0.0), 1.0, cubic)[0], noise[0])


def test_positions_up_to_the_edges_of_the_pixels_are_inside() -> None:
    edges = [[[-0.5, 3.0], [8.5, 10.5], [4.0, -0.5]], [[-0.51, 3.0], [8.51, 2.0], [4.0, 10.51]]]
    line_sample = np.array(edges)
    low, high = drop_outside(line_sample, 9, 11)
    np.testing.assert_array_equal(low, (-0.5, -0.5))
    np.testing.assert_array_equal(high, (8.5, 10.5))
    np.testing.assert_array_equal(line_sample[0], edges[0])
    assert np.isnan(line_sample[1]).all()
