"""Where the pixels of a map lie in an image, through its model and the terrain.

The model is asked at nodes of the map and at three heights. Between the nodes positions are bilinear,
between the heights quadratic; the height itself is that of the terrain at each pixel. So relief is
followed exactly, and the model, which is smooth, is approximated within a tolerance. That is checked
where the approximation is worst: in the middle of the cells and between the heights.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from services.errors import ComputationError
from services.geodesy import metres_per_degree
from services.imagery.source import Window
from services.map_grid import MapGrid
from services.sensors.base import SensorModel
from services.terrain import Terrain
from services.types import Array, BoolArray, FloatImage

NODE_PX = 64
"""Map pixels between the nodes, to begin with."""
_BETWEEN = math.sqrt(1.0 / 3.0)
"""Where between three heights, -1, 0, 1, a quadratic misses a cubic most."""
_HIDDEN_BY_M = 0.1
"""Ground that stands higher than this into a line of sight hides what is behind it."""
_MOST_STEPS = 4096


@dataclass(frozen=True)
class Mapping:
    """Where the pixels of a window of a map lie in an image.

    Attributes:
        line_sample: (lines, samples, 2) pixels of the image; NaN where there is no ground or no model.
        height_m: (lines, samples) above the ellipsoid, of the ground.
        error_px: largest difference from the model itself among the places it was checked at.
    """

    line_sample: Array
    height_m: FloatImage
    error_px: float


@dataclass(frozen=True)
class _Ground:
    """Terrain around a window of a map.

    Attributes:
        heights: (lines, samples) as the terrain counts them, NaN in voids.
        first: (2,) line and sample of its first node in the terrain's grid.
    """

    heights: FloatImage
    first: Array


def map_into_image(
    model: SensorModel, terrain: Terrain, grid: MapGrid, window: Window, tolerance_px: float
) -> Mapping | None:
    """Where a window of a map lies in an image; None where it has no known ground.

    Args:
        model: of the image.
        terrain: the ground.
        grid: the map.
        window: of the map, inside its grid.
        tolerance_px: how far positions may be from the model's, image pixels.

    Raises:
        ComputationError: when not even nodes at every second pixel are near enough.
    """
    step = NODE_PX
    while True:
        nodes = _nodes(window, step)
        lon_lat = grid.lon_lat(nodes.reshape(-1, 2))
        position = terrain.grid.line_sample(lon_lat)
        ground = _ground_around(terrain, position)
        if ground is None:
            return None
        undulation = np.zeros(len(lon_lat))
        if terrain.geoid is not None:
            undulation = terrain.geoid(lon_lat)
        low = float(np.nanmin(ground.heights)) + float(np.nanmin(undulation))
        high = float(np.nanmax(ground.heights)) + float(np.nanmax(undulation)) + 1.0
        table = _table(model, lon_lat, position - ground.first, undulation, low, high)
        table = np.ascontiguousarray(table.reshape(*nodes.shape[:2], 9))
        error_px = _error_px(model, terrain, grid, nodes, table, ground, low, high)
        if not error_px > tolerance_px:
            break
        step //= 2
        if step < 2:
            raise ComputationError(
                f"the model of the image is too rough to be rectified within {tolerance_px:g} px: "
                f"nodes at every second pixel miss it by {error_px:.3g} px"
            )
    line_sample, height_m = _positions(
        table, ground.heights, step, window.lines, window.samples, (low + high) / 2.0, (high - low) / 2.0
    )
    return Mapping(line_sample, height_m, 0.0 if math.isnan(error_px) else error_px)


def occluded_ground(
    model: SensorModel, terrain: Terrain, grid: MapGrid, window: Window, height_m: FloatImage
) -> BoolArray:
    """Which ground (lines, samples) of a window other ground hides from the sensor.

    From each place a step after the other is made towards the sensor, each over half a node of the
    terrain, until nothing of the terrain is as high any more.

    Args:
        model: of the image; its direction of view is taken as one within the window.
        terrain: the ground.
        grid: the map.
        window: of the map.
        height_m: (lines, samples) of the ground, as of `map_into_image`.
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
    highest = float(np.nanmax(ground.heights))
    _hide(hidden, height_m, offset, ground.heights, per_metre, undulation, highest)
    return hidden


