"""Density of control points on the ground, in cells of 0.1 degree."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import shapely

from amers.services.geodesy import WGS84_B, WGS84_E2
from amers.services.types import Array, BoolArray, IntArray

CELLS_PER_DEGREE = 10
_SAMPLES_PER_SIDE = 64
"""Positions along each side of the part of a cell inside an outline at which a mask is asked."""

GroundMask = Callable[[Array], BoolArray]
"""Which positions (n, 2) of longitude and latitude a mask covers."""


@dataclass(frozen=True)
class DensityCells:
    """Cells of 0.1 x 0.1 degree that intersect an outline.

    Attributes:
        lon_lat: (n, 2) south-west corners; longitudes are those of the outline.
        area_km2: (n,) part of the cell's area inside the outline.
        points: (n,) int64, number of points in the cell.
    """

    lon_lat: Array
    area_km2: Array
    points: IntArray

    @property
    def points_per_km2(self) -> Array:
        """(n,) density of each cell."""
        return self.points / self.area_km2


def density_cells(lon_lat: Array, outline: Array) -> DensityCells:
    """Numbers of points in the cells that intersect an outline.

    Args:
        lon_lat: (m, 2) points, degrees.
        outline: (k, 2) lon, lat, not closed, longitudes continuous (beyond 180 degrees where it crosses
            the antimeridian).
    """
    low = np.floor(outline.min(axis=0) * CELLS_PER_DEGREE).astype(np.int64)
    shape = np.ceil(outline.max(axis=0) * CELLS_PER_DEGREE).astype(np.int64) - low
    shape = np.maximum(shape, 1)
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 2)
    corner = (grid + low) / CELLS_PER_DEGREE
    opposite = (grid + low + 1) / CELLS_PER_DEGREE
    area_km2 = _area_inside_km2(corner, opposite, outline)
    inside = area_km2 > 0.0
    cells = DensityCells(corner[inside], area_km2[inside], np.zeros(int(inside.sum()), dtype=np.int64))
    row = cell_of_points(cells, lon_lat)
    return replace(
        cells, points=np.bincount(row[row >= 0], minlength=len(cells.points)).astype(np.int64)
    )


def cell_of_points(cells: DensityCells, lon_lat: Array) -> IntArray:
    """The row (m,) of the cell of each point (m, 2); -1 for points in none of the cells.

    Points on the last edge of the cells belong to the last of them.
    """
    corner = np.round(cells.lon_lat * CELLS_PER_DEGREE).astype(np.int64)
    low, high = corner.min(axis=0), corner.max(axis=0)
    middle = float(low[0] + high[0] + 1) / (2 * CELLS_PER_DEGREE)
    lon = middle + (lon_lat[:, 0] - middle + 180.0) % 360.0 - 180.0
    place = np.column_stack([lon, lon_lat[:, 1]]) * CELLS_PER_DEGREE
    cell = np.floor(np.where(np.abs(place - high - 1) < 1e-9, high, place)).astype(np.int64) - low
    known = ((cell >= 0) & (cell <= high - low)).all(axis=1)
    table = np.full(tuple(high - low + 1), -1, dtype=np.int64)
    table[tuple((corner - low).T)] = np.arange(len(corner))
    row = np.full(len(lon_lat), -1, dtype=np.int64)
    row[known] = table[cell[known, 0], cell[known, 1]]
    return row


def covered_area_km2(cells: DensityCells, outline: Array, mask: GroundMask) -> Array:
    """Area (n,) of the cells inside an outline that a mask covers.

    The mask is asked at 64 x 64 positions of the box around the part of each cell inside the outline.

    Args:
        cells: of the outline.
        outline: as for `density_cells`.
        mask: covers ground.
    """
    polygon = shapely.Polygon(outline)
    step = (np.arange(_SAMPLES_PER_SIDE) + 0.5) / _SAMPLES_PER_SIDE
    unit = np.stack(np.meshgrid(step, step, indexing="ij"), axis=-1).reshape(-1, 2)
    share = np.zeros(len(cells.points))
    for row, (west, south) in enumerate(cells.lon_lat.tolist()):
        side = 1.0 / CELLS_PER_DEGREE
        part = shapely.intersection(polygon, shapely.box(west, south, west + side, south + side))
        low, high = np.array(part.bounds).reshape(2, 2)
        place = low + unit * (high - low)
        place = place[shapely.contains_xy(part, place[:, 0], place[:, 1])]
        if len(place):
            place[:, 0] = (place[:, 0] + 180.0) % 360.0 - 180.0
            share[row] = mask(place).mean()
    return np.asarray(share * cells.area_km2)


def share_reaching(cells: DensityCells, points_per_km2: float) -> float:
    """Share of the cells, 0 to 1, with at least a given density.

    A cell counts by its area inside the outline: a sliver along the outline weighs less than a whole
    cell.
    """
    reached = cells.points_per_km2 >= points_per_km2
    return float(cells.area_km2[reached].sum() / cells.area_km2.sum())


def _area_inside_km2(corner: Array, opposite: Array, outline: Array) -> Array:
    """Area (n,) of cells inside an outline: area of the cell on the ellipsoid times the share inside."""
    area_km2 = box_area_km2(corner, opposite)
    polygon = shapely.Polygon(outline)
    boxes = shapely.box(corner[:, 0], corner[:, 1], opposite[:, 0], opposite[:, 1])
    shapely.prepare(polygon)
    share = np.ones(len(boxes))
    edge = ~shapely.contains_properly(polygon, boxes)
    share[edge] = shapely.area(shapely.intersection(polygon, boxes[edge])) * CELLS_PER_DEGREE**2
    return np.where(share > 1e-9, area_km2 * share, 0.0)


def box_area_km2(corner: Array, opposite: Array) -> npt.NDArray[np.float64]:
    """Area on the WGS 84 ellipsoid of boxes (n, 2), (n, 2) of longitude and latitude.

    Source: Snyder (1987), Map projections: a working manual, equation 3-12 for the authalic latitude.
    """

    def zone(lat_deg: Array) -> Array:
        s, e = np.sin(np.radians(lat_deg)), np.sqrt(WGS84_E2)
        return s / (1.0 - WGS84_E2 * s * s) + np.arctanh(e * s) / e

    strip = WGS84_B**2 / 2.0 * (zone(opposite[:, 1]) - zone(corner[:, 1]))
    return strip * np.radians(opposite[:, 0] - corner[:, 0]) * 1e-6
