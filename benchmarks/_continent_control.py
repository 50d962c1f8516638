"""The control of a simulated continent: an older block, an elevation model, ortho-images of sites.

Each has errors drawn from what it declares; `truth/control.json` has the errors themselves.
"""

import json
from dataclasses import asdict, dataclass, replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.crs import CRS
from rasterio.transform import Affine

from amers.services.formats.block.document import BlockMetadata, BlockSpecification, Provenance
from amers.services.formats.block.writer import write_block
from amers.services.formats.images.ortho import gdal_transform
from amers.services.geodesy import box_around, metres_per_degree, move_metres, sun_direction
from amers.services.imagery.scene import Scene
from amers.services.map_grid import MapGrid
from amers.services.simulation.archive import season_of
from amers.services.simulation.land import WATER
from amers.services.simulation.light import averaged, day_of, radiance
from amers.services.simulation.render import digitise
from amers.services.simulation.view import PLAIN_RADIOMETRY
from amers.services.simulation.world import World, natural_noise
from amers.services.types import Array, FloatImage, Frame
from benchmarks._continent import Continent
from benchmarks._simulated import lay_points

POINT_SIGMA_M = (0.5, 0.5, 0.8)
FRAME_SIGMA_M, FRAME_SIGMA_UP_M = 0.4, 0.6
CHIP_GSD_M = 2.0
_POINTS_A_SIDE = {"continent": 8, "small": 5}
DEM_SIGMA_M, DEM_FRAME_SIGMA_M = 2.0, 1.0
_DEM_CELLS = 15
_DEM_NOISE_NODES, _DEM_NOISE_LENGTH_M = 512, 250.0
ORTHO_SIGMA_M = 0.5
ORTHO_GSD_M = 2.0
ORTHO_DAY = date(2022, 7, 10)
_ORTHO_PX = {"continent": 1000, "small": 400}
_ORTHOS = {"continent": 6, "small": 2}
_MOST_WATER = 0.2
_UTM = "EPSG:32631"


@dataclass(frozen=True)
class OrthoSite:
    """An ortho-image of a site.

    Attributes:
        path: in the folder of the continent.
        role: "control" for production, "check" for what judges it.
        sigma_m: accuracy that its producer declares, one standard deviation a coordinate.
        error_m: true error east and north; None in what production reads.
    """

    path: str
    role: str
    sigma_m: float
    error_m: tuple[float, float] | None = None


def write_control(continent: Continent) -> None:
    """Write the control that is missing, what it declares, and its true errors apart."""
    control, truth = continent.folder / "control", continent.truth / "control.json"
    if truth.exists():
        return
    control.mkdir(exist_ok=True)
    (continent.folder / "check").mkdir(exist_ok=True)
    true: dict[str, Any] = {}
    true["dem"] = {"bias_m": write_dem(continent, control / "dem.tif")}
    sites = write_orthos(continent)
    true["orthos"] = [asdict(site) for site in sites]
    true["base"] = write_base(continent, control / "base")
    declared = {
        "base": {"path": "control/base"},
        "dem": {
            "path": "control/dem.tif",
            "vertical": "ellipsoid",
            "sigma_m": DEM_SIGMA_M,
            "frame_sigma_m": DEM_FRAME_SIGMA_M,
        },
        "orthos": [asdict(replace(site, error_m=None)) for site in sites],
    }
    (control / "control.json").write_text(json.dumps(declared, indent=1))
    truth.write_text(json.dumps(true, indent=1))


def write_base(continent: Continent, folder: Path) -> dict[str, Any]:
    """Write a sparse block made from older images; returns its true errors.

    Points are measured in images whose models are true (`lay_points`), and moved by an error of their
    frame and by errors of their own.
    """
    name = continent.size_name
    rng = np.random.default_rng([continent.seed, 6])
    references = []
    for view in continent.older.values():
        geometry = continent.geometry(view)
        references.append(Scene(continent.image(view), geometry.rpc, geometry.acquisition, 0.0))
    side = _POINTS_A_SIDE[name]
    step = (np.arange(side) + 0.5) / side - 0.5
    grid = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    grid += rng.uniform(-0.3, 0.3, grid.shape) / side
    world = continent.world
    metres = np.array(metres_per_degree(float(world.centre_lon_lat[1]), 0.0))
    lon_lat = world.centre_lon_lat + grid * (continent.size.area_m - 300.0) / metres
    points, cut = lay_points(world, references, lon_lat, (CHIP_GSD_M,))
    frame = Frame.from_sigmas(FRAME_SIGMA_M, FRAME_SIGMA_UP_M)
    frame_error_m = rng.multivariate_normal(np.zeros(3), frame.covariance_m2)
    own_error_m = rng.normal(0.0, POINT_SIGMA_M, (len(points), 3))
    moved = replace(
        points,
        lon_lat_h=move_metres(points.lon_lat_h, frame_error_m + own_error_m),
        covariance_m2=points.covariance_m2 + np.diag(np.square(POINT_SIGMA_M)),
        frames=(frame,),
    )
    metadata = BlockMetadata(
        id="older-base",
        version="1",
        title="Older, sparse control points",
        description="",
        license="",
        extent=box_around(moved.lon_lat_h),
        created=datetime(2019, 12, 1, tzinfo=UTC),
        specification=BlockSpecification((CHIP_GSD_M,), len(references)),
        provenance=Provenance("benchmarks", "1", tuple(continent.older), {}),
        frame=frame,
    )
    order = write_block(folder, metadata, moved, cut, {})
    return {
        "points": len(points),
        "frame_error_m": frame_error_m.tolist(),
        "point_errors_m": own_error_m[order].tolist(),
    }


