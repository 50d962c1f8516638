"""Figures of a block in each cell of 0.1 degree: density, images per point, age, missing points."""

from dataclasses import dataclass
from datetime import datetime

import numpy as np

from amers.services.quality.density import (
    DensityCells,
    GroundMask,
    cell_of_points,
    covered_area_km2,
    density_cells,
)
from amers.services.types import Array, ControlPoints, IntArray

_DAYS_OF_A_YEAR = 365.25
_SMALLEST_KM2 = 1e-4
"""Cells with less ground than this that is not excluded are not judged: that is 10 m x 10 m."""


@dataclass(frozen=True)
class BlockCells:
    """The cells of a block that have ground which is not excluded.

    Attributes:
        density: area inside the outline that is not excluded, and the points on it.
        excluded_km2: (n,) area inside the outline that is excluded.
        images: (n,) median over the points of the number of images that show a point; NaN without
            points.
        short_of_views: (n,) int64, points that fewer images show than the block specifies.
        age_years: (n,) median over the points of the age of the newest view; NaN when unknown.
    """

    density: DensityCells
    excluded_km2: Array
    images: Array
    short_of_views: IntArray
    age_years: Array

    def missing_points(self, points_per_km2: float) -> IntArray:
        """Whole points (n,) that each cell lacks to reach a density; 0 where it does."""
        needed = np.floor(points_per_km2 * self.density.area_km2 + 1e-9).astype(np.int64)
        return np.asarray(np.maximum(needed - self.density.points, 0))


def block_cells(
    points: ControlPoints,
    outline: Array,
    min_views: int,
    at: datetime,
    excluded: GroundMask | None = None,
) -> BlockCells:
    """The figures of a block in each cell of 0.1 degree.

    Args:
        points: of the block.
        outline: (k, 2) lon, lat of the block, as for `density_cells`.
        min_views: number of images that shall show a point.
        at: the time at which views have their ages.
        excluded: ground where no points are expected, such as water; points on it are not counted.
    """
    lon_lat = points.lon_lat_h[:, :2]
    rows = np.arange(len(points))
    whole = density_cells(np.empty((0, 2)), outline)
    covered_km2 = np.zeros(len(whole.points))
    if excluded is not None:
        covered_km2 = covered_area_km2(whole, outline, excluded)
        rows = rows[~excluded(lon_lat)]
    kept = whole.area_km2 - covered_km2 > _SMALLEST_KM2
    area_km2 = (whole.area_km2 - covered_km2)[kept]
    cells = DensityCells(whole.lon_lat[kept], area_km2, np.zeros(len(area_km2), dtype=np.int64))
    images, age_years = images_per_point(points), view_ages_years(points, at)
    if not len(area_km2):
        return BlockCells(cells, covered_km2[kept], area_km2, cells.points, area_km2)
    cell = cell_of_points(cells, lon_lat[rows])
    rows, cell = rows[cell >= 0], cell[cell >= 0]
    n = len(area_km2)
    count = np.bincount(cell, minlength=n).astype(np.int64)
    short = np.bincount(cell[images[rows] < min_views], minlength=n).astype(np.int64)
    return BlockCells(
        DensityCells(cells.lon_lat, area_km2, count),
        covered_km2[kept],
        _medians(images[rows].astype(np.float64), cell, n),
        short,
        _medians(age_years[rows], cell, n),
    )


def images_per_point(points: ControlPoints) -> IntArray:
    """Number (n,) of different images that show each point."""
    of_point = np.repeat(np.arange(len(points)), np.diff(points.views.start))
    pairs = np.unique(np.column_stack([of_point, points.views.image]), axis=0)
    return np.bincount(pairs[:, 0], minlength=len(points)).astype(np.int64)


def view_ages_years(points: ControlPoints, at: datetime) -> Array:
    """Age (n,) of the newest view of each point, years; NaN when no view has a date."""
    age = np.array(
        [
            np.nan
            if image.acquired_at is None
            else (at - image.acquired_at).total_seconds() / 86400.0 / _DAYS_OF_A_YEAR
            for image in points.views.images
        ]
    )
    of_point = np.repeat(np.arange(len(points)), np.diff(points.views.start))
    newest = np.full(len(points), np.inf)
    of_view = age[points.views.image]
    np.minimum.at(newest, of_point, np.where(np.isnan(of_view), np.inf, of_view))
    return np.asarray(np.where(np.isinf(newest), np.nan, newest))


def _medians(values: Array, group: IntArray, count: int) -> Array:
    """Median (count,) of the finite values (m,) of each group; NaN where there are none."""
    known = np.isfinite(values)
    values, group = values[known], group[known]
    order = np.lexsort((values, group))
    values, group = values[order], group[order]
    first = np.searchsorted(group, np.arange(count))
    number = np.searchsorted(group, np.arange(count), side="right") - first
    median = np.full(count, np.nan)
    some = number > 0
    low, high = first + (number - 1) // 2, first + number // 2
    median[some] = (values[low[some]] + values[high[some]]) / 2.0
    return median
