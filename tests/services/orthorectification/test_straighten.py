"""Images without the motion of their lines and samples."""

import numpy as np
import pytest

from amers.services.imagery.source import ArrayImage, Window
from amers.services.orthorectification.straighten import shown_at, straighten
from amers.services.sensors.correction import ImageCorrection
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array, FloatImage

SHAPE = (700, 560)
"""More than one window in both directions, the last ones smaller."""
a_hundredth_of_the_contrast = 1.0
"""The ground has values of 0 to 200; waves of 24 px and cubic convolution differ by a third of that."""


def ground(line_sample: Array) -> Array:
    """What lies at positions (..., 2) of the uncorrected model."""
    line, sample = line_sample[..., 0], line_sample[..., 1]
    return 100.0 + 50.0 * np.sin(line / 4.1 + sample / 90.0) + 50.0 * np.cos(sample / 5.3 - line / 70.0)


def moving() -> ImageCorrection:
    """Jitter of the lines, and samples that are bent, beside an affine correction."""
    line = np.linspace(-40.0, 760.0, 201)
    sample = np.linspace(-40.0, 600.0, 41)
    by_line = np.stack([2.5 * np.sin(line / 30.0), 1.5 * np.cos(line / 45.0)], -1)
    by_sample = np.stack([0.0 * sample, 4.0 * ((sample - 280.0) / 280.0) ** 2], -1)
    displacement = by_line[:, None] + by_sample[None]
    grid = DisplacementGrid(line, sample, displacement, np.zeros_like(displacement))
    parameters = np.array([[3.0, 0.4, -0.3], [-6.0, 0.2, 0.5]])
    return ImageCorrection(parameters, np.array(SHAPE) / 2.0, np.array(SHAPE) / 2.0, grid)


def broken(lost: float) -> ImageCorrection:
    """An image that lost so many lines in the middle; a negative number is repeated."""
    line, sample = np.array([-60.0, 349.0, 350.0, 760.0]), np.array([0.0, 559.0])
    displacement = np.zeros((4, 2, 2))
    displacement[:2, :, 0], displacement[2:, :, 0] = lost / 2.0, -lost / 2.0
    grid = DisplacementGrid(line, sample, displacement, 0.0 * displacement, np.array([349.5]))
    return ImageCorrection(np.zeros((2, 3)), np.array(SHAPE) / 2.0, np.array(SHAPE) / 2.0, grid)


def broken_twice(lost: float) -> ImageCorrection:
    """An image that lost so many lines at two of them."""
    line, sample = np.array([-90.0, 199.0, 200.0, 449.0, 450.0, 790.0]), np.array([0.0, 559.0])
    displacement = np.zeros((6, 2, 2))
    displacement[:2, :, 0], displacement[4:, :, 0] = lost, -lost
    grid = DisplacementGrid(line, sample, displacement, 0.0 * displacement, np.array([199.5, 449.5]))
    return ImageCorrection(np.zeros((2, 3)), np.array(SHAPE) / 2.0, np.array(SHAPE) / 2.0, grid)


def pixels_at(correction: ImageCorrection) -> Array:
    """Positions (lines, samples, 2) of the uncorrected model that the pixels of the image show."""
    places = every_pixel()
    return np.asarray(correction.invert(places.reshape(-1, 2)).reshape(places.shape))


def every_pixel() -> Array:
    """Positions (lines, samples, 2) of the pixels of an image."""
    return np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1).astype(np.float64)


def straightened(correction: ImageCorrection, *images: FloatImage) -> FloatImage:
    out = np.full((len(images), *SHAPE), -1.0, dtype=np.float32)
    for one in straighten([ArrayImage(image) for image in images], correction):
        w = one.window
        out[:, w.line : w.line + w.lines, w.sample : w.sample + w.samples] = one.pixels
    return out


def affine_of(correction: ImageCorrection) -> ImageCorrection:
    return ImageCorrection(correction.parameters, correction.centre, correction.half_size)


