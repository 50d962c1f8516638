"""A land without relief, orthogonal images of it on any map, and bases with chips of it."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin
from scipy.ndimage import map_coordinates, spline_filter

from amers.services.map_grid import MapGrid, lon_lat_of_xy, xy_of_lon_lat
from amers.services.types import Array
from tests.services.textures import texture

UTM = "EPSG:32633"
LAND_M = 10.0
"""Distance of the values that define the land, metres."""
SIDE = 768
CORNER_XY = (400_000.0, 5_800_000.0)
"""Of the north-west corner of the land."""
SMOOTHNESS = 1.5
"""Of the land, as a multiple of `LAND_M`."""


@cache
def coefficients() -> Array:
    return np.asarray(
        spline_filter(texture(np.random.default_rng(4), SIDE, SMOOTHNESS), order=5, mode="grid-wrap")
    )


def brightness(xy: Array) -> Array:
    """Of the land at map positions (n, 2); mean 0, standard deviation 1."""
    row_column = np.stack([CORNER_XY[1] - xy[:, 1], xy[:, 0] - CORNER_XY[0]]) / LAND_M
    return np.asarray(
        map_coordinates(coefficients(), row_column, order=5, mode="grid-wrap", prefilter=False)
    )


def north_up(crs: str, corner_xy: Sequence[float], gsd_m: float, side: int) -> MapGrid:
    """A map grid by the outer corner of its first pixel."""
    origin_xy = np.array([corner_xy[0] + gsd_m / 2.0, corner_xy[1] - gsd_m / 2.0])
    return MapGrid(crs, origin_xy, np.array([[0.0, gsd_m], [-gsd_m, 0.0]]), (side, side))


def image(grid: MapGrid) -> Array:
    """The land as an orthogonal image on a map grid."""
    line_sample = (
        np.stack(np.mgrid[: grid.shape[0], : grid.shape[1]], axis=-1).reshape(-1, 2).astype(float)
    )
    xy = grid.xy(line_sample)
    if grid.crs != UTM:
        xy = xy_of_lon_lat(UTM, lon_lat_of_xy(grid.crs, xy))
    return brightness(xy).reshape(grid.shape)


@dataclass(frozen=True)
class BasePoint:
    """A point of a base.

    Attributes:
        name: its id.
        xy: its detail on the land.
        off_m: (2,) by which the base places the point and its chip beside that detail.
        height_m: above the ellipsoid.
    """

    name: str
    xy: Array
    off_m: Array = field(default_factory=lambda: np.zeros(2))
    height_m: float = 90.0

    @property
    def stated_xy(self) -> Array:
        """Where the base places the point."""
        return np.asarray(self.xy + self.off_m)

    @property
    def lon_lat(self) -> tuple[float, float]:
        """Longitude and latitude where the base places the point."""
        lon, lat = lon_lat_of_xy(UTM, self.stated_xy[None, :])[0]
        return float(lon), float(lat)


def base_points(count: int = 8) -> list[BasePoint]:
    """Points all over the land, none of them on a pixel of anything."""
    side = np.linspace(600.0, SIDE * LAND_M - 600.0, count)
    x, y = np.meshgrid(side, side)
    rng = np.random.default_rng(6)
    xy = np.column_stack([CORNER_XY[0] + x.ravel(), CORNER_XY[1] - y.ravel()])
    return [BasePoint(f"P{number}", at + rng.uniform(-40.0, 40.0, 2)) for number, at in enumerate(xy)]


def chip_around(
    point: BasePoint, gsd_m: float, side: int, rng: np.random.Generator
) -> tuple[MapGrid, Array]:
    """A chip with noise that shows a point near its middle: its map grid and its grey values."""
    corner = point.xy + np.array([-1.0, 1.0]) * side * gsd_m / 2.0 + gsd_m * rng.uniform(-0.5, 0.5, 2)
    grid = north_up(UTM, corner, gsd_m, side)
    pixels = 120.0 + 25.0 * (image(grid) + 0.1 * rng.standard_normal((side, side)))
    return replace(grid, origin_xy=grid.origin_xy + point.off_m), pixels


def write_gcplib(
    folder: Path,
    points: Sequence[BasePoint],
    *,
    gsd_m: float = 15.0,
    side: int = 64,
    first: float = 1.0,
    data_type: str = "BYTE",
) -> Path:
    """A GCPLib whose chips count lines and samples from `first`; the chips lie in `chips`."""
    (folder / "chips").mkdir(parents=True)
    rng = np.random.default_rng(12)
    records = []
    for number, point in enumerate(points):
        grid, pixels = chip_around(point, gsd_m, side, rng)
        dtype = {"BYTE": "u1", "I*2": "<i2", "UI*2": "<u2", "R*4": "<f4"}[data_type]
        (folder / "chips" / f"{point.name}.chip").write_bytes(np.rint(pixels).astype(dtype).tobytes())
        line, sample = grid.line_sample_of_xy(point.stated_xy[None, :])[0] + first
        (lon, lat), (x, y) = point.lon_lat, point.stated_xy
        records.append(
            f"{point.name} {point.name}.chip {line:f} {sample:f} {lat:.9f} {lon:.9f} {y:f} {x:f} "
            f"{point.height_m:f} {gsd_m:f} {gsd_m:f} {side:f} {side:f} "
            f"GLS+ GRAYSCALE UTM 33 0{1 + number % 2}-14-1999 ABS {data_type}"
        )
    path = folder / "gcplib.txt"
    path.write_text(
        "\n".join(["# Unique Ground Control Point ID", "BEGIN", str(len(records)), *records]) + "\n"
    )
    return path


def write_copernicus(folder: Path, points: Sequence[BasePoint], measures: int = 1) -> Path:
    """A file of the Copernicus GCP database; its chips, 57 pixels of 10 m, lie in `chips`."""
    (folder / "chips").mkdir(parents=True)
    rng = np.random.default_rng(13)
    gcps = []
    for point in points:
        names = [f"{point.name}_{number:02d}.TIF" for number in range(measures)]
        for name in names:
            grid, pixels = chip_around(point, 10.0, 57, rng)
            write_geotiff(folder / "chips" / name, grid, np.rint(10.0 * pixels).astype(np.uint16))
        lon, lat = point.lon_lat
        info = {"Longitude": f"{lon:.9f}", "Latitude": f"{lat:.9f}", "EPSG": "32633"}
        info |= {
            "X": f"{point.stated_xy[0]:.3f}",
            "Y": f"{point.stated_xy[1]:.3f}",
            "Altimetry": str(point.height_m),
        }
        listed = [{"Chips": {"Chip_File": name}} for name in names]
        gri = {"GRI_Measure": listed if measures > 1 else listed[0]}
        gcps.append({"ID": point.name, "GCP_Info": info, "GRI_List": gri})
    path = folder / "gcp_db.json"
    path.write_text(json.dumps({"GCP_DB": {"GCP": gcps}}))
    return path


def write_geotiff(path: Path, grid: MapGrid, pixels: np.ndarray) -> None:
    """Write an image on a map with its north up."""
    (_, gsd_m), (west, north) = grid.step_xy[0], grid.origin_xy
    place = from_origin(west - gsd_m / 2.0, north + gsd_m / 2.0, gsd_m, gsd_m)
    lines, samples = pixels.shape
    with rasterio.open(
        path, "w", "GTiff", samples, lines, 1, crs=grid.crs, transform=place, dtype=pixels.dtype
    ) as file:
        file.write(pixels, 1)