def write_dem(continent: Continent, path: Path) -> float:
    """Write a coarse surface with correlated errors and a common one, which is returned, metres."""
    world, rng = continent.world, np.random.default_rng([continent.seed, 7])
    rows, columns = (size // _DEM_CELLS for size in world.terrain_m.shape)
    height_m = np.empty((rows, columns), dtype=np.float32)
    for row in range(rows):
        strip = slice(row * _DEM_CELLS, (row + 1) * _DEM_CELLS)
        surface = np.maximum(world.terrain_m[strip], world.roof_m[strip])[:, : columns * _DEM_CELLS]
        height_m[row] = surface.reshape(_DEM_CELLS, columns, _DEM_CELLS).mean(axis=(0, 2))
    bias_m = float(rng.normal(0.0, DEM_FRAME_SIGMA_M))
    length = _DEM_NOISE_LENGTH_M / continent.size.world_m
    noise = cv2.resize(natural_noise(rng, _DEM_NOISE_NODES, 1.0, length), (columns, rows))
    height_m += np.float32(bias_m) + np.float32(DEM_SIGMA_M) * noise
    step = world.step_deg * _DEM_CELLS
    west, north = world.origin_lon_lat + np.array([-0.5, 0.5]) * world.step_deg
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=rows,
        width=columns,
        count=1,
        dtype="float32",
        crs=CRS.from_epsg(4979),
        transform=Affine(step[0], 0.0, west, 0.0, -step[1], north),
    ) as file:
        file.write(height_m, 1)
    return bias_m


def write_orthos(continent: Continent) -> list[OrthoSite]:
    """Write ortho-images of sites, every second one for checks only; returns them with their errors."""
    rng = np.random.default_rng([continent.seed, 8])
    world = continent.world_on(ORTHO_DAY)
    side_px = _ORTHO_PX[continent.size_name]
    sites = []
    for number in range(_ORTHOS[continent.size_name]):
        role = ("control", "check")[number % 2]
        error_m = rng.normal(0.0, ORTHO_SIGMA_M, 2)
        grid = _site(world, rng, continent.size.area_m, side_px)
        pixels = digitise(_ortho_light(world, grid, error_m), PLAIN_RADIOMETRY, rng)
        path = f"{role}/ortho_{number + 1}.tif"
        with rasterio.open(
            continent.folder / path,
            "w",
            driver="GTiff",
            height=side_px,
            width=side_px,
            count=1,
            dtype="uint16",
            nodata=0,
            crs=_UTM,
            transform=gdal_transform(grid),
            compress="deflate",
            predictor=2,
            tiled=True,
        ) as file:
            file.write(pixels, 1)
        sites.append(OrthoSite(path, role, ORTHO_SIGMA_M, (float(error_m[0]), float(error_m[1]))))
    return sites


def _site(world: World, rng: np.random.Generator, area_m: float, side_px: int) -> MapGrid:
    """The grid of a random site that is mostly dry."""
    while True:
        reach_m = (area_m - side_px * ORTHO_GSD_M) / 2.0
        place_m = rng.uniform(-reach_m, reach_m, 2)
        metres = np.array(metres_per_degree(float(world.centre_lon_lat[1]), 0.0))
        lon_lat = world.centre_lon_lat + place_m / metres
        at_zero = MapGrid(_UTM, np.zeros(2), np.array([[0.0, ORTHO_GSD_M], [-ORTHO_GSD_M, 0.0]]), (1, 1))
        centre = np.rint(at_zero.xy(at_zero.line_sample(lon_lat[None, :])))[0]
        corner = centre + [-side_px * ORTHO_GSD_M / 2.0, side_px * ORTHO_GSD_M / 2.0]
        grid = replace(at_zero, origin_xy=corner, shape=(side_px, side_px))
        column_row = np.rint(world.column_row(_lon_lat_of(grid))).astype(np.int64)
        rows, columns = world.parcel.shape
        wet = world.parcel[column_row[:, 1] % rows, column_row[:, 0] % columns] == WATER
        if wet.mean() <= _MOST_WATER:
            return grid


def _ortho_light(world: World, grid: MapGrid, error_m: Array) -> FloatImage:
    """Light of the ground seen from above, on a map that is off by an error."""
    lon_lat = _lon_lat_of(grid)
    at = np.column_stack([lon_lat, np.zeros(len(lon_lat))])
    shown = move_metres(at, np.tile([-error_m[0], -error_m[1], 0.0], (len(at), 1)))[:, :2]
    column_row = world.column_row(shown)
    first = np.floor(column_row.min(axis=0)).astype(int) - 4
    last = np.ceil(column_row.max(axis=0)).astype(int) + 5
    moment = datetime(ORTHO_DAY.year, ORTHO_DAY.month, ORTHO_DAY.day, 10, 30, tzinfo=UTC)
    sun = sun_direction(world.centre_lon_lat, moment)
    day = day_of(world, ORTHO_DAY, *sun, season_of(ORTHO_DAY))
    shape = int(last[1] - first[1]), int(last[0] - first[0])
    light = radiance(world, day, (int(first[1]), int(first[0])), shape)
    light = averaged(light, np.zeros(shape, dtype=bool), ORTHO_GSD_M / world.posting_m)
    x, y = ((column_row - first).T.reshape(2, *grid.shape)).astype(np.float32)
    return np.asarray(cv2.remap(light, x, y, cv2.INTER_CUBIC), dtype=np.float32)


def _lon_lat_of(grid: MapGrid) -> Array:
    """Longitudes and latitudes (n, 2) of the pixels of a grid."""
    axes = [np.arange(size, dtype=np.float64) for size in grid.shape]
    line_sample = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.asarray(grid.lon_lat(line_sample))
