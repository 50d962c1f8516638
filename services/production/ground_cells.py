"""Ground cells of nearly equal area, and the cells inside footprints.

The grid is the integerized sinusoidal grid of SeaWiFS and MODIS level 3 data: rows of equal latitude,
each cut into the whole number of cells that makes them closest to squares. It has neither seam nor pole:
the columns of a row go round the Earth, and the last rows have three cells.

Source: Campbell, Blaisdell, Darzi (1995), Level-3 SeaWiFS data products, NASA TM 104566, volume 32.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import shapely
from numba import njit

from amers.services.quality.density import box_area_km2
from amers.services.types import Array, BoolArray, IntArray

EARTH_RADIUS_M = 6_371_007.2
"""Radius of the sphere with the area of the ellipsoid."""
Shapes = npt.NDArray[np.object_]


@dataclass(frozen=True)
class GroundGrid:
    """Cells of nearly equal area over the whole Earth, numbered from the south pole.

    Attributes:
        rows: number of rows from pole to pole.
        first: (rows + 1,) int64, number of the first cell of each row, and of all cells.
    """

    rows: int
    first: IntArray

    @property
    def row_deg(self) -> float:
        """Height of a row, degrees of latitude."""
        return 180.0 / self.rows

    def cell_of(self, lon_lat: Array) -> IntArray:
        """Number (n,) of the cell of each place (n, 2)."""
        row = np.floor((lon_lat[:, 1] + 90.0) / self.row_deg).astype(np.int64)
        row = np.clip(row, 0, self.rows - 1)
        columns = np.diff(self.first)[row]
        column = np.floor((lon_lat[:, 0] + 180.0) / 360.0 * columns).astype(np.int64) % columns
        return np.asarray(self.first[row] + column)

    def boxes(self, cell: IntArray) -> tuple[Array, Array]:
        """South-west and north-east corners (n, 2) of cells (n,), degrees."""
        row = np.searchsorted(self.first, cell, side="right") - 1
        width = 360.0 / np.diff(self.first)[row]
        west, south = -180.0 + (cell - self.first[row]) * width, -90.0 + row * self.row_deg
        return np.column_stack([west, south]), np.column_stack([west + width, south + self.row_deg])

    def centres(self, cell: IntArray) -> Array:
        """Longitude and latitude (n, 2) of the centres of cells (n,)."""
        low, high = self.boxes(cell)
        return np.asarray((low + high) / 2.0)

    def area_km2(self, cell: IntArray) -> Array:
        """Area (n,) of cells (n,) on the ellipsoid."""
        return box_area_km2(*self.boxes(cell))


def ground_grid(cell_m: float) -> GroundGrid:
    """The grid of cells with about a given side."""
    rows = max(4, round(np.pi * EARTH_RADIUS_M / cell_m))
    latitude = np.radians(-90.0 + (np.arange(rows) + 0.5) * 180.0 / rows)
    columns = np.maximum(3, np.round(2.0 * rows * np.cos(latitude))).astype(np.int64)
    return GroundGrid(rows, np.concatenate([[0], np.cumsum(columns)]).astype(np.int64))


@dataclass(frozen=True)
class SeenCells:
    """The cells whose centres lie in footprints.

    Attributes:
        start: (n + 1,) int64; the cells of footprint i are the rows `start[i]` to `start[i + 1]`.
        cell: (m,) int64, numbers in the grid, rising within a footprint.
        clear: (m,) whether the centre lies outside of the footprint's mask.
    """

    start: IntArray
    cell: IntArray
    clear: BoolArray


def seen_cells(footprints: Shapes, masks: Shapes, grid: GroundGrid) -> SeenCells:
    """The cells in footprints, and which of them masks cover.

    Args:
        footprints: (n,) polygons or multipolygons on the ground (`footprint_on_ground`).
        masks: (n,) the same, which may overlap each other and be empty; None where there is none.
        grid: of the ground.
    """
    return SeenCells(*_fill(_rings_of(footprints), _rings_of(masks), grid.first))


class _Rings(NamedTuple):
    """Coordinates (k, 2) of n shapes; first of each ring, of each polygon's rings, of each shape's."""

    xy: Array
    ring: IntArray
    polygon: IntArray
    shape: IntArray


def _rings_of(shapes: Shapes) -> _Rings:
    polygons, owner = shapely.get_parts(shapes, return_index=True)
    rings, polygon = shapely.get_rings(polygons, return_index=True)
    coordinates, ring = shapely.get_coordinates(rings, return_index=True)
    return _Rings(
        np.ascontiguousarray(coordinates, dtype=np.float64),
        _starts(ring, len(rings)),
        _starts(polygon, len(polygons)),
        _starts(owner, len(shapes)),
    )


def _starts(owner: IntArray, count: int) -> IntArray:
    """First row (count + 1,) of each owner, from the sorted owners of rows."""
    return np.searchsorted(owner, np.arange(count + 1)).astype(np.int64)


@njit(cache=True)
def _fill(shapes: _Rings, masks: _Rings, first: IntArray) -> tuple[IntArray, IntArray, BoolArray]:
    """Start, cells and clearness of every shape, see `SeenCells`."""
    n = len(shapes.shape) - 1
    start = np.zeros(n + 1, dtype=np.int64)
    cells = np.empty(1 << 16, dtype=np.int64)
    clear = np.empty(1 << 16, dtype=np.bool_)
    total = 0
    for i in range(n):
        found = np.empty(0, dtype=np.int64)
        for k in range(shapes.shape[i], shapes.shape[i + 1]):
            found = np.append(found, _polygon_cells(shapes, k, first))
        found = np.unique(found)
        if total + len(found) > len(cells):
            room = 2 * (total + len(found))
            cells = np.append(cells[:total], np.empty(room, dtype=np.int64))
            clear = np.append(clear[:total], np.empty(room, dtype=np.bool_))
        cells[total : total + len(found)] = found
        clear[total : total + len(found)] = True
        for k in range(masks.shape[i], masks.shape[i + 1]):
            for cell in _polygon_cells(masks, k, first):
                place = np.searchsorted(found, cell)
                if place < len(found) and found[place] == cell:
                    clear[total + place] = False
        total += len(found)
        start[i + 1] = total
    return start, cells[:total].copy(), clear[:total].copy()


@njit(cache=True)
def _polygon_cells(shapes: _Rings, polygon: int, first: IntArray) -> IntArray:
    """Cells whose centres lie inside the rings of a polygon: crossings of every row, even-odd."""
    xy = shapes.xy
    ring = shapes.ring[shapes.polygon[polygon] : shapes.polygon[polygon + 1] + 1]
    rows = len(first) - 1
    row_deg = 180.0 / rows
    low, high = xy[ring[0] : ring[-1], 1].min(), xy[ring[0] : ring[-1], 1].max()
    from_row = max(0, int(np.ceil((low + 90.0) / row_deg - 0.5)))
    to_row = min(rows - 1, int(np.ceil((high + 90.0) / row_deg - 0.5)) - 1)
    cells = np.empty(64, dtype=np.int64)
    count = 0
    crossing = np.empty(ring[-1] - ring[0])
    for row in range(from_row, to_row + 1):
        latitude = -90.0 + (row + 0.5) * row_deg
        crossings = 0
        for r in range(len(ring) - 1):
            for k in range(ring[r], ring[r + 1] - 1):
                y0, y1 = xy[k, 1], xy[k + 1, 1]
                if (y0 <= latitude) != (y1 <= latitude):
                    share = (latitude - y0) / (y1 - y0)
                    crossing[crossings] = xy[k, 0] + share * (xy[k + 1, 0] - xy[k, 0])
                    crossings += 1
        edges = np.sort(crossing[:crossings])
        columns = first[row + 1] - first[row]
        width = 360.0 / columns
        for k in range(0, crossings - 1, 2):
            from_column = int(np.ceil((edges[k] + 180.0) / width - 0.5))
            to_column = int(np.ceil((edges[k + 1] + 180.0) / width - 0.5)) - 1
            to_column = min(to_column, from_column + columns - 1)
            if count + to_column - from_column + 1 > len(cells):
                cells = np.append(cells, np.empty(len(cells) + to_column - from_column + 1, np.int64))
            for column in range(from_column, to_column + 1):
                cells[count] = first[row] + column % columns
                count += 1
    return cells[:count]