def _nodes(window: Window, step: int) -> Array:
    """Map pixels (r, c, 2) of nodes all over a window and just beyond its end."""
    lines = window.line + step * np.arange(-(-max(window.lines - 1, 1) // step) + 1)
    samples = window.sample + step * np.arange(-(-max(window.samples - 1, 1) // step) + 1)
    return np.stack(np.meshgrid(lines, samples, indexing="ij"), axis=-1).astype(np.float64)


def _ground_around(terrain: Terrain, position: Array) -> _Ground | None:
    """The terrain under some of its positions (n, 2); None where it has no height."""
    known = position[np.isfinite(position).all(axis=1)]
    if not len(known):
        return None
    last = np.array(terrain.grid.shape) - 1
    low = np.clip(np.floor(known.min(axis=0)).astype(np.int64) - 1, 0, last)
    high = np.clip(np.ceil(known.max(axis=0)).astype(np.int64) + 1, 0, last)
    lines, samples = (int(size) for size in high - low + 1)
    heights = terrain.heights.read(Window(int(low[0]), int(low[1]), lines, samples))
    if not np.isfinite(heights).any():
        return None
    return _Ground(heights, low.astype(np.float64))


def _table(
    model: SensorModel, lon_lat: Array, position: Array, undulation: Array, low: float, high: float
) -> Array:
    """What is interpolated (n, 9): line and sample with their first and second orders by the height,
    position in the terrain, geoid."""
    at = [
        model.project(np.column_stack([lon_lat, np.full(len(lon_lat), h)]))
        for h in (low, (low + high) / 2.0, high)
    ]
    first, second = (at[2] - at[0]) / 2.0, (at[2] + at[0]) / 2.0 - at[1]
    return np.column_stack([at[1], first, second, position, undulation])


def _error_px(
    model: SensorModel,
    terrain: Terrain,
    grid: MapGrid,
    nodes: Array,
    table: Array,
    ground: _Ground,
    low: float,
    high: float,
) -> float:
    """How far interpolated positions are from the model's in the middle of the cells; NaN: no cell."""
    middle = (nodes[:-1, :-1] + nodes[1:, 1:]).reshape(-1, 2) / 2.0
    mean = (table[:-1, :-1] + table[1:, 1:] + table[:-1, 1:] + table[1:, :-1]).reshape(-1, 9) / 4.0
    lon_lat = grid.lon_lat(middle)
    worst = [math.nan]
    for u in (-_BETWEEN, 0.0, _BETWEEN):
        height = np.full(len(lon_lat), (low + high) / 2.0 + u * (high - low) / 2.0)
        exact = model.project(np.column_stack([lon_lat, height]))
        off = np.hypot(*(mean[:, :2] + u * mean[:, 2:4] + u * u * mean[:, 4:6] - exact).T)
        worst += off[np.isfinite(off)].tolist()
    # A place in the terrain that is off counts as that part of a map pixel.
    exact = terrain.grid.line_sample(lon_lat) - ground.first
    per_pixel = (
        np.abs(table[1:, 1:, 6:8] - table[:-1, :-1, 6:8]).max() / (nodes[1, 1] - nodes[0, 0]).max()
    )
    off = np.abs(mean[:, 6:8] - exact).max(axis=1) / max(float(per_pixel), 1e-12)
    worst += off[np.isfinite(off)].tolist()
    return float(np.nanmax(worst)) if len(worst) > 1 else math.nan


@njit(inline="always", error_model="numpy")
def _height(heights: FloatImage, line: float, sample: float) -> float:
    """Bilinear height; the outermost hold half a step beyond, NaN further out and beside voids."""
    lines, samples = heights.shape
    if not (-0.5 <= line <= lines - 0.5 and -0.5 <= sample <= samples - 0.5):
        return np.nan
    line = min(max(line, 0.0), lines - 1.0)
    sample = min(max(sample, 0.0), samples - 1.0)
    i, j = min(int(line), max(lines - 2, 0)), min(int(sample), max(samples - 2, 0))
    i1, j1 = min(i + 1, lines - 1), min(j + 1, samples - 1)
    fi, fj = line - i, sample - j
    a, b = float(heights[i, j]), float(heights[i, j1])
    c, d = float(heights[i1, j]), float(heights[i1, j1])
    top = a + fj * (b - a)
    return top + fi * (c + fj * (d - c) - top)


@njit(cache=True, error_model="numpy")
def _positions(
    table: Array, heights: FloatImage, step: int, lines: int, samples: int, middle: float, half: float
) -> tuple[Array, FloatImage]:
    """Image positions (lines, samples, 2) and ground heights (lines, samples) of a window."""
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
def _hide(
    hidden: BoolArray,
    height_m: FloatImage,
    offset: Array,
    heights: FloatImage,
    per_metre: Array,
    undulation: float,
    highest: float,
) -> None:
    """Mark what is hidden; `offset` are the positions of nodes of the map in `heights`."""
    rise = 0.5 / max(abs(per_metre[0]), abs(per_metre[1]))
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
            ray = height_m[r, s] - undulation
            for _ in range(_MOST_STEPS):
                ray += rise
                if not ray < highest:
                    break
                line += rise * per_metre[0]
                sample += rise * per_metre[1]
                if _height(heights, line, sample) > ray + _HIDDEN_BY_M:
                    hidden[r, s] = True
                    break


def metres_a_unit(crs_is_geographic: bool, lat: float) -> tuple[float, float]:
    """Metres a unit of a map along x and y: of a degree, or one."""
    return metres_per_degree(lat, 0.0) if crs_is_geographic else (1.0, 1.0)