def test_a_straightened_image_shows_the_ground_where_the_affine_correction_expects_it() -> None:
    correction = moving()
    image = ground(pixels_at(correction)).astype(np.float32)
    first, second = straightened(correction, image, 255.0 - image)
    expected = ground(pixels_at(affine_of(correction)))
    inside = np.s_[20:-20, 20:-20]
    assert np.abs(first - expected)[inside].max() < a_hundredth_of_the_contrast
    assert np.abs(255.0 - second - expected)[inside].max() < a_hundredth_of_the_contrast
    assert np.abs(image - expected)[inside].mean() > 10.0 * a_hundredth_of_the_contrast


def test_what_leaves_the_image_is_without_data() -> None:
    correction = moving()
    [out] = straightened(correction, np.ones(SHAPE, np.float32))
    shown = shown_at(correction, every_pixel().reshape(-1, 2))
    inside = ((shown >= -0.5) & (shown <= np.array(SHAPE) - 0.5)).all(axis=1).reshape(SHAPE)
    np.testing.assert_array_equal(np.isfinite(out), inside)
    assert not inside.all()


def test_lost_lines_are_a_gap_and_both_sides_keep_their_places() -> None:
    """The image has lines up to 330 of the ground, then those from 370 on."""
    line = np.arange(SHAPE[0], dtype=np.float64)
    shown = np.where(line < 350, line - 20.0, line + 20.0)
    places = np.stack(np.broadcast_arrays(shown[:, None], np.arange(SHAPE[1])[None]), -1)
    [out] = straightened(broken(40.0), ground(places).astype(np.float32))
    expected = ground(every_pixel())
    assert np.isnan(out[331:369]).all()
    for rows in (slice(5, 329), slice(371, 675)):
        assert np.abs(out[rows] - expected[rows]).max() < a_hundredth_of_the_contrast


@pytest.mark.parametrize("lost", [20.0, -20.0])
def test_every_break_of_an_image_is_a_gap_of_its_own(lost: float) -> None:
    """Twenty lines are lost at two breaks, around 199.5 and 449.5, or repeated there."""
    line, half = np.arange(SHAPE[0], dtype=np.float64), lost / 2.0
    off = np.select([line < 199.5 + half, line < 449.5 - half], [-lost, 0.0], lost)
    places = np.stack(np.broadcast_arrays((line + off)[:, None], np.arange(SHAPE[1])[None]), -1)
    [out] = straightened(broken_twice(lost), ground(places).astype(np.float32))
    gaps = (np.abs(line[:, None] - [199.5, 449.5]) < 10.0).any(axis=1) & (lost > 0.0)
    shown = (np.abs(line[:, None] - [199.5, 449.5]) > 12.0).all(axis=1) & (np.abs(line - 349.5) < 325.0)
    assert np.isnan(out[gaps]).all()
    assert np.abs(out - ground(every_pixel()))[shown].max() < a_hundredth_of_the_contrast


def test_repeated_lines_are_shown_once() -> None:
    line = np.arange(SHAPE[0], dtype=np.float64)
    shown = np.where(line < 350, line + 20.0, line - 20.0)
    places = np.stack(np.broadcast_arrays(shown[:, None], np.arange(SHAPE[1])[None]), -1)
    [out] = straightened(broken(-40.0), ground(places).astype(np.float32))
    expected = ground(every_pixel())
    rows = slice(25, 675)
    assert np.abs(out[rows] - expected[rows]).max() < a_hundredth_of_the_contrast


def test_saturated_pixels_stay_saturated() -> None:
    image = np.full(SHAPE, 50.0, np.float32)
    image[300:320, 200:220] = np.inf
    [out] = straightened(moving(), image)
    assert 350 <= np.isposinf(out).sum() <= 450
    assert not np.isnan(out[290:330, 190:230]).any()
    assert ArrayImage(image).read(Window(300, 200, 1, 1))[0, 0] == np.inf
