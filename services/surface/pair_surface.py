"""The surface that one pair of images shows on a tile of the ground."""

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from amers.services.errors import ComputationError
from amers.services.imagery.scene import Scene
from amers.services.map_grid import MapGrid
from amers.services.surface.match import DenseMatcher, Disparities, Reason, Reasons, RectifiedPair
from amers.services.surface.rectify import LEVELS, Rectification, rectify, resampled
from amers.services.tasks import Arrays
from amers.services.types import Array, BoolArray, FloatImage, IntArray

_UNMARKED = np.uint8(255)
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

    def on_cells(self, tile: MapGrid, shift_m: Array) -> Array:
        """The polynomials (10, 3) with lines and samples of a tile instead of map coordinates.

        Args:
            tile: the cells.
            shift_m: (3,) x, y and height, added to every point.
        """
        moved = self.ground.copy()
        moved[0] += shift_m
        moved[0, :2] -= tile.origin_xy
        moved[:, :2] = moved[:, :2] @ np.linalg.inv(tile.step_xy).T
        return moved


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
    one, one_unseen = resampled(first.image, rectified.first, rectified.shape)
    two, two_unseen = resampled(second.image, rectified.second, rectified.shape)
    valid = one_unseen == Reason.FOUND, two_unseen == Reason.FOUND
    if not (valid[0].any() and valid[1].any()):
        return None
    found = matcher.match(RectifiedPair(one, two, *valid, *rectified.disparities))
    for unseen in (_unseen_by_second(found, two_unseen), one_unseen):
        found.reason[unseen != Reason.FOUND] = unseen[unseen != Reason.FOUND]
    ground, centre, scale = _polynomials(rectified)
    disparities = rectified.nodes[:, 2].reshape(LEVELS, -1).mean(axis=1)
    levels_m = rectified.xy_h[:, 2].reshape(LEVELS, -1).mean(axis=1)
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
    place = (surface.on_cells(tile, shift_m), surface.centre, surface.scale)
    points = np.concatenate(
        [_placed(surface.first, False, *place), _placed(surface.second, True, *place)]
    )
    heights = _medians(points, tile.shape, reach)
    reason = np.where(np.isfinite(heights), np.uint8(Reason.FOUND), _UNMARKED)
    ground = float(np.nanmedian(points[:, 2])) if len(points) else surface.ground[0, 2]
    middle = surface.centre[2] + (ground - surface.ground[0, 2]) * surface.px_per_m
    missing = ~np.isfinite(surface.first)
    supposed = np.where(missing, np.float32(middle), np.float32(np.nan))
    _mark(reason, _placed(supposed, False, *place), surface.reason[missing])
    # No pixel of the first image shows this ground: it did not look there, or something stood before it.
    looked = _looked_at(surface, *place, middle, tile.shape)
    reason[reason == _UNMARKED] = np.where(looked, Reason.HIDDEN, Reason.OUTSIDE)[reason == _UNMARKED]
    return heights, reason


def _looked_at(  # noqa: PLR0917 - a place is three arrays
    surface: PairSurface,
    ground: Array,
    centre: Array,
    scale: Array,
    middle: float,
    shape: tuple[int, int],
) -> BoolArray:
    """The cells (lines, samples) of the quadrangle that the rectified image covers."""
    rows, columns = surface.first.shape
    corners = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]], dtype=np.float64)
    place = np.column_stack([corners, np.full(len(corners), middle)])
    outline = (_terms((place - centre) / scale) @ ground)[:, [1, 0]]
    covered = np.zeros(shape, dtype=np.uint8)
    cv2.fillConvexPoly(covered, outline.round().astype(np.int32), 1)
    return np.asarray(covered, dtype=np.bool_)


