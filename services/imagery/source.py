"""Pixels of an image at any scale, and chips rendered from an image."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, runtime_checkable

import cv2
import numpy as np

from amers.services.conventions import CHIP_CENTRE
from amers.services.geodesy import lon_lat_h_from_east_north_up
from amers.services.imagery.gaps import LOST_SHARE, filled, lost_pixels
from amers.services.imagery.resampling import finite_bounds, resample, spline_coefficients
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, FloatImage

_MARGIN_PX = 6
"""Pixels read beyond the positions sampled, so that the spline does not depend on the window."""

_NODE_PX = 10
"""Chip pixels between the nodes that are projected through the model."""

_PER_SQUARE = 3
"""Pixels along each side of a square of a quick view that are read: the mean of nine has a third of the
noise of one, and a fifth of the pixels of an image of 20,000 px is read."""

BLUR_PER_RATIO = 0.4
"""Sigma of the low-pass, in source pixels per unit of sqrt(ratio^2 - 1): a compromise between the
aliasing of a box filter (0.29) and the loss of detail of a half-pixel Gaussian (0.5)."""


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels, which may extend beyond the image.

    Attributes:
        line, sample: of its first pixel.
        lines, samples: its size.
    """

    line: int
    sample: int
    lines: int
    samples: int


class ImageSource(Protocol):
    """One band of an image that is read by windows."""

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        ...

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window, (lines, samples) float32.

        NaN beyond the image and where there is no data, +inf where the image is saturated: brighter
        than its sensor can tell.
        """
        ...


@runtime_checkable
class SampledSource(ImageSource, Protocol):
    """An image source that can read some of its pixels, spread evenly, without reading all of them."""

    def sampled(self, window: Window, shape: tuple[int, int]) -> FloatImage:
        """Pixels (lines, samples) of a window, fewer than it has; of an overview where one serves."""
        ...


@dataclass(frozen=True)
class ArrayImage:
    """An image in memory.

    Attributes:
        pixels: (lines, samples) float32; NaN where nodata, +inf where saturated.
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
    """A reduced image in memory.

    Attributes:
        pixels: (lines, samples) float32, see `block_means`.
        factor: 1 or more.
    """

    pixels: FloatImage
    factor: int


