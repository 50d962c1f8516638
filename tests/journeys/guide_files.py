"""Small files of the names that the guide gives to those of its reader: one flat piece of ground."""

import json
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import rasterio
import shapely
from rasterio.transform import Affine

from amers.services.formats.images.raster import write_raster
from amers.services.formats.vector.layers import VectorLayer, write_layer
from amers.services.sensors.rpc import RpcModel
from amers.services.simulation.view import ViewPlan, simulate_view
from amers.services.types import Array, FloatImage
from benchmarks._catalogue import simulate_catalogue, write_catalogue
from tests.app.flat_world import GROUND_H, SIGMA_M, FlatWorld, make_flat_world
from tests.app.joint_world import true_model, write_scene
from tests.open_archive import CENTRE as OPEN_CENTRE
from tests.open_archive import make_archive
from tests.services.chip_bases import (
    CORNER_XY,
    LAND_M,
    SIDE,
    UTM,
    base_points,
    image,
    north_up,
    write_copernicus,
    write_gcplib,
    write_geotiff,
)

CENTRE = (5.4, 43.6)
"""Longitude and latitude in the middle of the box that the guide asks for."""
SIZE = 800
"""Lines and samples of all images: pixels of 0.5 m."""
ISLAND_PX = 80
OPEN_DATES = 7
"""Of the mirror: the first of the simulated archive, two of which are cloudy."""
GEOID_M = 48.0
"""Height of the invented geoids."""
SHIFTS_PX = {
    "IMG_1.TIF": (0.0, 0.0),
    "IMG_2.TIF": (0.0, 0.0),
    "scene.tif": (14.0, -9.0),
    "more.tif": (-8.0, 11.0),
    "later.tif": (6.0, 7.0),
    "scenes/first.tif": (9.0, 12.0),
    "scenes/second.tif": (-11.0, -6.0),
}
"""By how much the models of images are off, line and sample: those of the block are right."""


@dataclass(frozen=True)
class Ground:
    """What all images show, and a model of it without error that looks straight down.

    Attributes:
        folder: for the files.
        pixels: lines to the south and samples to the east.
        model: of these pixels, which have their places on a map at the height of the ground only.
        world: the same, from which images of other directions are made.
    """

    folder: Path
    pixels: FloatImage
    model: RpcModel
    world: FlatWorld

    def place(self, line: float, sample: float) -> list[float]:
        """Longitude, latitude, height of a place in the pixels."""
        at = np.array([[line, sample]])
        return list(map(float, self.model.locate(at, np.array([GROUND_H]))[0]))


def write_guide_files(folder: Path) -> None:
    """Write all files of the reader that the commands of the guide name, but for bases of points."""
    world = make_flat_world(folder / "world", SIZE)
    model = replace(world.true_model, ground_offset=np.array([*CENTRE, GROUND_H]))
    pixels = _islands(world.ground)
    ground = Ground(folder, pixels, model, replace(world, true_model=model, ground=pixels))
    _write_images(ground)
    _write_maps(ground)
    _write_drawings(ground)
    _write_archive(folder)
    write_catalogue(simulate_catalogue(60, 120.0, np.random.default_rng(2)), folder)
    (folder / "items.ndjson").rename(folder / "catalogue.ndjson")
    (folder / "country.geojson").write_text(shapely.to_geojson(shapely.box(14.8, -0.2, 15.2, 0.2)))


def _write_archive(folder: Path) -> None:
    """Write a mirror of some dates of Sentinel-2 with a region, and a scene of later on this ground."""
    archive = make_archive(folder / "mirror", dates=OPEN_DATES)
    lon, lat = OPEN_CENTRE
    region = shapely.box(lon - 0.015, lat - 0.011, lon + 0.015, lat + 0.011)
    (folder / "region.geojson").write_text(shapely.to_geojson(region))
    plan = ViewPlan("my-scene", OPEN_CENTRE, (1200, 1200), 2.0, 8.0, 100.0)
    view = simulate_view(archive.world, plan, np.random.default_rng(3), (34.0, -28.0))
    write_raster(folder / "my-scene.tif", view.pixels, view.geometry.delivered)


def _islands(pixels: FloatImage) -> FloatImage:
    """The ground with texture in islands only, so that a block of it has few points."""
    wave = np.sin(np.pi * (np.arange(SIZE) + 0.5) / ISLAND_PX)
    contrast = (np.outer(wave, wave) ** 8).astype(np.float32)
    return 1500.0 + contrast * (pixels - 1500.0)


