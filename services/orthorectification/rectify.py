"""A scene laid on a map through its model and the terrain, window by window."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit

from services.errors import CoverageError, InputError
from services.imagery.scene import Scene, scene_gsd_m
from services.imagery.source import ImageSource, Window, block_means, low_pass
from services.map_grid import MapGrid, utm_of, xy_of_lon_lat
from services.orthorectification.mapping import map_into_image, metres_a_unit, occluded_ground
from services.sensors.base import SensorModel
from services.terrain import Terrain
from services.types import Array, FloatImage, IntArray, Progress, no_progress

MAX_READ_PIXELS = 24_000_000
"""Pixels of the image read at once, 96 MB; a window of the map that needs more is divided."""
_SMALLEST_WINDOW = 16
_MAX_MAP_PIXELS = 40_000_000_000
_REACH_PX = 3
_RATIO_STEP = 8
"""Map pixels between those whose size in the image is looked at."""


@dataclass(frozen=True)
class OrthoOptions:
    """How a scene is rectified.

    Attributes:
        kernel: "cubic" (convolution, a = -0.5) or "bilinear".
        tolerance_px: how far positions may be from those of the model, pixels of the scene.
        hide: leave out ground that other ground hides from the sensor.
        window_px: side of the windows of the map.
    """

    kernel: Literal["cubic", "bilinear"] = "cubic"
    tolerance_px: float = 0.1
    hide: bool = False
    window_px: int = 512

    def __post_init__(self) -> None:
        """Refuse what nothing can be rectified with."""
        if not self.tolerance_px > 0.0 or self.window_px < _SMALLEST_WINDOW:
            raise InputError(
                f"tolerance_px above 0 and window_px of at least {_SMALLEST_WINDOW} expected, found "
                f"{self.tolerance_px:g} and {self.window_px}"
            )


@dataclass(frozen=True)
class OrthoWindow:
    """A finished window of the map.

    Attributes:
        window: where.
        pixels: (bands, lines, samples) float32; NaN where the scene shows nothing.
        error_px: largest difference from the model found where the mapping was checked.
    """

    window: Window
    pixels: FloatImage
    error_px: float


def choose_grid(
    scene: Scene, terrain: Terrain, crs: str | None = None, gsd_m: float | None = None
) -> MapGrid:
    """The north-up map that holds all the ground a scene shows.

    Args:
        scene: with the model to be used.
        terrain: the ground.
        crs: reference system of the map; by default the UTM zone of the centre.
        gsd_m: ground sampling; by default that of the scene. Pixel corners lie on multiples of it.

    Raises:
        CoverageError: when the terrain does not reach the scene.
        InputError: when the map would be larger than any image.
    """
    border = _border(scene.image.shape)
    low, high = scene.model.height_range_m
    around = terrain.around(_located(scene.model, border, (low, high)))
    lon_lat = _located(scene.model, border, around.range_m())
    lon_lat = lon_lat[np.isfinite(lon_lat).all(axis=1)]
    if not len(lon_lat):
        raise CoverageError("the model of the scene leads to no place at the heights of the terrain")
    lon_lat[:, 0] = lon_lat[0, 0] + (lon_lat[:, 0] - lon_lat[0, 0] + 180.0) % 360.0 - 180.0
    lon, lat = lon_lat.mean(axis=0)
    crs = crs or utm_of((lon + 180.0) % 360.0 - 180.0, lat)
    empty = MapGrid(crs, np.zeros(2), np.array([[0.0, 1.0], [-1.0, 0.0]]), (1, 1))
    xy = lon_lat if empty.is_geographic else xy_of_lon_lat(crs, lon_lat)
    xy = xy[np.isfinite(xy).all(axis=1)]
    if not len(xy):
        raise InputError(f"{crs}: the scene at {lon:.3f}, {lat:.3f} has no place on this map")
    unit = np.array(metres_a_unit(empty.is_geographic, lat))
    step = (gsd_m or scene_gsd_m(scene)) / unit
    first, last = np.floor(xy.min(axis=0) / step), np.ceil(xy.max(axis=0) / step)
    samples, lines = (int(count) for count in last - first)
    if lines * samples > _MAX_MAP_PIXELS:
        raise InputError(f"a map of {lines} x {samples} pixels of {gsd_m} m: too large")
    origin = np.array([first[0] + 0.5, last[1] - 0.5]) * step
    return MapGrid(crs, origin, np.array([[0.0, step[0]], [-step[1], 0.0]]), (lines, samples))


def orthorectify(
    images: Sequence[ImageSource],
    model: SensorModel,
    terrain: Terrain,
    grid: MapGrid,
    options: OrthoOptions = OrthoOptions(),
    *,
    progress: Progress = no_progress,
) -> Iterator[OrthoWindow]:
    """The windows of an ortho-image, row after row; memory does not grow with image, terrain or map.

    Where a map pixel is larger than one of the image, the image is low-passed to its size first.

    Args:
        images: bands of one image.
        model: of the image.
        terrain: the ground.
        grid: the map.
        options: how.
        progress: told where the work stands.

    Raises:
        ComputationError: when the model cannot be followed within the tolerance.
    """
    lines, samples = grid.shape
    side = options.window_px
    for line in range(0, lines, side):
        for sample in range(0, samples, side):
            window = Window(line, sample, min(side, lines - line), min(side, samples - sample))
            yield _rectified(images, model, terrain, grid, window, options)
        progress(min(line + side, lines) / lines, "rectifying")


def _rectified(
    images: Sequence[ImageSource],
    model: SensorModel,
    terrain: Terrain,
    grid: MapGrid,
    window: Window,
    options: OrthoOptions,
) -> OrthoWindow:
    shape = (window.lines, window.samples)
    nothing = OrthoWindow(window, np.full((len(images), *shape), np.nan, dtype=np.float32), 0.0)
    mapping = map_into_image(model, terrain, grid, window, options.tolerance_px)
    if mapping is None:
        return nothing
    line_sample = mapping.line_sample
    low, high = _hold_inside(line_sample, *images[0].shape)
    if not (high >= low).all():
        return nothing
    first = np.floor(low).astype(np.int64)
    size = np.ceil(high).astype(np.int64) - first + 1
    if math.prod(size.tolist()) > MAX_READ_PIXELS and min(shape) > _SMALLEST_WINDOW:
        return _divided(images, model, terrain, grid, window, options)
    if options.hide:
        line_sample[occluded_ground(model, terrain, grid, window, mapping.height_m)] = np.nan
    ratio = _ratio(line_sample)
    pixels = np.stack(
        [_sampled(image, line_sample, first, size, ratio, options.kernel) for image in images]
    )
    return OrthoWindow(window, pixels, mapping.error_px)


def _divided(
    images: Sequence[ImageSource],
    model: SensorModel,
    terrain: Terrain,
    grid: MapGrid,
    window: Window,
    options: OrthoOptions,
) -> OrthoWindow:
    """A window in quarters, each of which needs less of the image."""
    pixels = np.empty((len(images), window.lines, window.samples), dtype=np.float32)
    error_px = 0.0
    halves = [(0, window.lines // 2), (window.lines // 2, window.lines)]
    sides = [(0, window.samples // 2), (window.samples // 2, window.samples)]
    for top, bottom in halves:
        for left, right in sides:
            part = Window(window.line + top, window.sample + left, bottom - top, right - left)
            done = _rectified(images, model, terrain, grid, part, options)
            pixels[:, top:bottom, left:right] = done.pixels
            error_px = max(error_px, done.error_px)
    return OrthoWindow(window, pixels, error_px)


def _ratio(line_sample: Array) -> float:
    """Image pixels a map pixel, in each direction, on the average of a window."""
    every = slice(None, -1, _RATIO_STEP), slice(1, None, _RATIO_STEP)
    corner = line_sample[every[0], every[0]]
    along, down = line_sample[every[0], every[1]] - corner, line_sample[every[1], every[0]] - corner
    area = np.abs(along[..., 0] * down[..., 1] - along[..., 1] * down[..., 0])
    area = area[np.isfinite(area)]
    return math.sqrt(float(np.median(area))) if len(area) else 1.0


def _sampled(
    image: ImageSource, line_sample: Array, first: IntArray, size: IntArray, ratio: float, kernel: str
) -> FloatImage:
    """Pixels of an image at positions (lines, samples, 2)."""
    # Nearly equal pixels are not worth a blur.
    ratio = ratio if ratio > 1.1 else 1.0
    factor = max(1, int(ratio / 2.0))
    margin = _REACH_PX * factor + int(2.0 * ratio)
    begin = first - margin
    lines, samples = (int(count) for count in size + 2 * margin)
    # Pixels beyond the border are like the border's, as far as a kernel reaches.
    low = np.clip(begin, 0, np.array(image.shape) - 1)
    high = np.clip(begin + [lines, samples], 1, np.array(image.shape))
    whole = (high - low) // factor * factor
    whole = np.where(whole == 0, high - low, whole) if factor > 1 else high - low
    pixels = image.read(Window(int(low[0]), int(low[1]), int(whole[0]), int(whole[1])))
    factor = factor if min(pixels.shape) >= factor else 1
    pixels = np.ascontiguousarray(low_pass(block_means(pixels, factor), ratio / factor))
    return _resampled(pixels, line_sample, float(low[0]), float(low[1]), factor, kernel == "cubic")


@njit(cache=True)
def _hold_inside(line_sample: Array, lines: int, samples: int) -> tuple[Array, Array]:
    """Make positions beyond the image NaN; the lowest and highest (2,) of the others, inf of none."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for r in range(line_sample.shape[0]):
        for s in range(line_sample.shape[1]):
            line, sample = line_sample[r, s, 0], line_sample[r, s, 1]
            if -0.5 <= line <= lines - 0.5 and -0.5 <= sample <= samples - 0.5:
                low[0], high[0] = min(low[0], line), max(high[0], line)
                low[1], high[1] = min(low[1], sample), max(high[1], sample)
            else:
                line_sample[r, s] = np.nan
    return low, high


