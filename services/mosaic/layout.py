"""The map of a mosaic: the window of it that each scene reaches, and the cells of the seams."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from amers.services.errors import CoverageError
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.imagery.source import ArrayImage, ImageSource, Window
from amers.services.map_grid import MapGrid, continuous_xy
from amers.services.orthorectification.rectify import (
    OrthoOptions,
    grid_over_ground,
    orthorectify,
    seen_ground,
)
from amers.services.sensors.base import SensorModel
from amers.services.terrain import Terrain
from amers.services.types import Array, FloatImage

_LEAST_CELL_PX = 4
"""Side of a cell of a small mosaic, pixels: seams go around cars and houses of half-metre images."""
_SCENE_CELLS = 1_000_000
"""Cells of a scene at most: the cut of so many took 3.5 s and 0.25 GB (four million: 117 s, 0.9 GB)."""
_MAP_CELLS = 64_000_000
"""Cells of the map at most: 128 MB of numbers."""


@dataclass(frozen=True)
class MosaicScene:
    """A scene of a mosaic.

    Attributes:
        scene: with the model that the mosaic uses; its image may be any band.
        bands: of the image, all of which are rectified.
        delivered: the model before registration, for comparison; None without one.
        sigma_m: stated accuracy of the model, one standard deviation a coordinate; NaN when unknown.
    """

    scene: Scene
    bands: tuple[ImageSource, ...]
    delivered: SensorModel | None = None
    sigma_m: float = math.nan

    @property
    def name(self) -> str:
        """Of its image."""
        return self.scene.acquisition.image_id


@dataclass(frozen=True)
class MosaicMap:
    """The map wanted.

    Attributes:
        crs: reference system; None takes the UTM zone of the middle of all scenes.
        gsd_m: ground sampling; None takes that of the finest scene.
        outline: (n, 2) continuous longitudes and latitudes of the only ground wanted; None for all.
    """

    crs: str | None = None
    gsd_m: float | None = None
    outline: Array | None = None


@dataclass(frozen=True)
class Layout:
    """Where scenes lie on the map.

    Attributes:
        grid: of the pixels.
        scenes: those that reach the map.
        windows: of the map, that contain all each scene shows.
        left_out: names of scenes that do not reach the map.
        cell_px: side of a cell, pixels.
    """

    grid: MapGrid
    scenes: tuple[MosaicScene, ...]
    windows: tuple[Window, ...]
    left_out: tuple[str, ...]
    cell_px: int

    @property
    def cells(self) -> MapGrid:
        """The grid of the cells, each of which covers `cell_px` pixels along both sides."""
        middle = np.full((1, 2), (self.cell_px - 1) / 2.0)
        lines, samples = (-(-size // self.cell_px) for size in self.grid.shape)
        return replace(
            self.grid,
            origin_xy=self.grid.xy(middle)[0],
            step_xy=self.grid.step_xy * self.cell_px,
            shape=(lines, samples),
        )

    def cell_window(self, number: int) -> Window:
        """The cells of a scene."""
        w, side = self.windows[number], self.cell_px
        line, sample = w.line // side, w.sample // side
        last_line, last_sample = -(-(w.line + w.lines) // side), -(-(w.sample + w.samples) // side)
        return Window(line, sample, last_line - line, last_sample - sample)

    def reaching(self, window: Window) -> list[int]:
        """Numbers of the scenes whose windows meet a window of the map."""
        return [k for k, other in enumerate(self.windows) if common_window(window, other) is not None]

    def overlapping(self) -> Iterator[tuple[int, int]]:
        """Pairs of scenes whose windows meet, the lower number first."""
        boxes = [
            shapely.box(w.sample, w.line, w.sample + w.samples, w.line + w.lines) for w in self.windows
        ]
        pairs = shapely.STRtree(boxes).query(boxes).T
        for first, second in sorted(map(tuple, pairs[pairs[:, 0] < pairs[:, 1]].tolist())):
            if common_window(self.windows[first], self.windows[second]) is not None:
                yield first, second


def lay_out(scenes: Sequence[MosaicScene], terrain: Terrain, wanted: MosaicMap) -> Layout:
    """The map over all scenes, or over the outline that is wanted.

    Raises:
        CoverageError: no scene reaches the map, or the terrain does not reach a scene.
        InputError: the reference system is not known, or the map would be too large.
    """
    ground = [_ground(one, terrain) for one in scenes]
    first_lon = ground[0][0, 0]
    for lon_lat in ground:
        lon_lat[:, 0] += 360.0 * np.round((first_lon - lon_lat[0, 0]) / 360.0)
    gsd_m = wanted.gsd_m or min(scene_gsd_m(one.scene) for one in scenes)
    grid = grid_over_ground(np.concatenate(ground), wanted.crs, gsd_m)
    if wanted.outline is not None:
        grid = _part_of(grid, wanted.outline)
    windows = [_window(grid, lon_lat) for lon_lat in ground]
    inside = [k for k, window in enumerate(windows) if window is not None]
    left_out = tuple(one.name for k, one in enumerate(scenes) if windows[k] is None)
    if not inside:
        raise CoverageError(
            f"no scene reaches the map that is wanted ({', '.join(left_out[:5])}); check --bbox"
        )
    kept = tuple(window for window in windows if window is not None)
    largest = max(window.lines * window.samples for window in kept)
    side = max(
        _LEAST_CELL_PX,
        math.ceil(math.sqrt(largest / _SCENE_CELLS)),
        math.ceil(math.sqrt(math.prod(grid.shape) / _MAP_CELLS)),
    )
    return Layout(grid, tuple(scenes[k] for k in inside), kept, left_out, side)


def common_window(a: Window, b: Window) -> Window | None:
    """What two windows have in common."""
    line, sample = max(a.line, b.line), max(a.sample, b.sample)
    lines = min(a.line + a.lines, b.line + b.lines) - line
    samples = min(a.sample + a.samples, b.sample + b.samples) - sample
    return Window(line, sample, lines, samples) if lines > 0 and samples > 0 else None


def inside(window: Window, of: Window) -> tuple[slice, slice]:
    """The place of a window in the array of another one."""
    line, sample = window.line - of.line, window.sample - of.sample
    return slice(line, line + window.lines), slice(sample, sample + window.samples)


def flat_terrain(height_m: float) -> Terrain:
    """Ground of one height everywhere on the Earth."""
    grid = MapGrid(
        "EPSG:4326", np.array([-180.0, 90.0]), np.array([[0.0, 1.0], [-1.0, 0.0]]), (181, 360)
    )
    heights = np.full(grid.shape, height_m, dtype=np.float32)
    return Terrain(grid, ArrayImage(heights), vertical="one height above the ellipsoid")


@dataclass(frozen=True)
class Rectifier:
    """Rectifies scenes onto a map.

    Attributes:
        grid: the map.
        terrain: the ground.
        options: of the rectification.
    """

    grid: MapGrid
    terrain: Terrain
    options: OrthoOptions

    def pixels(self, one: MosaicScene, window: Window, model: SensorModel | None = None) -> FloatImage:
        """Pixels (bands, lines, samples) of a window of a map; NaN without data, +inf where saturated.

        Args:
            one: the scene.
            window: of the map.
            model: instead of that of the scene.
        """
        out = np.empty((len(one.bands), window.lines, window.samples), dtype=np.float32)
        model = model or one.scene.model
        for part in orthorectify(one.bands, model, self.terrain, self.grid, self.options, part=window):
            rows, columns = inside(part.window, window)
            out[:, rows, columns] = part.pixels
        return out


def _ground(one: MosaicScene, terrain: Terrain) -> Array:
    """The ground that a scene shows.

    Raises:
        CoverageError: the terrain does not reach it; names the scene.
    """
    try:
        return seen_ground(one.scene, terrain)
    except CoverageError as error:
        named = str(error).startswith(one.name)
        raise CoverageError(str(error) if named else f"{one.name}: {error}") from error


def _part_of(grid: MapGrid, outline: Array) -> MapGrid:
    """The pixels of a grid that an outline reaches."""
    window = _window(grid, outline)
    if window is None:
        raise CoverageError("no scene reaches the map that is wanted; check --bbox")
    origin = grid.xy(np.array([[window.line, window.sample]], dtype=np.float64))[0]
    return replace(grid, origin_xy=origin, shape=(window.lines, window.samples))


def _window(grid: MapGrid, lon_lat: Array) -> Window | None:
    """The part of a grid around positions (n, 2); None where there is none."""
    xy = continuous_xy(grid.crs, lon_lat)
    position = grid.line_sample_of_xy(xy[np.isfinite(xy).all(axis=1)])
    if not len(position):
        return None
    low = np.floor(position.min(axis=0)).astype(np.int64)
    size = np.ceil(position.max(axis=0)).astype(np.int64) - low + 1
    around = Window(int(low[0]), int(low[1]), int(size[0]), int(size[1]))
    return common_window(around, Window(0, 0, *grid.shape))
