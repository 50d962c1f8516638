"""How densely a block covers the ground of a continent that has texture."""

from dataclasses import dataclass

import numpy as np
import shapely

from amers.services.geodesy import metres_per_degree
from amers.services.quality.density import density_cells, share_reaching
from amers.services.simulation.land import WATER
from amers.services.simulation.world import World
from amers.services.types import Array, BoolArray, ControlPoints
from benchmarks._continent import Continent

POINTS_PER_KM2 = 0.5
_PATCH_M = 100.0
_LEAST_CONTRAST = 0.08
_LEAST_TEXTURED = 0.5


@dataclass(frozen=True)
class DensityVerdict:
    """How densely a block covers the area of an archive.

    Attributes:
        points_per_km2: in the area.
        cells: number of cells of 2 km2 that are textured.
        reached: share of them with a point or more.
        degree_cells_reached: share of the cells of 0.1 degree, by area, with a point for 2 km2 or more.
    """

    points_per_km2: float
    cells: int
    reached: float
    degree_cells_reached: float


def judge_density(continent: Continent, points: ControlPoints) -> DensityVerdict:
    """The density of a block in the area of the archive."""
    lon_lat = points.lon_lat_h[:, :2]
    area = np.array(shapely.get_coordinates(continent.area)[:-1])
    inside = shapely.contains_xy(continent.area, lon_lat)
    side_m = 1_000.0 / np.sqrt(POINTS_PER_KM2)
    count, corner = counts(continent, lon_lat[inside], side_m)
    textured = textured_cells(continent.world, corner, side_m)
    cells = density_cells(lon_lat[inside], area)
    return DensityVerdict(
        points_per_km2=float(inside.sum() / (continent.size.area_m * 1e-3) ** 2),
        cells=int(textured.sum()),
        reached=float((count[textured] > 0).mean()),
        degree_cells_reached=share_reaching(cells, POINTS_PER_KM2),
    )


def counts(continent: Continent, lon_lat: Array, side_m: float) -> tuple[Array, Array]:
    """Numbers of points in the whole cells of an area, and their south-west corners (k, 2), degrees."""
    west_south = np.array(continent.area.bounds[:2])
    side = side_m / np.array(metres_per_degree(float(west_south[1]), 300.0))
    n = int(continent.size.area_m / side_m)
    cell = np.floor((lon_lat - west_south) / side).astype(np.int64)
    whole = ((cell >= 0) & (cell < n)).all(axis=1)
    count = np.bincount(cell[whole, 0] * n + cell[whole, 1], minlength=n * n)
    grid = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), axis=-1).reshape(-1, 2)
    return count, west_south + grid * side


def textured_cells(world: World, corner: Array, side_m: float) -> BoolArray:
    """Which cells (k,) have texture in half of their patches of 100 m or more."""
    patch = round(_PATCH_M / world.posting_m)
    n = int(side_m / world.posting_m) // patch
    out = np.empty(len(corner), dtype=bool)
    rows, columns = world.albedo.shape
    for number, (column, row) in enumerate(np.rint(world.column_row(corner)).astype(int)):
        cells = np.ix_(
            np.arange(row - n * patch, row) % rows, np.arange(column, column + n * patch) % columns
        )
        albedo = world.albedo[cells].reshape(n, patch, n, patch)
        dry = (world.parcel[cells] != WATER).reshape(n, patch, n, patch).mean(axis=(1, 3)) > 0.5
        contrast = albedo.std(axis=(1, 3)) / albedo.mean(axis=(1, 3))
        out[number] = (dry & (contrast > _LEAST_CONTRAST)).mean() >= _LEAST_TEXTURED
    return out
