"""The surface that one pair of images shows on a tile of the ground."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from amers.services.errors import ComputationError
from amers.services.imagery.scene import Scene
from amers.services.map_grid import MapGrid
from amers.services.surface.match import DenseMatcher, Reason, Reasons, RectifiedPair
from amers.services.surface.rectify import Rectification, rectify, resampled
from amers.services.tasks import Arrays
from amers.services.types import Array, FloatImage, IntArray

_TERMS = 10
"""Terms of the polynomials of the second degree in column, row and disparity."""
_MAX_FIT_M = 0.05
"""Largest error of these polynomials: a tenth of the noise of heights of images of 0.3 m."""


@dataclass(frozen=True)
class PairSurface:
    """The disparities of a pair over a tile, and the ground that they stand for.

    Attributes:
        first, second: (rows, columns) float32, by the pixels of either image; NaN where there is none.
        reason: (rows, columns) uint8, a `Reason`, by the pixels of the first image.
        ground: (10, 3) map coordinates and height as polynomials; see `_terms`.
        centre, scale: (3,) of column, row and disparity in these polynomials.
        px_per_m: disparity for each metre of height, of either sign.
    """

    first: FloatImage
    second: FloatImage
    reason: Reasons
    ground: Array
    centre: Array
    scale: Array
    px_per_m: float

    def points(self) -> Array:
        """Map coordinates and heights (n, 3) of everything that either direction found."""
        rows, columns = np.nonzero(np.isfinite(self.first))
        disparity = self.first[rows, columns]
        other_rows, other_columns = np.nonzero(np.isfinite(self.second))
        other = self.second[other_rows, other_columns]
        return self.positions(
            np.concatenate([rows, other_rows]),
            np.concatenate([columns.astype(np.float64), other_columns + other]),
            np.concatenate([disparity, other]),
        )

    def positions(self, rows: IntArray, columns: IntArray | Array, disparity: Array | FloatImage) -> Array:
        """Map coordinates and heights (n, 3) of pixels of the first image with a disparity."""
        place = np.column_stack([columns, rows, disparity]).astype(np.float64)
        at = (place - self.centre) / self.scale
        return np.asarray(_terms(at) @ self.ground)


def match_pair(
    scenes: tuple[Scene, Scene],
    tile: MapGrid,
    heights_m: tuple[float, float],
    ratio: float,
    matcher: DenseMatcher,
) -> PairSurface | None:
    """The surface of a pair on a tile; None where one of the images or models does not reach it.

    Args:
        scenes: of the pair, with refined models.
        tile: the ground, with a margin around what will be used.
        heights_m: lowest and highest ground and surface there, above the ellipsoid.
        ratio: pixels of the first image for each pixel that is matched.
        matcher: finds the disparities.

    Raises:
        ComputationError: the tile is too large for the approximation of the models.
    """
    first, second = scenes
    rectified = rectify(first.model, second.model, tile, heights_m, ratio)
    if rectified is None:
        return None
    one, one_valid = resampled(first.image, rectified.first, rectified.shape)
    two, two_valid = resampled(second.image, rectified.second, rectified.shape)
    if not (one_valid.any() and two_valid.any()):
        return None
    pair = RectifiedPair(one, two, one_valid, two_valid, *rectified.disparities)
    found = matcher.match(pair)
    ground, centre, scale = _polynomials(rectified)
    disparities = rectified.nodes[:, 2].reshape(3, -1).mean(axis=1)
    levels_m = rectified.xy_h[:, 2].reshape(3, -1).mean(axis=1)
    return PairSurface(
        found.first,
        found.second,
        found.reason,
        ground,
        centre,
        scale,
        float((disparities[2] - disparities[0]) / (levels_m[2] - levels_m[0])),
    )


def match_task(
    scenes: tuple[Scene, Scene],
    tile: MapGrid,
    heights_m: tuple[float, float],
    ratio: float,
    matcher: DenseMatcher,
) -> Arrays:
    """The surface of a pair on a tile as arrays, for `pair_surface`; none where they do not show it."""
    found = match_pair(scenes, tile, heights_m, ratio, matcher)
    return {} if found is None else {name: np.asarray(value) for name, value in vars(found).items()}


def pair_surface(arrays: Arrays) -> PairSurface | None:
    """The surface that `match_task` has returned; None for none."""
    if not arrays:
        return None
    return PairSurface(
        arrays["first"],
        arrays["second"],
        arrays["reason"],
        arrays["ground"],
        arrays["centre"],
        arrays["scale"],
        float(arrays["px_per_m"]),
    )


def cells_of_pair(
    surface: PairSurface, tile: MapGrid, shift_m: Array, reach: float
) -> tuple[FloatImage, Reasons]:
    """The heights (lines, samples) of a pair in the cells of a tile, and why others have none.

    The height of a cell is the median of the points around its centre.

    Args:
        surface: of the pair.
        tile: the cells.
        shift_m: (3,) x, y and height, added to every point, in units of the map and metres.
        reach: largest distance of a point from the centre of the cell, cells.
    """
    xyh = surface.points() + shift_m
    at = tile.line_sample_of_xy(xyh[:, :2])
    heights = _medians(at, xyh[:, 2].astype(np.float32), tile.shape, reach)
    reason = np.full(tile.shape, Reason.OUTSIDE, dtype=np.uint8)
    reason[np.isfinite(heights)] = Reason.FOUND
    rows, columns = np.nonzero(~np.isfinite(surface.first))
    ground = float(np.nanmedian(heights)) if np.isfinite(heights).any() else surface.ground[0, 2]
    middle = surface.centre[2] + (ground - surface.ground[0, 2]) * surface.px_per_m
    xyh = surface.positions(rows, columns, np.full(len(rows), middle)) + shift_m
    _mark(reason, tile.line_sample_of_xy(xyh[:, :2]), surface.reason[rows, columns])
    return heights, reason


def _polynomials(rectified: Rectification) -> tuple[Array, Array, Array]:
    """Coefficients, centre and scale of the ground by column, row and disparity."""
    low, high = rectified.nodes.min(axis=0), rectified.nodes.max(axis=0)
    centre, scale = (low + high) / 2.0, np.maximum((high - low) / 2.0, 1.0)
    terms = _terms((rectified.nodes - centre) / scale)
    ground = np.linalg.lstsq(terms, rectified.xy_h)[0]
    error_m = float(np.abs(terms @ ground - rectified.xy_h)[:, 2].max())
    if error_m > _MAX_FIT_M:
        raise ComputationError(
            f"the models of a pair are approximated within {error_m:.2g} m of height on a tile, at most "
            f"{_MAX_FIT_M:g} m are allowed: choose smaller tiles"
        )
    return np.asarray(ground), np.asarray(centre), np.asarray(scale)


def _terms(at: Array) -> Array:
    """(n, 10) terms of the second degree of (n, 3) columns, rows and disparities."""
    c, r, d = at.T
    return np.stack([np.ones_like(c), c, r, d, c * r, c * d, r * d, c * c, r * r, d * d], axis=1)


@njit(cache=True)
def _medians(at: Array, heights: FloatImage, shape: tuple[int, int], reach: float) -> FloatImage:
    """Median (lines, samples) of the heights (n,) at positions (n, 2) near every cell; NaN for none."""
    lines, samples = shape
    start = np.zeros(lines * samples + 1, dtype=np.int64)
    nothing = np.empty(0, dtype=np.float32)
    for p in range(len(heights)):
        _near_cells(at[p], np.float32(0.0), shape, reach, start[1:], nothing)
    start = np.cumsum(start)
    values = np.empty(start[-1], dtype=np.float32)
    place = start[:-1].copy()
    for p in range(len(heights)):
        _near_cells(at[p], heights[p], shape, reach, place, values)
    out = np.full((lines, samples), np.nan, dtype=np.float32)
    for cell in range(lines * samples):
        if start[cell + 1] > start[cell]:
            out[cell // samples, cell % samples] = np.median(values[start[cell] : start[cell + 1]])
    return out


@njit(cache=True)
def _near_cells(  # noqa: PLR0917 - arrays of the innermost loop
    at: Array,
    height: np.float32,
    shape: tuple[int, int],
    reach: float,
    place: IntArray,
    values: FloatImage,
) -> None:
    """Count a point for the cells around it in `place`; with values, write its height there."""
    whole = int(np.ceil(reach))
    if not (-whole <= at[0] < shape[0] + whole and -whole <= at[1] < shape[1] + whole):
        return
    line, sample = int(np.round(at[0])), int(np.round(at[1]))
    for i in range(max(line - whole, 0), min(line + whole + 1, shape[0])):
        for j in range(max(sample - whole, 0), min(sample + whole + 1, shape[1])):
            if (i - at[0]) ** 2 + (j - at[1]) ** 2 <= reach * reach:
                cell = i * shape[1] + j
                if len(values):
                    values[place[cell]] = height
                place[cell] += 1


@njit(cache=True)
def _mark(reason: Reasons, at: Array, reasons: Reasons) -> None:
    """Give cells without a height the strongest reason of the pixels in and next to them."""
    lines, samples = reason.shape
    for p in range(len(reasons)):
        if not (-1.0 < at[p, 0] < lines and -1.0 < at[p, 1] < samples):
            continue
        line, sample = int(np.round(at[p, 0])), int(np.round(at[p, 1]))
        for i in range(max(line - 1, 0), min(line + 2, lines)):
            for j in range(max(sample - 1, 0), min(sample + 2, samples)):
                if reason[i, j] != 0 and reasons[p] > reason[i, j]:
                    reason[i, j] = reasons[p]
