"""A scene orthorectified on a map through its model and the terrain, window by window."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from amers.services.errors import CoverageError, InputError
from amers.services.imagery.scene import Scene, scene_footprint, scene_gsd_m
from amers.services.imagery.source import ImageSource, Window
from amers.services.map_grid import MapGrid, check_map_code, continuous_xy, map_units_per_metre, utm_of
from amers.services.orthorectification.mapping import map_into_image, occluded_ground
from amers.services.orthorectification.sampling import drop_outside, sampled
from amers.services.sensors.base import SensorModel
from amers.services.terrain import Terrain
from amers.services.types import Array, FloatImage, Progress, no_progress

MAX_READ_PIXELS = 24_000_000
"""Largest number of image pixels read at once, 96 MB; a window of the map that needs more is divided."""
_SMALLEST_WINDOW = 16
_MAX_MAP_PIXELS = 40_000_000_000
_INTERVALS = 16
"""Intervals along each side of an image between the positions that are located for its map."""
_FINER = 1.1
"""Largest ratio of a map pixel to an image pixel without low-pass: they are nearly of the same size."""


@dataclass(frozen=True)
class OrthoOptions:
    """How a scene is orthorectified.

    Attributes:
        kernel: "cubic" (convolution, a = -0.5) or "bilinear".
        tolerance_px: largest allowed error of the mapping, pixels.
        hide: write no data where the ground is hidden from the sensor by other ground.
        window_px: side of the windows of the map, pixels.
    """

    kernel: Literal["cubic", "bilinear"] = "cubic"
    tolerance_px: float = 0.1
    hide: bool = False
    window_px: int = 512

    def __post_init__(self) -> None:
        """Reject a tolerance and a window that are too small."""
        if not self.tolerance_px > 0.0 or self.window_px < _SMALLEST_WINDOW:
            raise InputError(
                f"tolerance_px {self.tolerance_px:g} and window_px {self.window_px} given, tolerance_px "
                f"above 0 and window_px of at least {_SMALLEST_WINDOW} expected"
            )


@dataclass(frozen=True)
class OrthoWindow:
    """A window of an ortho-image.

    Attributes:
        window: of the map.
        pixels: (bands, lines, samples) float32; NaN where the scene has no data, +inf where it is
            saturated.
        error_px: largest error of the positions where they were checked, pixels of the scene.
    """

    window: Window
    pixels: FloatImage
    error_px: float


def choose_grid(
    scene: Scene, terrain: Terrain, crs: str | None = None, gsd_m: float | None = None
) -> MapGrid:
    """The north-up map that covers all the ground a scene shows.

    Args:
        scene: with the model to be used.
        terrain: the ground.
        crs: reference system of the map; by default the UTM zone of the centre.
        gsd_m: ground sampling, metres on the ground whatever the unit and the scale of the map; by
            default that of the scene. Pixel corners lie on multiples of it. On a geographic map a pixel
            has this side both east and north, at the mean latitude.

    Raises:
        CoverageError: the terrain does not reach the scene.
        InputError: the reference system is not known, the scene is outside the map, or the map would be
            too large.
    """
    return grid_over_ground(seen_ground(scene, terrain), crs, gsd_m or scene_gsd_m(scene))


def seen_ground(scene: Scene, terrain: Terrain) -> Array:
    """Longitudes and latitudes (n, 2) of ground that an image shows, at its lowest and highest terrain.

    Longitudes are continuous: they may exceed 180 degrees.

    Raises:
        CoverageError: the terrain does not reach the scene.
    """
    positions = _grid_over(scene.image.shape)
    low, high = scene.model.height_range_m
    around = terrain.around(_located(scene.model, positions, (low, high)))
    lon_lat = _located(scene.model, positions, around.range_m())
    lon_lat = lon_lat[np.isfinite(lon_lat).all(axis=1)]
    if not len(lon_lat):
        raise unseen(scene, around)
    lon_lat[:, 0] = lon_lat[0, 0] + (lon_lat[:, 0] - lon_lat[0, 0] + 180.0) % 360.0 - 180.0
    return lon_lat


def grid_over_ground(lon_lat: Array, crs: str | None, gsd_m: float) -> MapGrid:
    """The north-up map over positions (n, 2), whose longitudes are continuous; see `choose_grid`.

    Raises:
        InputError: the reference system is not known, the ground is outside the map, or the map would be
            too large.
    """
    if crs is not None:
        check_map_code(crs)
    lon, lat = lon_lat.mean(axis=0)
    crs = crs or utm_of((lon + 180.0) % 360.0 - 180.0, lat)
    xy = continuous_xy(crs, lon_lat)
    xy = xy[np.isfinite(xy).all(axis=1)]
    if not len(xy):
        raise InputError(
            f"{crs}: the scene at longitude {lon:.3f}, latitude {lat:.3f} is outside this reference "
            "system. Choose another one"
        )
    per_metre = map_units_per_metre(crs, np.array([lon, lat]))
    step = gsd_m * per_metre
    first, last = np.floor(xy.min(axis=0) / step), np.ceil(xy.max(axis=0) / step)
    samples, lines = (int(count) for count in last - first)
    if lines * samples > _MAX_MAP_PIXELS:
        raise InputError(
            f"the map would have {lines} x {samples} pixels, at most {_MAX_MAP_PIXELS:,} in all are "
            "possible: give a larger `gsd_m`"
        )
    origin = np.array([first[0] + 0.5, last[1] - 0.5]) * step
    return MapGrid(crs, origin, np.array([[0.0, step[0]], [-step[1], 0.0]]), (lines, samples))


def unseen(scene: Scene, terrain: Terrain) -> CoverageError:
    """Why no ground of a terrain is seen in a scene, and what to do."""
    low_m, high_m = scene.model.height_range_m
    lowest_m, highest_m = terrain.around(scene_footprint(scene)).range_m()
    why = "all pixels that the map reaches are without data, or the terrain is void there"
    if lowest_m > high_m or highest_m < low_m:
        why = (
            f"its model is valid for heights of {low_m:.0f} to {high_m:.0f} m above the ellipsoid, the "
            f"terrain there has {lowest_m:.0f} to {highest_m:.0f} m: give the model that was delivered "
            "with the image, or check the vertical datum and the unit of the terrain"
        )
    return CoverageError(f"{scene.acquisition.image_id}: no pixel of the map shows the scene: {why}")


@dataclass(frozen=True)
class _Task:
    """What all the windows of an ortho-image are made from.

    Attributes:
        images: bands of one image.
        model: of the image.
        terrain: the ground.
        grid: the map.
        options: of the rectification.
        ratio: image pixels per map pixel along a side, in the middle of the image; 1 for finer maps. One
            for all windows, so that the image does not depend on them.
    """

    images: Sequence[ImageSource]
    model: SensorModel
    terrain: Terrain
    grid: MapGrid
    options: OrthoOptions
    ratio: float


def orthorectify(
    images: Sequence[ImageSource],
    model: SensorModel,
    terrain: Terrain,
    grid: MapGrid,
    options: OrthoOptions = OrthoOptions(),
    *,
    part: Window | None = None,
    progress: Progress = no_progress,
) -> Iterator[OrthoWindow]:
    """The windows of an ortho-image, row by row; memory does not grow with image, terrain or map.

    Where a map pixel is larger than an image pixel, the image is first low-passed to the size of the map
    pixel.

    Args:
        images: bands of one image.
        model: of the image.
        terrain: the ground.
        grid: the map.
        options: kernel, tolerance, occlusion and size of the windows.
        part: of the map, made as in the whole where it begins at a multiple of the size of the windows;
            by default all of it.
        progress: receives the fraction of the rows done.

    Raises:
        ComputationError: positions exceed the tolerance.
    """
    terrain = terrain.seamless(grid.lon_lat(_grid_over(grid.shape)))
    task = _Task(images, model, terrain, grid, options, _ratio(model, grid, images[0].shape))
    part = part or Window(0, 0, *grid.shape)
    end_line, end_sample = part.line + part.lines, part.sample + part.samples
    side = options.window_px
    for line in range(part.line, end_line, side):
        for sample in range(part.sample, end_sample, side):
            window = Window(line, sample, min(side, end_line - line), min(side, end_sample - sample))
            yield _rectified(task, window)
        progress(min(line + side - part.line, part.lines) / part.lines, "rectifying")


def _rectified(task: _Task, window: Window) -> OrthoWindow:
    shape = (window.lines, window.samples)
    empty = OrthoWindow(window, np.full((len(task.images), *shape), np.nan, dtype=np.float32), 0.0)
    mapping = map_into_image(task.model, task.terrain, task.grid, window, task.options.tolerance_px)
    if mapping is None:
        return empty
    line_sample = mapping.line_sample
    low, high = drop_outside(line_sample, *task.images[0].shape)
    if not (high >= low).all():
        return empty
    first = np.floor(low).astype(np.int64)
    size = np.ceil(high).astype(np.int64) - first + 1
    if math.prod(size.tolist()) > MAX_READ_PIXELS and min(shape) > _SMALLEST_WINDOW:
        return _divided(task, window)
    if task.options.hide:
        hidden = occluded_ground(task.model, task.terrain, task.grid, window, mapping.height_m)
        line_sample[hidden] = np.nan
    cubic = task.options.kernel == "cubic"
    pixels = np.stack(
        [
            sampled(image, line_sample, first, size, ratio=task.ratio, cubic=cubic)
            for image in task.images
        ]
    )
    return OrthoWindow(window, pixels, mapping.error_px)


def _divided(task: _Task, window: Window) -> OrthoWindow:
    """A window made from its quarters, each of which reads less of the image."""
    pixels = np.empty((len(task.images), window.lines, window.samples), dtype=np.float32)
    error_px = 0.0
    halves = [(0, window.lines // 2), (window.lines // 2, window.lines)]
    sides = [(0, window.samples // 2), (window.samples // 2, window.samples)]
    for top, bottom in halves:
        for left, right in sides:
            part = Window(window.line + top, window.sample + left, bottom - top, right - left)
            quarter = _rectified(task, part)
            pixels[:, top:bottom, left:right] = quarter.pixels
            error_px = max(error_px, quarter.error_px)
    return OrthoWindow(window, pixels, error_px)


def _ratio(model: SensorModel, grid: MapGrid, shape: tuple[int, int]) -> float:
    """Image pixels per map pixel along a side, in the middle of the image; 1 where the map is finer."""
    middle = (np.array([shape], dtype=np.float64) - 1.0) / 2.0
    height_m = sum(model.height_range_m) / 2.0
    lon_lat = model.locate(middle, np.array([height_m]))[:, :2]
    corners = grid.line_sample(lon_lat) + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    seen = model.project(np.column_stack([grid.lon_lat(corners), np.full(3, height_m)]))
    ratio = math.sqrt(abs(float(np.linalg.det(seen[1:] - seen[0]))))
    return ratio if ratio > _FINER else 1.0


def _grid_over(shape: tuple[int, int]) -> Array:
    """Positions (n, 2) on a regular grid over an image, its border included."""
    axes = [np.linspace(-0.5, size - 0.5, _INTERVALS + 1) for size in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def _located(model: SensorModel, line_sample: Array, heights_m: tuple[float, float]) -> Array:
    """Longitudes and latitudes (2n, 2) of image positions at two heights."""
    return np.concatenate(
        [model.locate(line_sample, np.full(len(line_sample), h))[:, :2] for h in heights_m]
    )