def write_bases(folder: Path) -> None:
    """Write the points of two bases with their chips, and an ortho-image that shows them."""
    points = base_points(4)
    write_copernicus(folder, points)
    write_gcplib(folder / "landsat", points)
    (folder / "landsat" / "gcplib.txt").rename(folder / "gcplib.txt")
    (folder / "landsat" / "chips").rename(folder / "gcp_lib")
    grid = north_up(UTM, CORNER_XY, LAND_M, SIDE)
    write_geotiff(folder / "ortho.tif", grid, np.rint(500.0 + 100.0 * image(grid)).astype(np.uint16))


def write_geoids(folder: Path) -> None:
    """Write flat grids of Europe under the names that PROJ looks for."""
    rows, columns = 41, 81
    head = struct.pack(">4d2i", 40.0, 0.0, 0.5, 0.5, rows, columns)
    for name in ("egm08_25.gtx", "egm96_15.gtx"):
        (folder / name).write_bytes(head + np.full(rows * columns, GEOID_M, ">f4").tobytes())


def _write_images(ground: Ground) -> None:
    """Write raw images, every second of them seen from the south; their models state their accuracy."""
    rng = np.random.default_rng(31)
    (ground.folder / "scenes").mkdir()
    for number, (name, shift_px) in enumerate(SHIFTS_PX.items()):
        model = true_model(ground.world, "south" if number % 2 else "east")
        stated = replace(model, error_bias_m=SIGMA_M, error_random_m=0.0)
        write_scene(ground.folder / name, stated, shift_px, ground.pixels, rng)


def _write_maps(ground: Ground) -> None:
    """Write ortho-images of the whole and of its halves, and heights."""
    middle = ground.pixels.shape[1] // 2
    _write_map(ground, "ortho.tif", ground.pixels.astype(np.uint16), 0)
    _write_map(ground, "harbour.tif", ground.pixels[:, :middle].astype(np.uint16), 0)
    _write_map(ground, "airport.tif", ground.pixels[:, middle:].astype(np.uint16), middle)
    heights = np.full(ground.pixels.shape, GROUND_H, np.float32)
    _write_map(ground, "surface.tif", heights, 0)
    _write_map(ground, "dem.tif", heights - np.float32(GEOID_M), 0)


def _write_map(ground: Ground, name: str, values: Array, first: int) -> None:
    """Write a map image of a part of the ground, from a sample on."""
    (west, north, _), (east, south, _) = ground.place(-0.5, first - 0.5), ground.place(0.5, first + 0.5)
    place = Affine(east - west, 0.0, west, 0.0, south - north, north)
    lines, samples = values.shape
    with rasterio.open(
        ground.folder / name,
        *("w", "GTiff", samples, lines, 1),
        crs="EPSG:4326",
        transform=place,
        dtype=values.dtype,
    ) as file:
        file.write(values, 1)


def _write_drawings(ground: Ground) -> None:
    """Write marks held out and used, a road on the raw scene, a map with a field, and a lake."""
    truth = true_model(ground.world, "east")
    marks = []
    for line in range(100, SIZE, 140):
        for sample in range(100, SIZE, 140):
            lon_lat_h = ground.place(line, sample)
            seen = truth.project(np.array([lon_lat_h]))[0]
            marks.append(
                {
                    "type": "Feature",
                    "geometry": {"type": "Point", "coordinates": lon_lat_h},
                    "properties": {"line": seen[0], "sample": seen[1], "sigma_px": 0.2, "check": True},
                }
            )
    _write_json(ground.folder / "marks.geojson", {"type": "FeatureCollection", "features": marks})
    places = [(*one["geometry"]["coordinates"], *list(one["properties"].values())[:2]) for one in marks]
    (ground.folder / "marks.csv").write_text(
        "# pixel-origin=centre heights=ellipsoid\nid,lon,lat,height_m,line,sample\n"
        + "".join(f"M{k},{','.join(map(str, place))}\n" for k, place in enumerate(places[::4], 1))
    )
    road = shapely.LineString([(200.0, -200.0), (300.0, -420.0), (620.0, -640.0)])
    write_layer(
        ground.folder / "roads.gpkg", VectorLayer("roads", np.array([road]), _names("D 7"), None)
    )
    corners = [ground.place(*corner)[:2] for corner in ((400, 400), (400, 500), (500, 500), (500, 400))]
    field = VectorLayer("map", np.array([shapely.Polygon(corners)]), _names("meadow"), "EPSG:4326")
    write_layer(ground.folder / "map.gpkg", field)
    lake = shapely.Polygon(
        [ground.place(*corner)[:2] for corner in ((450, 450), (450, 490), (490, 490))]
    )
    (ground.folder / "lakes.geojson").write_text(shapely.to_geojson(lake))


def _names(name: str) -> pa.Table:
    return pa.table({"name": [name]})


def _write_json(path: Path, document: object) -> None:
    path.write_text(json.dumps(document))
