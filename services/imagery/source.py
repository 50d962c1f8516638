"""Reading pixels at a scale, and cutting chips out of images."""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from services.conventions import CHIP_CENTRE
from services.geodesy import lon_lat_h_from_east_north_up
from services.imagery.resampling import extent, resample, spline_coefficients
from services.sensors.base import SensorModel
from services.types import Array, FloatImage

_MARGIN_PX = 6
"""Pixels read around those asked for, so that the spline is not that of the window's border."""

_NODE_PX = 10
"""Chip pixels between the places that go through the model."""

BLUR_PER_RATIO = 0.4
"""Width of the low-pass, in source pixels per unit of sqrt(ratio^2 - 1): between the aliasing of a plain
box (0.29) and the loss of detail of a half-pixel Gaussian (0.5)."""


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels; it may reach beyond the image.

    Attributes:
        line, sample: of its first pixel.
        lines, samples: its size.
    """

    line: int
    sample: int
    lines: int
    samples: int


class ImageSource(Protocol):
    """One band of an image, readable by windows."""

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        ...

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window, (lines, samples) float32; NaN beyond the image and where nodata."""
        ...


@dataclass(frozen=True)
class ArrayImage:
    """An image held in memory.

    Attributes:
        pixels: (lines, samples) float32, NaN where nodata.
    """

    pixels: FloatImage

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.pixels.shape[0], self.pixels.shape[1]

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window; NaN beyond the image."""
        out = np.full((window.lines, window.samples), np.nan, dtype=np.float32)
        first = np.maximum([window.line, window.sample], 0)
        last = np.minimum(
            [window.line + window.lines, window.sample + window.samples], self.pixels.shape
        )
        if (last > first).all():
            out[
                first[0] - window.line : last[0] - window.line,
                first[1] - window.sample : last[1] - window.sample,
            ] = self.pixels[first[0] : last[0], first[1] : last[1]]
        return out


@dataclass(frozen=True)
class ReducedImage:
    """An image at a fraction of its resolution, held in memory.

    Attributes:
        pixels: (lines, samples) float32, means over `factor` x `factor` pixels of the original.
        factor: 1 or more.
    """

    pixels: FloatImage
    factor: int


class CachedImage:
    """An image whose windows are read once, as far as memory is allowed for them.

    A registration looks at the same places pass after pass; what `sample_image` has made of a window
    serves the smaller ones inside it.

    Attributes:
        source: the image.
        max_bytes: what may be kept; windows read after that are not.
        cached_bytes: what is kept.
    """

    def __init__(self, source: ImageSource, max_bytes: int = 96_000_000) -> None:
        """Keep nothing yet."""
        self.source = source
        self.max_bytes = max_bytes
        self.cached_bytes = 0
        self._kept: list[tuple[int, Window, FloatImage]] = []

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.source.shape

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window; NaN beyond the image and where nodata."""
        return self.source.read(window)

    def means(self, window: Window, factor: int) -> FloatImage:
        """Means over squares of pixels of a window that begins and ends with a square."""
        for kept_factor, kept, means in self._kept:
            line, sample = window.line - kept.line, window.sample - kept.sample
            inside = line >= 0 and sample >= 0 and kept_factor == factor
            if inside and line + window.lines <= kept.lines and sample + window.samples <= kept.samples:
                top, left = line // factor, sample // factor
                bottom, right = top + window.lines // factor, left + window.samples // factor
                return means[top:bottom, left:right]
        means = block_means(self.source.read(window), factor)
        if self.cached_bytes + means.nbytes <= self.max_bytes:
            self.cached_bytes += means.nbytes
            self._kept.append((factor, window, means))
        return means


def _means(image: ImageSource, window: Window, factor: int) -> FloatImage:
    if isinstance(image, CachedImage):
        return image.means(window, factor)
    return block_means(image.read(window), factor)


