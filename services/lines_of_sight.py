"""The intersection of lines of sight with a terrain."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit

from amers.services.errors import CoverageError
from amers.services.imagery.resampling import finite_bounds
from amers.services.imagery.source import ArrayImage
from amers.services.sensors.base import SensorModel
from amers.services.terrain import Terrain, bilinear_height
from amers.services.types import Array, FloatImage

_TOLERANCE_M = 1e-5
_BOX_NODES = 17
_BOX_MARGIN = 0.01
_BLOCK = 4
"""Side, in nodes, of the blocks whose highest node decides whether a stretch of a line is skipped."""
_BLOCKS = 8
"""Side, in blocks, of the larger blocks for longer stretches."""
_MAX_NODES = 20_000
_GRID_LINE = 1e-9
"""A position nearer than this to a line of the grid is on it, nodes."""
_NONE = -2.0
_MARGIN_M = 1.0
"""The search starts this far above the highest ground, and ends this far below the lowest."""


class _Line(NamedTuple):
    """A line of sight, by u from -1 at the lowest height to 1 at the highest; a tuple for the kernels.

    Attributes:
        row, col: coefficients of 1, u and u^2 of its position in the grid of the terrain.
        geoid_m: coefficients of 1 and u of the geoid below it.
        middle_m, half_m: coefficients of 1 and u of its height above the ellipsoid.
    """

    row: tuple[float, float, float]
    col: tuple[float, float, float]
    geoid_m: tuple[float, float]
    middle_m: float
    half_m: float


def intersect_terrain(model: SensorModel, line_sample: Array, terrain: Terrain) -> Array:
    """First intersection (n, 3) of the lines of sight of image positions with the terrain.

    Each line is followed from above the highest ground downwards, cell by cell of the terrain, until it
    is below the ground; stretches that are above all nodes around are skipped. Regula falsi (Illinois
    variant) then finds the crossing. The search finds the visible side of a ridge, also where a
    fixed-point iteration would jump, and the tip of one that a line only touches. Between the lowest and
    the highest ground, the position of a line in the grid is a quadratic of the height.

    Args:
        model: of the image.
        line_sample: (n, 2) pixels.
        terrain: the ground.

    Returns:
        (n, 3) lon, lat, height; NaN where the line meets a void or no ground.

    Raises:
        CoverageError: no line comes near the grid.
    """
    ground = ground_in_sight(model, line_sample, terrain)
    if not isinstance(ground.heights, ArrayImage) and len(line_sample) > 1:
        return _in_halves(model, line_sample, terrain)
    low_m, high_m = ground.range_m()
    low_m, high_m = low_m - _MARGIN_M, high_m + _MARGIN_M
    heights = np.ascontiguousarray(ground.nodes())
    places = [
        model.locate(line_sample, np.full(len(line_sample), height_m))[:, :2]
        for height_m in (low_m, (low_m + high_m) / 2.0, high_m)
    ]
    low, middle, high = (ground.grid.line_sample(lon_lat) for lon_lat in places)
    undulation_m = np.zeros((len(middle), 2))
    if ground.geoid is not None:
        undulation_m = np.column_stack([_defined(ground.geoid, places[k]) for k in (0, 2)])
    blocks = _highest(heights, _BLOCK)
    summits = _with_neighbours(blocks), _with_neighbours(_highest(blocks, _BLOCKS))
    height_m = _first_crossings(heights, summits, (low, middle, high), undulation_m, (low_m, high_m))
    met = model.locate(line_sample, height_m)
    if ground.geoid is not None:
        # Between the ends of a line, the geoid is not exactly linear.
        exact_m = _defined(ground.height_m, met)
        met = model.locate(line_sample, np.where(np.isfinite(exact_m), exact_m, height_m))
    return met


def ground_in_sight(model: SensorModel, line_sample: Array, terrain: Terrain) -> Terrain:
    """The part of a terrain that lines of sight of image positions (n, 2) can meet.

    Raises:
        CoverageError: no line comes near the grid.
    """
    box = _box_of(line_sample)
    lowest_m, highest_m = model.height_range_m
    ground = terrain.around(_ray_ends(model, box, (lowest_m, highest_m)))
    low_m, high_m = ground.range_m()
    if lowest_m <= low_m and high_m <= highest_m:
        terrain = ground
    return terrain.around(_ray_ends(model, box, (low_m, high_m)))


def _in_halves(model: SensorModel, line_sample: Array, terrain: Terrain) -> Array:
    """As `intersect_terrain`, of each half of the image positions along their longer axis."""
    axis = int(np.argmax(np.ptp(line_sample, axis=0)))
    order = np.argsort(line_sample[:, axis], kind="stable")
    out = np.empty((len(line_sample), 3))
    for half in np.array_split(order, 2):
        try:
            out[half] = intersect_terrain(model, line_sample[half], terrain)
        except CoverageError:
            out[half] = np.nan
    return out


def _box_of(line_sample: Array) -> Array:
    """A grid of image positions around others (n, 2); models are smooth between its nodes."""
    low, high = finite_bounds(line_sample)
    if not (low <= high).all():
        return line_sample
    margin = _BOX_MARGIN * (high - low) + 1.0
    axes = [np.linspace(*ends, _BOX_NODES) for ends in zip(low - margin, high + margin, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def _ray_ends(model: SensorModel, line_sample: Array, heights_m: tuple[float, float]) -> Array:
    """Longitudes and latitudes (2n, 2) of lines of sight at two heights."""
    return np.concatenate(
        [model.locate(line_sample, np.full(len(line_sample), h))[:, :2] for h in heights_m]
    )


def _defined(heights_of: Callable[[Array], Array], ground: Array) -> Array:
    """Heights (n,) at those ground positions (n, 2 or 3) that are known; NaN elsewhere."""
    out = np.full(len(ground), np.nan)
    known = np.isfinite(ground).all(axis=1)
    out[known] = heights_of(ground[known, :2])
    return out


@njit(inline="always", error_model="numpy")
def _gap_m(heights: FloatImage, line: _Line, u: float) -> float:
    """Height of the ground above a line of sight, metres."""
    row = line.row[0] + u * (line.row[1] + u * line.row[2])
    col = line.col[0] + u * (line.col[1] + u * line.col[2])
    ground_m = bilinear_height(heights, row, col) + line.geoid_m[0] + u * line.geoid_m[1]
    return ground_m - line.middle_m - u * line.half_m


@njit(cache=True, error_model="numpy")
def _crossing(  # noqa: PLR0917 - numbers of one line of sight, in its innermost loop
    heights: FloatImage,
    line: _Line,
    above: float,
    below: float,
    gap_above: float,
    gap_below: float,
    u: float,
) -> float:
    """u where a line crosses the ground, between u above the ground and u below it; NaN at a void.

    Args:
        heights: of the grid.
        line: that crosses.
        above, below: u of both places.
        gap_above, gap_below: there.
        u: first try, between them.
    """
    gap = _gap_m(heights, line, u)
    if gap >= 0.0:
        below, gap_below = u, gap
    else:
        above, gap_above = u, gap
    if not abs(gap) > _TOLERANCE_M / 10.0:
        return u
    for _ in range(100):
        if (above - below) * line.half_m < _TOLERANCE_M:
            break
        u = above + gap_above / (gap_above - gap_below) * (below - above)
        gap = _gap_m(heights, line, u)
        if not abs(gap) > _TOLERANCE_M / 10.0:
            break
        if gap > 0.0:
            below, gap_below, gap_above = u, gap, gap_above / 2.0
        else:
            above, gap_above, gap_below = u, gap, gap_below / 2.0
    return np.nan if np.isnan(gap) else u


@njit(cache=True, error_model="numpy")
def _highest(heights: FloatImage, side: int) -> FloatImage:
    """Highest of each block of heights; minus infinity where there is none."""
    shape = (heights.shape[0] - 1) // side + 1, (heights.shape[1] - 1) // side + 1
    out = np.full(shape, -np.inf, dtype=np.float32)
    for i in range(heights.shape[0]):
        for j in range(heights.shape[1]):
            if heights[i, j] > out[i // side, j // side]:
                out[i // side, j // side] = heights[i, j]
    return out


@njit(cache=True, error_model="numpy")
def _with_neighbours(highest: FloatImage) -> FloatImage:
    """Highest of each block and of the blocks beside it."""
    rows, cols = highest.shape
    out = np.empty_like(highest)
    for i in range(rows):
        for j in range(cols):
            summit = highest[i, j]
            for k in range(max(i - 1, 0), min(i + 2, rows)):
                for m in range(max(j - 1, 0), min(j + 2, cols)):
                    summit = max(summit, highest[k, m])
            out[i, j] = summit
    return out


@njit(inline="always", error_model="numpy")
def _summit_m(summits: FloatImage, side: int, line: _Line, u: float) -> float:
    """Highest ground within a block's side, in nodes, of the position of a line."""
    row = (line.row[0] + u * (line.row[1] + u * line.row[2])) / side
    col = (line.col[0] + u * (line.col[1] + u * line.col[2])) / side
    i = min(max(int(row), 0), summits.shape[0] - 1)
    j = min(max(int(col), 0), summits.shape[1] - 1)
    return summits[i, j] + line.geoid_m[0] + abs(line.geoid_m[1])