class CachedImage:
    """An image whose windows are read once, up to a limit of memory.

    A registration searches the same positions several times. The block means that `sample_image`
    computes of a window serve the smaller windows inside it.

    Attributes:
        source: the image.
        max_bytes: limit of the cache; windows that would exceed it are not cached.
        cached_bytes: size of the cache.
    """

    def __init__(self, source: ImageSource, max_bytes: int = 96_000_000) -> None:
        """Start with an empty cache."""
        self.source = source
        self.max_bytes = max_bytes
        self.cached_bytes = 0
        self._cache: list[tuple[int, Window, FloatImage]] = []

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.source.shape

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window; NaN beyond the image and where nodata, +inf where saturated."""
        return self.source.read(window)

    def means(self, window: Window, factor: int) -> FloatImage:
        """Means over squares of pixels of a window whose borders are borders of squares."""
        for cached_factor, cached, means in self._cache:
            line, sample = window.line - cached.line, window.sample - cached.sample
            inside = line >= 0 and sample >= 0 and cached_factor == factor
            inside = inside and line + window.lines <= cached.lines
            if inside and sample + window.samples <= cached.samples:
                top, left = line // factor, sample // factor
                bottom, right = top + window.lines // factor, left + window.samples // factor
                return means[top:bottom, left:right]
        means = block_means(self.source.read(window), factor)
        if self.cached_bytes + means.nbytes <= self.max_bytes:
            self.cached_bytes += means.nbytes
            self._cache.append((factor, window, means))
        return means


def _means(image: ImageSource, window: Window, factor: int) -> FloatImage:
    """Means over squares of pixels of a window, from the cache of the image if it has one."""
    if isinstance(image, CachedImage):
        return image.means(window, factor)
    return block_means(image.read(window), factor)


def reduce_image(source: ImageSource, factor: int, strip_pixels: int = 16_000_000) -> ReducedImage:
    """The whole image reduced by a factor, read once, strip by strip.

    Args:
        source: the image.
        factor: number of pixels averaged in each direction.
        strip_pixels: largest number of pixels of the original in memory at once.
    """
    lines, samples = source.shape[0] // factor, source.shape[1] // factor
    pixels = np.empty((lines, samples), dtype=np.float32)
    step = max(1, strip_pixels // (source.shape[1] * factor))
    for line in range(0, lines, step):
        count = min(step, lines - line)
        strip = source.read(Window(line * factor, 0, count * factor, samples * factor))
        pixels[line : line + count] = block_means(strip, factor)
    return ReducedImage(pixels, factor)


def quick_view(source: ImageSource, factor: int) -> FloatImage:
    """The whole image reduced by a factor for people to look at, of few of its pixels.

    A square of `factor` x `factor` pixels is the mean of `_PER_SQUARE` x `_PER_SQUARE` of them, spread
    evenly: of overviews where the image has some, else of single lines. It is not for measuring: what is
    between them is not seen.

    Args:
        source: the image.
        factor: number of pixels of the image in each direction for one of the view.

    Returns:
        (lines, samples); see `block_means` for squares without data.
    """
    if factor <= _PER_SQUARE:
        return reduce_image(source, factor).pixels
    lines, samples = source.shape[0] // factor, source.shape[1] // factor
    shape = lines * _PER_SQUARE, samples * _PER_SQUARE
    if isinstance(source, SampledSource):
        return block_means(
            source.sampled(Window(0, 0, lines * factor, samples * factor), shape), _PER_SQUARE
        )
    line, sample = (((np.arange(n) + 0.5) * factor / _PER_SQUARE).astype(int) for n in shape)
    seen = np.stack(
        [source.read(Window(one, 0, 1, source.shape[1]))[0, sample] for one in line.tolist()]
    )
    return block_means(seen, _PER_SQUARE)


def block_means(pixels: FloatImage, factor: int) -> FloatImage:
    """Means over squares of `factor` x `factor` pixels; incomplete squares at the end are dropped.

    Gaps in a square are filled from their neighbours. A square with more than half of its pixels lost is
    NaN where most of these have no data, +inf where most are saturated.
    """
    if factor == 1:
        return pixels
    lines, samples = pixels.shape[0] // factor, pixels.shape[1] // factor
    whole = np.ascontiguousarray(pixels[: lines * factor, : samples * factor])

    def means_of(part: FloatImage) -> FloatImage:
        return np.asarray(cv2.resize(part, (samples, lines), interpolation=cv2.INTER_AREA))

    means = means_of(whole)
    if np.isfinite(means).all():
        return means
    share = means_of((~np.isfinite(whole)).astype(np.float32))
    lost = share > LOST_SHARE
    if not (lost | (share == 0.0)).all():
        means = means_of(filled(whole))
    means[lost] = np.nan
    saturated = np.isposinf(whole)
    if saturated.any():
        means[lost & (means_of(saturated.astype(np.float32)) > share / 2.0)] = np.inf
    return means


def low_pass(pixels: FloatImage, ratio: float) -> FloatImage:
    """Pixels low-passed to the resolution of pixels `ratio` times larger; unchanged up to ratio 1.

    Small gaps are bridged, others are lost; see `gaps`.
    """
    if ratio <= 1.0:
        return pixels
    sigma_px = low_pass_sigma_px(ratio)
    if np.isfinite(pixels).all():
        return np.asarray(cv2.GaussianBlur(pixels, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT))
    return low_pass(filled(pixels), ratio) + lost_pixels(pixels, sigma_px)


def low_pass_sigma_px(ratio: float) -> float:
    """Standard deviation of the low-pass for pixels `ratio` times larger, source pixels."""
    return BLUR_PER_RATIO * float(np.sqrt(max(ratio * ratio - 1.0, 0.0)))


def image_gsd_m(model: SensorModel, lon_lat_h: Array) -> float:
    """Ground sampling at one point (3,), metres: square root of the area of a pixel on the ground."""
    return float(image_gsds_m(model, lon_lat_h[None, :])[0])


def image_gsds_m(model: SensorModel, lon_lat_h: Array) -> Array:
    """Ground sampling (n,) at points (n, 3), metres; see `image_gsd_m`."""
    derivative = model.project_derivative(lon_lat_h)
    return np.asarray(np.abs(np.linalg.det(derivative[:, :, :2])) ** -0.5)


def chip_ground(lon_lat_h: Array, gsd_m: float, size: int) -> Array:
    """Ground positions of the pixels of a chip.

    Args:
        lon_lat_h: (3,) the point at the centre of the chip.
        gsd_m: ground sampling of the chip, metres.
        size: side of the chip, an odd number of pixels.

    Returns:
        (size * size, 3), row by row from the north-west.
    """
    offset = (np.arange(size) - size // 2) * gsd_m
    enu = np.zeros((size, size, 3))
    enu[..., 0] = offset[None, :]
    enu[..., 1] = -offset[:, None]
    return lon_lat_h_from_east_north_up(enu.reshape(-1, 3), lon_lat_h)


def chip_positions(model: SensorModel, lon_lat_h: Array, gsd_m: float, size: int) -> Array:
    """Positions (size, size, 2) in an image of the pixels of a chip.

    Only nodes are projected through the model. Sensor models are smooth: the bilinear positions between
    nodes have an error of 1.3e-5 px where the chip is four times coarser than the image.

    Args:
        model: of the image.
        lon_lat_h: (3,) the point at the centre of the chip.
        gsd_m: ground sampling of the chip, metres.
        size: side of the chip, an odd number of pixels.

    Returns:
        Pixels of the image; NaN beside nodes outside the range of the model.
    """
    half = -(-(size // 2) // _NODE_PX)
    count = 2 * half + 1
    ground = chip_ground(lon_lat_h, gsd_m * _NODE_PX, count)
    nodes = model.project(ground).reshape(count, count, 2)
    missing = ~np.isfinite(nodes).all(axis=2)
    if missing.any():
        nodes[missing] = 0.0
    positions = interpolate_nodes(nodes, size, _NODE_PX)
    if missing.any():
        weight = _node_weights(half, size, _NODE_PX)
        positions[weight @ missing @ weight.T > 0.0] = np.nan
    return positions


def interpolate_nodes(nodes: Array, size: int, node_px: int) -> Array:
    """Positions (size, size, 2) of pixels between nodes (k, k, 2), bilinear.

    Args:
        nodes: positions of every `node_px`-th pixel around the central one.
        size: odd number of pixels a side.
        node_px: pixels between nodes.
    """
    weight = _node_weights(nodes.shape[0] // 2, size, node_px)
    positions = np.empty((size, size, 2))
    for k in range(2):
        positions[..., k] = weight @ nodes[..., k] @ weight.T
    return positions


@lru_cache(maxsize=16)
def _node_weights(half: int, size: int, node_px: int) -> Array:
    """Weights (size, 2 half + 1) of the nodes in each pixel along an axis."""
    pixel = (np.arange(size) - size // 2) / node_px
    return np.maximum(0.0, 1.0 - np.abs(pixel[:, None] - np.arange(-half, half + 1)))


def render_chip(
    source: ImageSource | ReducedImage,
    model: SensorModel,
    lon_lat_h: Array,
    gsd_m: float,
    size: int = 2 * CHIP_CENTRE + 1,
) -> FloatImage:
    """An image around a point, rendered in the geometry of a chip.

    The image is low-passed to the resolution of the chip before it is resampled. An image coarser than
    the chip is only resampled.

    Args:
        source: the image, or a reduction of it.
        model: of the original image.
        lon_lat_h: (3,) the point.
        gsd_m: ground sampling of the chip, metres.
        size: side of the chip, an odd number of pixels.

    Returns:
        (size, size) float32; NaN where the image has no data, +inf where it is saturated, both in areas
        only: single pixels are bridged.
    """
    positions = chip_positions(model, lon_lat_h, gsd_m, size)
    return sample_image(source, positions, gsd_m / image_gsd_m(model, lon_lat_h))


def sample_image(source: ImageSource | ReducedImage, line_sample: Array, ratio: float) -> FloatImage:
    """Values of an image at many positions near each other, at a given resolution.

    Only the window of these positions is read. It is averaged over whole pixels, low-passed to the
    resolution, then resampled by a cubic spline.

    Args:
        source: the image, or a reduction of it.
        line_sample: (rows, columns, 2) positions in the original image, pixels.
        ratio: size of the pixels wanted over that of the original pixels; below 1 nothing is sharpened.

    Returns:
        (rows, columns) float32; NaN beyond the image, in areas without data and where a position is
        NaN; +inf in saturated areas. Gaps smaller than the footprint of a value are bridged.
    """
    if isinstance(source, ReducedImage):
        image: ImageSource = ArrayImage(source.pixels)
        line_sample = (line_sample - (source.factor - 1) / 2.0) / source.factor
        ratio /= source.factor
    else:
        image = source
    empty = np.full(line_sample.shape[:2], np.nan, dtype=np.float32)
    low, high = finite_bounds(line_sample)
    if not (high >= low).all():
        return empty
    factor = max(1, int(ratio / 2.0))
    margin = _MARGIN_PX * factor + int(2.0 * ratio)
    first = np.floor(low).astype(int) - margin
    last = np.ceil(high).astype(int) + margin + 1
    first, last = np.maximum(first, -margin), np.minimum(last, np.array(image.shape) + margin)
    if (last <= 0).any() or (first >= image.shape).any() or (last - first < 4 * factor).any():
        return empty
    # Squares begin at multiples of the factor in every window, so that the means of one serve another.
    first -= first % factor
    last += -last % factor
    window = Window(int(first[0]), int(first[1]), *(int(v) for v in last - first))
    pixels = _means(image, window, factor)
    position = line_sample - (first + (factor - 1) / 2.0)
    position /= factor
    return resample(spline_coefficients(pixels, low_pass_sigma_px(ratio / factor)), position)