@njit(inline="always", error_model="numpy")
def _cubic_weights(t: float) -> tuple[float, float, float, float]:
    """Cubic convolution, a = -0.5 (Keys, 1981)."""
    return (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


@njit(inline="always", error_model="numpy")
def _weighted(pixels: FloatImage, i: int, j: int, v0: float, v1: float, v2: float, v3: float) -> float:
    return v0 * pixels[i, j - 1] + v1 * pixels[i, j] + v2 * pixels[i, j + 1] + v3 * pixels[i, j + 2]


@njit(inline="always", error_model="numpy")
def _bilinear(pixels: FloatImage, line: float, sample: float) -> float:
    """Between the pixels; a pixel without weight does not count."""
    lines, samples = pixels.shape
    i, j = int(line), int(sample)
    fi, fj = line - i, sample - j
    i1 = min(i + 1, lines - 1) if fi > 0.0 else i
    j1 = min(j + 1, samples - 1) if fj > 0.0 else j
    top = pixels[i, j] + fj * (pixels[i, j1] - pixels[i, j])
    bottom = pixels[i1, j] + fj * (pixels[i1, j1] - pixels[i1, j])
    return top + fi * (bottom - top)


@njit(cache=True, error_model="numpy")
def _resampled(
    pixels: FloatImage,
    line_sample: Array,
    first_line: float,
    first_sample: float,
    factor: int,
    cubic: bool,
) -> FloatImage:
    """Values (lines, samples) at positions of the image; bilinear beside what is missing."""
    lines, samples = pixels.shape
    rows, columns, _ = line_sample.shape
    out = np.empty((rows, columns), dtype=np.float32)
    centre = (factor - 1) / 2.0
    for r in range(rows):
        for s in range(columns):
            line = (line_sample[r, s, 0] - first_line - centre) / factor
            sample = (line_sample[r, s, 1] - first_sample - centre) / factor
            if not (line == line and sample == sample):
                out[r, s] = np.nan
                continue
            line = min(max(line, 0.0), lines - 1.0)
            sample = min(max(sample, 0.0), samples - 1.0)
            i, j = int(line), int(sample)
            if cubic and 1 <= i < lines - 2 and 1 <= j < samples - 2:
                u0, u1, u2, u3 = _cubic_weights(line - i)
                v0, v1, v2, v3 = _cubic_weights(sample - j)
                a = _weighted(pixels, i - 1, j, v0, v1, v2, v3)
                b = _weighted(pixels, i, j, v0, v1, v2, v3)
                c = _weighted(pixels, i + 1, j, v0, v1, v2, v3)
                d = _weighted(pixels, i + 2, j, v0, v1, v2, v3)
                value = u0 * a + u1 * b + u2 * c + u3 * d
                if value == value:
                    out[r, s] = value
                    continue
            out[r, s] = _bilinear(pixels, line, sample)
    return out


def _border(shape: tuple[int, int], per_side: int = 16) -> Array:
    """Positions (n, 2) round the border of an image and over its middle."""
    axes = [np.linspace(-0.5, size - 0.5, per_side + 1) for size in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def _located(model: SensorModel, line_sample: Array, heights_m: tuple[float, float]) -> Array:
    """Places (2n, 2) of image positions at two heights."""
    return np.concatenate(
        [model.locate(line_sample, np.full(len(line_sample), h))[:, :2] for h in heights_m]
    )