@njit(inline="always", error_model="numpy")
def _to_grid_line(position: float, speed: float) -> float:
    """The way to the next line of the grid, in u, from a position that moves by -speed per u."""
    cell = np.floor(position)
    way = position - cell if speed > 0.0 else cell + 1.0 - position
    return (way if way > _GRID_LINE else 1.0) / max(abs(speed), _GRID_LINE)


@njit(cache=True, error_model="numpy")
def _next_grid_line(line: _Line, u: float) -> float:
    """The u below a given one where a line of sight reaches the next line of the grid."""
    row = line.row[0] + u * (line.row[1] + u * line.row[2])
    col = line.col[0] + u * (line.col[1] + u * line.col[2])
    to_row = _to_grid_line(row, line.row[1] + 2.0 * u * line.row[2])
    to_col = _to_grid_line(col, line.col[1] + 2.0 * u * line.col[2])
    return u - min(to_row, to_col)


@njit(cache=True, error_model="numpy")
def _crossing_in_cell(  # noqa: PLR0917 - numbers of one line of sight, in its innermost loop
    heights: FloatImage, line: _Line, start: float, end: float, gap_start: float, gap_end: float
) -> float:
    """u where a line first crosses the ground of one cell, a quadratic of u; below -1 for none."""
    if not gap_start < 0.0:
        # A line above a void crosses the ground at an unknown position.
        return np.nan if gap_end >= 0.0 else _NONE
    gap_middle = _gap_m(heights, line, (start + end) / 2.0)
    # The gap is gap_start + slope t + bend t^2, with t from 0 at the start to 1 at the end.
    slope = 4.0 * gap_middle - 3.0 * gap_start - gap_end
    bend = 2.0 * (gap_start - 2.0 * gap_middle + gap_end)
    below, gap_below = 1.0, gap_end
    if not gap_end >= 0.0:
        below = -slope / (2.0 * bend)
        if not (bend < 0.0 and 0.0 < below < 1.0):
            return _NONE
        gap_below = _gap_m(heights, line, start + below * (end - start))
        if not gap_below >= 0.0:
            return _NONE
    root = math.sqrt(max(slope * slope - 4.0 * bend * gap_start, 0.0))
    t = min(max(-2.0 * gap_start / (slope + root), 0.0), below) if slope + root > 0.0 else below / 2.0
    way = end - start
    return _crossing(heights, line, start, start + below * way, gap_start, gap_below, start + t * way)