def reduce_image(source: ImageSource, factor: int, strip_pixels: int = 16_000_000) -> ReducedImage:
    """The whole image at a fraction of its resolution, read once, strip by strip.

    Args:
        source: the image.
        factor: whole number of pixels averaged in each direction.
        strip_pixels: pixels of the original held in memory at once.
    """
    lines, samples = source.shape[0] // factor, source.shape[1] // factor
    pixels = np.empty((lines, samples), dtype=np.float32)
    step = max(1, strip_pixels // (source.shape[1] * factor))
    for line in range(0, lines, step):
        count = min(step, lines - line)
        strip = source.read(Window(line * factor, 0, count * factor, samples * factor))
        pixels[line : line + count] = block_means(strip, factor)
    return ReducedImage(pixels, factor)


def block_means(pixels: FloatImage, factor: int) -> FloatImage:
    """Means over squares of `factor` pixels; what does not fill a square at the end is left out."""
    if factor == 1:
        return pixels
    lines, samples = pixels.shape[0] // factor, pixels.shape[1] // factor
    whole = np.ascontiguousarray(pixels[: lines * factor, : samples * factor])
    return np.asarray(cv2.resize(whole, (samples, lines), interpolation=cv2.INTER_AREA))


def low_pass(pixels: FloatImage, ratio: float) -> FloatImage:
    """Pixels blurred to the resolution of pixels `ratio` times larger; unchanged below 1."""
    if ratio <= 1.0:
        return pixels
    return np.asarray(cv2.GaussianBlur(pixels, (0, 0), blur_px(ratio), borderType=cv2.BORDER_REFLECT))


def blur_px(ratio: float) -> float:
    """Standard deviation of the low-pass for pixels `ratio` times larger, source pixels."""
    return BLUR_PER_RATIO * float(np.sqrt(max(ratio * ratio - 1.0, 0.0)))


def image_gsd_m(model: SensorModel, lon_lat_h: Array) -> float:
    """Ground sampling at one point (3,): side of the square as large as a pixel's footprint, metres."""
    return float(image_gsds_m(model, lon_lat_h[None, :])[0])


def image_gsds_m(model: SensorModel, lon_lat_h: Array) -> Array:
    """Ground sampling (n,) at points (n, 3), metres; see `image_gsd_m`."""
    derivative = model.project_derivative(lon_lat_h)
    return np.asarray(np.abs(np.linalg.det(derivative[:, :, :2])) ** -0.5)


def chip_ground(lon_lat_h: Array, gsd_m: float, size: int) -> Array:
    """Ground positions of the pixels of a chip around one point (3,).

    Args:
        lon_lat_h: the point, at the centre of the chip.
        gsd_m: ground sampling.
        size: odd number of pixels a side.

    Returns:
        (size * size, 3), row by row from the north-west.
    """
    offset = (np.arange(size) - size // 2) * gsd_m
    enu = np.zeros((size, size, 3))
    enu[..., 0] = offset[None, :]
    enu[..., 1] = -offset[:, None]
    return lon_lat_h_from_east_north_up(enu.reshape(-1, 3), lon_lat_h)


def chip_positions(model: SensorModel, lon_lat_h: Array, gsd_m: float, size: int) -> Array:
    """Where the pixels of a chip lie in an image: (size, size, 2).

    Only nodes go through the model: a sensor is smooth, and bilinear positions between them are off by
    1.3e-5 px where the chip is four times coarser than the image.

    Args:
        model: of the image.
        lon_lat_h: (3,) the point at the centre of the chip.
        gsd_m: ground sampling of the chip.
        size: odd number of pixels a side.
    """
    half = -(-(size // 2) // _NODE_PX)
    count = 2 * half + 1
    ground = chip_ground(lon_lat_h, gsd_m * _NODE_PX, count)
    nodes = model.project(ground).reshape(count, count, 2)
    pixel = (np.arange(size) - size // 2) / _NODE_PX
    weight = np.maximum(0.0, 1.0 - np.abs(pixel[:, None] - np.arange(-half, half + 1)))
    missing = ~np.isfinite(nodes).all(axis=2)
    if missing.any():
        nodes[missing] = 0.0
    positions = np.stack([weight @ nodes[..., k] @ weight.T for k in range(2)], axis=-1)
    if missing.any():
        positions[weight @ missing @ weight.T > 0.0] = np.nan
    return positions


def render_chip(
    source: ImageSource | ReducedImage,
    model: SensorModel,
    lon_lat_h: Array,
    gsd_m: float,
    size: int = 2 * CHIP_CENTRE + 1,
) -> FloatImage:
    """What an image shows around a point, in the geometry of a chip.

    The image is low-passed to the resolution of the chip before it is resampled; where the image is
    coarser than the chip it is only resampled.

    Args:
        source: the image, or a reduction of it.
        model: its model; positions are those of the original image.
        lon_lat_h: (3,) the point.
        gsd_m: ground sampling of the chip.
        size: odd number of pixels a side.

    Returns:
        (size, size) float32; NaN where the image shows nothing.
    """
    positions = chip_positions(model, lon_lat_h, gsd_m, size)
    return sample_image(source, positions, gsd_m / image_gsd_m(model, lon_lat_h))


def sample_image(source: ImageSource | ReducedImage, line_sample: Array, ratio: float) -> FloatImage:
    """An image at many places near each other, at a resolution.

    Only the window of these places is read. It is averaged over whole pixels and blurred down to the
    resolution asked for, then resampled by a cubic spline.

    Args:
        source: the image, or a reduction of it.
        line_sample: (rows, columns, 2) positions in the original image.
        ratio: size of the pixels wanted over that of the original's; an image is never sharpened.

    Returns:
        (rows, columns) float32; NaN beyond the image, beside nodata and where a position is NaN.
    """
    if isinstance(source, ReducedImage):
        image: ImageSource = ArrayImage(source.pixels)
        line_sample = (line_sample - (source.factor - 1) / 2.0) / source.factor
        ratio /= source.factor
    else:
        image = source
    nothing = np.full(line_sample.shape[:2], np.nan, dtype=np.float32)
    low, high = extent(line_sample)
    if not (high >= low).all():
        return nothing
    factor = max(1, int(ratio / 2.0))
    margin = _MARGIN_PX * factor + int(2.0 * ratio)
    first = np.floor(low).astype(int) - margin
    last = np.ceil(high).astype(int) + margin + 1
    first, last = np.maximum(first, -margin), np.minimum(last, np.array(image.shape) + margin)
    if (last <= 0).any() or (first >= image.shape).any() or (last - first < 4 * factor).any():
        return nothing
    # Squares of pixels that lie the same in every window, so that means of one serve another.
    first -= first % factor
    last += -last % factor
    window = Window(int(first[0]), int(first[1]), *(int(v) for v in last - first))
    pixels = _means(image, window, factor)
    position = (line_sample - first - (factor - 1) / 2.0) / factor
    return resample(spline_coefficients(pixels, blur_px(ratio / factor)), position)