def _unseen_by_second(found: Disparities, unseen: Reasons) -> Reasons:
    """Why the second image would not show pixels without a match, were they as high as most."""
    known = found.first[np.isfinite(found.first)]
    places = np.arange(found.first.shape[1]) - (round(float(np.median(known))) if len(known) else 0)
    inside = (places >= 0) & (places < unseen.shape[1])
    there = np.where(inside, unseen[:, np.clip(places, 0, unseen.shape[1] - 1)], Reason.OUTSIDE)
    return np.where(found.reason == Reason.HIDDEN, there, Reason.FOUND).astype(np.uint8)


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
def _placed(
    disparity: FloatImage, of_second: bool, ground: Array, centre: Array, scale: Array
) -> FloatImage:
    """Line, sample and height (n, 3) of all pixels with a disparity, row after row.

    Args:
        disparity: (rows, columns); NaN where there is none.
        of_second: pixels are those of the second image.
        ground: (10, 3) polynomials; see `PairSurface.on_cells`.
        centre, scale: of them.
    """
    rows, columns = disparity.shape
    out = np.empty((np.isfinite(disparity).sum(), 3), dtype=np.float32)
    count = 0
    for i in range(rows):
        r = (i - centre[1]) / scale[1]
        for j in range(columns):
            value = disparity[i, j]
            if not np.isfinite(value):
                continue
            c = (j + (value if of_second else 0.0) - centre[0]) / scale[0]
            d = (value - centre[2]) / scale[2]
            for k in range(3):
                g = ground[:, k]
                linear = g[0] + c * (g[1] + r * g[4] + c * g[7]) + r * (g[2] + r * g[8])
                out[count, k] = linear + d * (g[3] + c * g[5] + r * g[6] + d * g[9])
            count += 1
    return out


@njit(cache=True)
def _medians(points: FloatImage, shape: tuple[int, int], reach: float) -> FloatImage:
    """Median (lines, samples) of the heights of points (n, 3) near every cell; NaN for none."""
    lines, samples = shape
    start = np.zeros(lines * samples + 1, dtype=np.int64)
    nothing = np.empty(0, dtype=np.float32)
    for p in range(len(points)):
        _near_cells(points[p], shape, reach, start[1:], nothing)
    start = np.cumsum(start)
    values = np.empty(start[-1], dtype=np.float32)
    place = start[:-1].copy()
    for p in range(len(points)):
        _near_cells(points[p], shape, reach, place, values)
    out = np.full((lines, samples), np.nan, dtype=np.float32)
    for cell in range(lines * samples):
        first, count = start[cell], start[cell + 1] - start[cell]
        if count:
            own = values[first : first + count]
            for k in range(1, count):  # few values: sorted faster so than by any other means
                value, m = own[k], k
                while m > 0 and own[m - 1] > value:
                    own[m] = own[m - 1]
                    m -= 1
                own[m] = value
            out[cell // samples, cell % samples] = (own[(count - 1) // 2] + own[count // 2]) / 2.0
    return out


@njit(cache=True)
def _near_cells(
    point: FloatImage, shape: tuple[int, int], reach: float, place: IntArray, values: FloatImage
) -> None:
    """Count a point for the cells around it in `place`; with values, write its height there."""
    first = max(int(np.ceil(point[0] - reach)), 0), max(int(np.ceil(point[1] - reach)), 0)
    last = int(np.floor(point[0] + reach)), int(np.floor(point[1] + reach))
    for i in range(first[0], min(last[0] + 1, shape[0])):
        for j in range(first[1], min(last[1] + 1, shape[1])):
            if (i - point[0]) ** 2 + (j - point[1]) ** 2 <= reach * reach:
                cell = i * shape[1] + j
                if len(values):
                    values[place[cell]] = point[2]
                place[cell] += 1


@njit(cache=True)
def _mark(reason: Reasons, at: FloatImage, reasons: Reasons) -> None:
    """Give cells without a height the strongest reason of the pixels in and next to them."""
    lines, samples = reason.shape
    for p in range(len(reasons)):
        if not (-1.0 < at[p, 0] < lines and -1.0 < at[p, 1] < samples):
            continue
        line, sample = int(np.round(at[p, 0])), int(np.round(at[p, 1]))
        for i in range(max(line - 1, 0), min(line + 2, lines)):
            for j in range(max(sample - 1, 0), min(sample + 2, samples)):
                if reason[i, j] == _UNMARKED or 0 < reason[i, j] < reasons[p]:
                    reason[i, j] = reasons[p]