@njit(cache=True, error_model="numpy")
def _first_crossing(heights: FloatImage, summits: tuple[FloatImage, FloatImage], line: _Line) -> float:
    """u where a line of sight first meets the ground; NaN where unknown."""
    nodes = 2.0 * (abs(line.row[1]) + abs(line.row[2]) + abs(line.col[1]) + abs(line.col[2]))
    if not nodes < _MAX_NODES:
        return np.nan
    stretches = math.ceil(nodes / (_BLOCK - 1)) + 1
    k = 0
    while k < stretches:
        u, end = 1.0 - 2.0 * k / stretches, 1.0 - 2.0 * (k + 1) / stretches
        if k % _BLOCKS == 0:
            far = max(1.0 - 2.0 * (k + _BLOCKS) / stretches, -1.0)
            if _summit_m(summits[1], _BLOCK * _BLOCKS, line, u) < line.middle_m + far * line.half_m:
                k += _BLOCKS
                continue
        k += 1
        if _summit_m(summits[0], _BLOCK, line, u) < line.middle_m + end * line.half_m:
            continue
        gap_m = _gap_m(heights, line, u)
        while u > end:
            below = max(_next_grid_line(line, u), end)
            gap_below_m = _gap_m(heights, line, below)
            crossing = _crossing_in_cell(heights, line, u, below, gap_m, gap_below_m)
            if not crossing <= _NONE:
                return crossing
            u, gap_m = below, gap_below_m
    return np.nan


@njit(inline="always", error_model="numpy")
def _quadratic(low: float, middle: float, high: float) -> tuple[float, float, float]:
    """Coefficients of 1, u and u^2 of the quadratic with these values at -1, 0 and 1."""
    return middle, (high - low) / 2.0, (high + low) / 2.0 - middle


@njit(cache=True, error_model="numpy")
def _first_crossings(
    heights: FloatImage,
    summits: tuple[FloatImage, FloatImage],
    places: tuple[Array, Array, Array],
    undulation_m: Array,
    between_m: tuple[float, float],
) -> Array:
    """Heights (n,) where lines of sight first meet the ground; NaN where unknown.

    With u from -1 at the lowest height to 1 at the highest, a line is at a quadratic of u in the grid.

    Args:
        heights: of the grid, above its vertical datum.
        summits: of the blocks of the same grid and of the larger blocks, each with its neighbours.
        places: (n, 2) of the lines in the grid at the lowest height, the middle and the highest.
        undulation_m: (n, 2) of the geoid at both ends of the line.
        between_m: lowest and highest height, above the ellipsoid.
    """
    middle_m, half_m = (between_m[0] + between_m[1]) / 2.0, (between_m[1] - between_m[0]) / 2.0
    low, middle, high = places
    out = np.full(len(middle), np.nan)
    for i in range(len(middle)):
        low_m, high_m = undulation_m[i]
        geoid_m = ((low_m + high_m) / 2.0, (high_m - low_m) / 2.0)
        row = _quadratic(low[i, 0], middle[i, 0], high[i, 0])
        col = _quadratic(low[i, 1], middle[i, 1], high[i, 1])
        line = _Line(row, col, geoid_m, middle_m, half_m)
        out[i] = middle_m + half_m * _first_crossing(heights, summits, line)
    return out
