"""Image positions of the pixels of a map, through the model of the image and the terrain.

The model projects nodes of the map at three heights. Positions are bilinear between the nodes and
quadratic between the heights; the height is that of the terrain at each pixel. So the relief is
followed exactly, and the model, which is smooth, is approximated within a tolerance. The error is
checked where it is largest: at the centres of the cells and between the heights.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from amers.services.errors import ComputationError
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.sensors.base import SensorModel
from amers.services.terrain import Terrain
from amers.services.types import Array, BoolArray, FloatImage

NODE_PX = 64
"""Map pixels between the nodes at the start."""
_WORST_HEIGHT = math.sqrt(1.0 / 3.0)
"""Where the difference between a cubic and the quadratic through -1, 0 and 1 is largest."""
_OCCLUSION_M = 0.1
"""Ground that rises above a line of sight by more than this occludes the ground behind it."""
_MAX_STEPS = 4096
_ROUNDING_NODES = 1e-6
"""Positions in the terrain that differ by less are the same."""


@dataclass(frozen=True)
class Mapping:
    """Positions in an image of the pixels of a window of a map.

    Attributes:
        line_sample: (lines, samples, 2) pixels of the image; NaN where the terrain or the model is
            undefined.
        height_m: (lines, samples) of the ground, metres above the ellipsoid.
        error_px: largest difference from the projection of the model at the positions checked.
    """

    line_sample: Array
    height_m: FloatImage
    error_px: float


@dataclass(frozen=True)
class _Ground:
    """The terrain around a window of a map.

    Attributes:
        heights: (lines, samples) in the vertical datum of the terrain; NaN in voids.
        first: (2,) line and sample of its first node in the grid of the terrain.
    """

    heights: FloatImage
    first: Array


class _HeightRange(NamedTuple):
    """Heights above the ellipsoid between which positions are interpolated; a tuple for the kernels."""

    low_m: float
    high_m: float


class _LineOfSight(NamedTuple):
    """The way towards the sensor through the terrain; a tuple for the kernels.

    Attributes:
        line_per_m, sample_per_m: nodes of the terrain per metre of height.
        undulation_m: of the geoid that the heights of the terrain refer to.
        highest_m: highest ground, in the vertical datum of the terrain.
    """

    line_per_m: float
    sample_per_m: float
    undulation_m: float
    highest_m: float


@dataclass(frozen=True)
class _Table:
    """What is interpolated between the nodes of a window.

    Attributes:
        nodes: (r, c, 2) map pixels of the nodes.
        values: (r, c, 9) at the nodes: image position (2), its first and second order by the height (4),
            position in `ground` (2), undulation of the geoid in metres.
        ground: the terrain around the window.
        heights: range of the heights.
    """

    nodes: Array
    values: Array
    ground: _Ground
    heights: _HeightRange


def map_into_image(
    model: SensorModel, terrain: Terrain, grid: MapGrid, window: Window, tolerance_px: float
) -> Mapping | None:
    """Positions in an image of a window of a map; None where the terrain is void in the whole window.

    Args:
        model: of the image.
        terrain: the ground.
        grid: the map.
        window: of the map, inside its grid.
        tolerance_px: largest error of the positions, image pixels.

    Raises:
        ComputationError: nodes at every second pixel exceed the tolerance.
    """
    step = NODE_PX
    while True:
        table = _table(model, terrain, grid, _nodes(window, step))
        if table is None:
            return None
        error_px = _error_px(model, terrain, grid, table)
        if not error_px > tolerance_px:
            break
        step //= 2
        if step < 2:
            raise ComputationError(
                f"the model of the image cannot be interpolated within {tolerance_px:g} px: nodes at "
                f"every second pixel leave an error of {error_px:.3g} px. Give a larger `tolerance_px`"
            )
    line_sample, height_m = _positions(
        table.values, table.ground.heights, step, (window.lines, window.samples), table.heights
    )
    return Mapping(line_sample, height_m, 0.0 if math.isnan(error_px) else error_px)


def occluded_ground(
    model: SensorModel, terrain: Terrain, grid: MapGrid, window: Window, height_m: FloatImage
) -> BoolArray:
    """Which ground (lines, samples) of a window other ground hides from the sensor.

    From each pixel the line of sight is followed towards the sensor, a quarter of a node of the
    terrain a step, until it is higher than all the terrain around.

    Args:
        model: of the image; its direction of view is taken as constant within the window.
        terrain: the ground.
        grid: the map.
        window: of the map.
        height_m: (lines, samples) of the ground, metres, see `map_into_image`.
    """
    hidden = np.zeros(height_m.shape, dtype=bool)
    corner = np.array([[window.line, window.sample]], dtype=np.float64)
    size = np.array([window.lines - 1, window.samples - 1], dtype=np.float64)
    centre = grid.lon_lat(corner + size / 2.0)
    low, high = float(np.nanmin(height_m)), terrain.range_m()[1]
    start = np.column_stack([centre, [low]])
    seen = model.project(start)
    rise_m = min(max(high - low, 1.0), 500.0)
    towards = model.locate(seen, np.array([low + rise_m]))
    node = terrain.grid.line_sample(np.concatenate([centre, towards[:, :2]]))
    per_metre = (node[1] - node[0]) / rise_m
    if not np.isfinite(per_metre).all() or np.abs(per_metre).max() * (high - low) < 0.5:
        return hidden
    nodes = _nodes(window, NODE_PX)
    lon_lat = grid.lon_lat(nodes.reshape(-1, 2))
    position = terrain.grid.line_sample(lon_lat)
    reach = position + per_metre * (high - low)
    ground = _ground_around(terrain, np.concatenate([position, reach]))
    if ground is None:
        return hidden
    undulation = 0.0
    if terrain.geoid is not None:
        undulation = float(np.nanmean(terrain.geoid(lon_lat)))
    offset = np.ascontiguousarray((position - ground.first).reshape(*nodes.shape[:2], 2))
    highest_m = float(np.nanmax(ground.heights))
    sight = _LineOfSight(float(per_metre[0]), float(per_metre[1]), undulation, highest_m)
    _mark_occluded(hidden, height_m, offset, ground.heights, sight)
    return hidden


def _nodes(window: Window, step: int) -> Array:
    """Map pixels (r, c, 2) of nodes that cover a window, the last ones at or beyond its end."""
    lines = window.line + step * np.arange(-(-max(window.lines - 1, 1) // step) + 1)
    samples = window.sample + step * np.arange(-(-max(window.samples - 1, 1) // step) + 1)
    return np.stack(np.meshgrid(lines, samples, indexing="ij"), axis=-1).astype(np.float64)


def _ground_around(terrain: Terrain, position: Array) -> _Ground | None:
    """The terrain under positions (n, 2) in its grid; None where all of it is void."""
    defined = position[np.isfinite(position).all(axis=1)]
    if not len(defined):
        return None
    last = np.array(terrain.grid.shape) - 1
    low = np.clip(np.floor(defined.min(axis=0)).astype(np.int64) - 1, 0, last)
    high = np.clip(np.ceil(defined.max(axis=0)).astype(np.int64) + 1, 0, last)
    lines, samples = (int(size) for size in high - low + 1)
    heights = terrain.heights.read(Window(int(low[0]), int(low[1]), lines, samples))
    if not np.isfinite(heights).any():
        return None
    return _Ground(heights, low.astype(np.float64))


def _table(model: SensorModel, terrain: Terrain, grid: MapGrid, nodes: Array) -> _Table | None:
    """The values at nodes (r, c, 2) of a map; None where the terrain around them is void."""
    lon_lat = grid.lon_lat(nodes.reshape(-1, 2))
    position = terrain.grid.line_sample(lon_lat)
    ground = _ground_around(terrain, position)
    if ground is None:
        return None
    undulation = np.zeros(len(lon_lat))
    if terrain.geoid is not None:
        undulation = terrain.geoid(lon_lat)
    low_m = float(np.nanmin(ground.heights)) + float(np.nanmin(undulation))
    high_m = float(np.nanmax(ground.heights)) + float(np.nanmax(undulation)) + 1.0
    at = [
        model.project(np.column_stack([lon_lat, np.full(len(lon_lat), height_m)]))
        for height_m in (low_m, (low_m + high_m) / 2.0, high_m)
    ]
    first, second = (at[2] - at[0]) / 2.0, (at[2] + at[0]) / 2.0 - at[1]
    values = np.column_stack([at[1], first, second, position - ground.first, undulation])
    values = np.ascontiguousarray(values.reshape(*nodes.shape[:2], 9))
    return _Table(nodes, values, ground, _HeightRange(low_m, high_m))


def _error_px(model: SensorModel, terrain: Terrain, grid: MapGrid, table: _Table) -> float:
    """Largest error in pixels of positions at the centres of the cells; NaN where no cell is defined."""
    nodes, values, (low_m, high_m) = table.nodes, table.values, table.heights
    centre = (nodes[:-1, :-1] + nodes[1:, 1:]).reshape(-1, 2) / 2.0
    mean = (values[:-1, :-1] + values[1:, 1:] + values[:-1, 1:] + values[1:, :-1]).reshape(-1, 9) / 4.0
    lon_lat = grid.lon_lat(centre)
    errors = [math.nan]
    for u in (-_WORST_HEIGHT, 0.0, _WORST_HEIGHT):
        height = np.full(len(lon_lat), (low_m + high_m) / 2.0 + u * (high_m - low_m) / 2.0)
        exact = model.project(np.column_stack([lon_lat, height]))
        error = np.hypot(*(mean[:, :2] + u * mean[:, 2:4] + u * u * mean[:, 4:6] - exact).T)
        errors += error[np.isfinite(error)].tolist()
    # An error of the position in the terrain counts as that fraction of a map pixel.
    exact = terrain.grid.line_sample(lon_lat) - table.ground.first
    per_pixel = (
        np.abs(values[1:, 1:, 6:8] - values[:-1, :-1, 6:8]).max() / (nodes[1, 1] - nodes[0, 0]).max()
    )
    error = np.abs(mean[:, 6:8] - exact).max(axis=1) / max(float(per_pixel), 1e-12)
    errors += error[np.isfinite(error)].tolist()
    return float(np.nanmax(errors)) if len(errors) > 1 else math.nan


@njit(inline="always", error_model="numpy")
def _at_node(position: float) -> float:
    """A position along an axis of a grid, or its node where it differs by rounding alone."""
    node = np.floor(position + 0.5)
    return node if abs(position - node) < _ROUNDING_NODES else position


@njit(inline="always", error_model="numpy")
def _height(heights: FloatImage, line: float, sample: float) -> float:
    """Bilinear height; constant for half a node beyond the grid, NaN farther out and beside voids.

    A void with zero weight does not count: a node has its height, whatever lies beside it.
    """
    lines, samples = heights.shape
    if not (-0.5 <= line <= lines - 0.5 and -0.5 <= sample <= samples - 0.5):
        return np.nan
    line = _at_node(min(max(line, 0.0), lines - 1.0))
    sample = _at_node(min(max(sample, 0.0), samples - 1.0))
    i, j = int(line), int(sample)
    fi, fj = line - i, sample - j
    i1 = i + 1 if fi > 0.0 else i
    j1 = j + 1 if fj > 0.0 else j
    a, b = float(heights[i, j]), float(heights[i, j1])
    c, d = float(heights[i1, j]), float(heights[i1, j1])
    top = a + fj * (b - a)
    return top + fi * (c + fj * (d - c) - top)


@njit(cache=True, error_model="numpy")
def _positions(
    table: Array, heights: FloatImage, step: int, shape: tuple[int, int], height_range: _HeightRange
) -> tuple[Array, FloatImage]:
    """Image positions (lines, samples, 2) and ground heights (lines, samples) of a window.

    Args:
        table: `_Table.values`.
        heights: of the terrain around.
        step: map pixels between nodes.
        shape: lines and samples of the window.
        height_range: `_Table.heights`.
    """
    lines, samples = shape
    middle = (height_range.low_m + height_range.high_m) / 2.0
    half = (height_range.high_m - height_range.low_m) / 2.0
    out = np.empty((lines, samples, 2))
    ground = np.empty((lines, samples), dtype=np.float32)
    cells = table.shape[1] - 1
    row = np.empty((table.shape[1], 9))
    for r in range(lines):
        i = min(r // step, table.shape[0] - 2)
        f = (r - i * step) / step
        for c in range(table.shape[1]):
            for k in range(9):
                row[c, k] = table[i, c, k] + f * (table[i + 1, c, k] - table[i, c, k])
        for c in range(cells):
            a, d = row[c], (row[c + 1] - row[c]) / step
            last = samples if c == cells - 1 else min(samples, (c + 1) * step)
            for s in range(c * step, last):
                t = float(s - c * step)
                h = _height(heights, a[6] + t * d[6], a[7] + t * d[7]) + a[8] + t * d[8]
                u = (h - middle) / half
                out[r, s, 0] = a[0] + t * d[0] + u * (a[2] + t * d[2] + u * (a[4] + t * d[4]))
                out[r, s, 1] = a[1] + t * d[1] + u * (a[3] + t * d[3] + u * (a[5] + t * d[5]))
                ground[r, s] = h
    return out, ground


@njit(cache=True, error_model="numpy")
def _mark_occluded(
    hidden: BoolArray, height_m: FloatImage, offset: Array, heights: FloatImage, sight: _LineOfSight
) -> None:
    """Set `hidden` where ground is occluded; `offset` (r, c, 2) are the map nodes in `heights`."""
    rise = 0.25 / max(abs(sight.line_per_m), abs(sight.sample_per_m))
    lines, samples = hidden.shape
    for r in range(lines):
        i = min(r // NODE_PX, offset.shape[0] - 2)
        fi = (r - i * NODE_PX) / NODE_PX
        for s in range(samples):
            j = min(s // NODE_PX, offset.shape[1] - 2)
            fj = (s - j * NODE_PX) / NODE_PX
            top = offset[i, j] + fj * (offset[i, j + 1] - offset[i, j])
            bottom = offset[i + 1, j] + fj * (offset[i + 1, j + 1] - offset[i + 1, j])
            line, sample = top + fi * (bottom - top)
            ray = height_m[r, s] - sight.undulation_m
            for _ in range(_MAX_STEPS):
                ray += rise
                if not ray < sight.highest_m:
                    break
                line += rise * sight.line_per_m
                sample += rise * sight.sample_per_m
                if _height(heights, line, sample) > ray + _OCCLUSION_M:
                    hidden[r, s] = True
                    break
