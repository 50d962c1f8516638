"""The area of an image that its points support, for which accuracy is known and stated.

A correction is checked where points agree with it. Elsewhere it is an extrapolation, and what a scanner
did there (lines lost, an attitude that jumped) nobody saw. A place is held by an agreeing point within
reach, if among the points that were tried nearest to it some agree, and more than agree with each other
on another place.

As many of the nearest are asked as all but surely have one that agrees, where points agree as they do in
the whole image. Where none does, something is other than elsewhere, be it cloud, water, changed ground
or lines that were lost. Nobody need know which: nothing is stated there.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import shapely
from scipy.spatial import KDTree
from shapely.geometry.base import BaseGeometry

from amers.services.misfit.broken_image import FEWEST_IN_PART
from amers.services.types import Array, BoolArray

_LOST = 0.02
"""Chance that none of the nearest points agrees at a place of a clean image, which is lost by that."""
_MOST_ASKED = 12
"""Nearest points that are asked at most, where few agree at all."""
MOST_REACH = 0.15
"""Reach at most, sides of a square image of as many pixels: a limit that people set. One point in the
middle of each fifth of both axes holds the whole image."""
MOST_WORSE = 3.0
"""CE90 of a place over that of half of the places, beyond which no accuracy is stated there: as a result
is called wrong that is off by more than three times what it states."""
_CELLS = 50
"""Along each side of an image, of the raster in which the area is told: two percent each."""


@dataclass(frozen=True)
class HeldArea:
    """The part of an image that points support.

    Attributes:
        cells: (c, c) whether each cell of the image is held, rows from the first line down.
        of_image: (c, c) whether it has pixels: all cells but those nearest to points that found none.
        shape: lines and samples of the image.
        reach_px: of a point.
    """

    cells: BoolArray
    of_image: BoolArray
    shape: tuple[int, int]
    reach_px: float

    @classmethod
    def whole(cls, shape: tuple[int, int]) -> Self:
        """All of an image: of a few marks, whose correction is held by its priors alone."""
        cells = np.ones((_CELLS, _CELLS), dtype=bool)
        return cls(cells, cells, shape, float(np.hypot(*shape)))

    @property
    def percent(self) -> float:
        """Share of the image, 0 to 100; what has no pixels is none of it."""
        return 100.0 * float(self.cells.sum()) / max(int(self.of_image.sum()), 1)

    @property
    def places(self) -> Array:
        """Line and sample (k, 2) of the middles of the cells that are held."""
        return cell_places(self.shape)[self.cells.ravel()]

    def where_known(self, ce90_px: Array) -> Self:
        """The area without places where the accuracy, (k,) at `places`, is far worse than elsewhere.

        A displacement that is followed is as uncertain as itself where it begins, and beyond the points.
        """
        if not np.isfinite(ce90_px).any():
            return self
        cells = self.cells.copy()
        cells[self.cells] = ~(ce90_px > MOST_WORSE * np.nanmedian(ce90_px))
        return replace(self, cells=cells)

    @property
    def outline(self) -> BaseGeometry:
        """The area as polygons, x samples and y lines, pixels from the middle of the first."""
        row, column = np.nonzero(self.cells)
        # Whole numbers meet exactly, as parts of pixels would not.
        cells = shapely.union_all(shapely.box(column, row, column + 1, row + 1)).simplify(0.0)
        size = np.array(self.shape)[::-1] / _CELLS
        return shapely.transform(cells, lambda xy: xy * size - 0.5)

    @property
    def polygons(self) -> tuple[tuple[Array, ...], ...]:
        """The outline as polygons of closed rings (n, 2) of line and sample, the outer one first."""
        return tuple(
            tuple(np.asarray(ring.coords)[:, ::-1] for ring in (one.exterior, *one.interiors))
            for one in shapely.get_parts(self.outline)
        )

    def nearest(self, line_sample: Array) -> Array:
        """Places (n, 2), each moved to the nearest that is held; as they are where none is."""
        places = self.places
        if not len(places):
            return line_sample
        _, row = KDTree(places).query(line_sample)
        return np.where(self.holds(line_sample)[:, None], line_sample, places[row])

    def holds(self, line_sample: Array) -> BoolArray:
        """Which places (n, 2) of the image lie in it; none beside the image does."""
        cell = np.floor((line_sample + 0.5) / (np.array(self.shape) / _CELLS))
        inside = np.asarray(((cell >= 0) & (cell < _CELLS)).all(axis=1))
        row = np.where(inside[:, None], cell, 0).astype(np.int64)
        return inside & self.cells[row[:, 0], row[:, 1]]


def cell_places(shape: tuple[int, int]) -> Array:
    """Line and sample (c * c, 2) of the middles of the cells of an image."""
    axes = [(np.arange(_CELLS) + 0.5) * size / _CELLS - 0.5 for size in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


@dataclass(frozen=True)
class TriedPoints:
    """Points that were looked for in an image.

    Attributes:
        line_sample: (n, 2) where the scene places them.
        agrees: (n,) with the scene.
        elsewhere: (n,) with each other, on another displacement.
        empty: (n,) whether the image has no pixels there, as at the border of one turned north up.
    """

    line_sample: Array
    agrees: BoolArray
    elsewhere: BoolArray
    empty: BoolArray

    def take(self, rows: BoolArray) -> Self:
        """Some of the points (n,)."""
        return type(self)(
            self.line_sample[rows], self.agrees[rows], self.elsewhere[rows], self.empty[rows]
        )


def held_area(
    points: TriedPoints, shape: tuple[int, int], chip_side_px: float, parts: Array | None = None
) -> HeldArea:
    """The part of an image that points support.

    Args:
        points: that were looked for.
        shape: lines and samples of the image.
        chip_side_px: of the chips of the points in the image: all that a chip shows has been compared.
        parts: (p, 4) first and last lines and samples of parts of the image that lie by themselves,
            such as between breaks: three points or more hold a part, and none of another part does.
            None for none.
    """
    side_px = float(np.sqrt(shape[0] * shape[1]))
    reach_px = max(MOST_REACH * side_px, chip_side_px / np.sqrt(2.0))
    places = cell_places(shape)
    shown = points.take(~points.empty)
    asked = _asked(shown.agrees)
    held = _are_held(shown, places, reach_px, asked)
    for bounds in np.empty((0, 4)) if parts is None else parts:
        of_part, own = _inside(places, bounds), shown.take(_inside(shown.line_sample, bounds))
        held[of_part] &= own.agrees.sum() >= FEWEST_IN_PART
        held[of_part] &= _are_held(own, places[of_part], reach_px, asked)
    of_image = held | ~_are_nearer(points.line_sample[points.empty], shown.line_sample, places)
    return HeldArea(held.reshape(_CELLS, _CELLS), of_image.reshape(_CELLS, _CELLS), shape, reach_px)


def _asked(agrees: BoolArray) -> int:
    """How many of the nearest points all but surely have one that agrees, as points (n,) do."""
    share = float(agrees.mean()) if len(agrees) else 0.0
    if share in (0.0, 1.0):
        return 1 if share else _MOST_ASKED
    return int(np.clip(np.ceil(np.log(_LOST) / np.log(1.0 - share)), 1, _MOST_ASKED))


def _are_held(points: TriedPoints, places: Array, reach_px: float, asked: int) -> BoolArray:
    """Which places (m, 2) have an agreeing point in reach, and enough of those asked on its side."""
    agreeing = points.line_sample[points.agrees]
    if not len(agreeing) or not len(places):
        return np.zeros(len(places), dtype=bool)
    distance, _ = KDTree(agreeing).query(places)
    count = min(asked, len(points.line_sample))
    _, near = KDTree(points.line_sample).query(places, k=np.arange(1, count + 1))
    agree, elsewhere = (of_points[near].sum(axis=1) for of_points in (points.agrees, points.elsewhere))
    return np.asarray((distance <= reach_px) & (agree > elsewhere))


def _are_nearer(some: Array, others: Array, places: Array) -> BoolArray:
    """Which places (m, 2) are nearer to some points than to others; none without points."""
    if not len(some) or not len(others):
        return np.zeros(len(places), dtype=bool)
    near, far = (KDTree(points).query(places)[0] for points in (some, others))
    return np.asarray(near < far)


def _inside(line_sample: Array, bounds: Array) -> BoolArray:
    """Which places (n, 2) lie between first and last line, first and last sample."""
    low, high = bounds[[0, 2]] - 0.5, bounds[[1, 3]] + 0.5
    return np.asarray(((line_sample > low) & (line_sample < high)).all(axis=1))
