"""A scene of any size in a file and a block of points in it, rendered only around the points."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window as RasterWindow

from amers.services.formats.block.document import BlockMetadata, BlockSpecification, Provenance
from amers.services.formats.block.writer import write_block
from amers.services.formats.images.raster import gdal_rpc
from amers.services.geodesy import metres_per_degree
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ImageSource, Window
from amers.services.sensors.rpc import RpcModel
from amers.services.simulation.render import surface_seen
from amers.services.simulation.tiles import TiledView
from amers.services.simulation.view import ViewPlan, plan_geometry
from amers.services.simulation.world import World, make_world
from amers.services.types import Array, ControlPoints
from benchmarks._simulated import lay_points

GSD_M = 0.5
CHIP_GSD_M = 2.0
REFERENCE_GSD_M = 2.0
REFERENCE_MARGIN_M = 600.0
REFERENCES = (
    (12.0, 100.0, datetime(2024, 5, 28, 10, 25, tzinfo=UTC)),
    (10.0, 290.0, datetime(2024, 7, 14, 10, 50, tzinfo=UTC)),
    (14.0, 190.0, datetime(2024, 6, 2, 10, 35, tzinfo=UTC)),
    (8.0, 20.0, datetime(2024, 6, 25, 10, 40, tzinfo=UTC)),
    (16.0, 240.0, datetime(2024, 7, 1, 10, 45, tzinfo=UTC)),
    (11.0, 330.0, datetime(2024, 6, 12, 10, 30, tzinfo=UTC)),
)
"""Incidence, azimuth and time of the views the block is made from."""
BORDER_M = 250.0
CANDIDATES_A_SIDE = 18
ERROR_M = (12.0, -9.0)
DRIFT_PX = np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 2.0]])
SIGMA_M = 10.0
SEED = 4
BLOCK_PX = 256
_FILL_SIDE = 4
"""Blocks of the texture that is repeated between the points, along each side."""


def make_case(folder: Path, size: int) -> None:
    """A block of points, a scene of a size that shows them, and what some of its pixels truly show."""
    world = make_world(np.random.default_rng(SEED), size_m=2_000.0)
    points = make_block(folder, world, size)
    plan = ViewPlan(
        f"scene_{size}",
        place(world),
        (size, size),
        GSD_M,
        incidence_deg=14.0,
        azimuth_deg=200.0,
        acquired_at=datetime(2024, 6, 20, 10, 40, tzinfo=UTC),
    )
    geometry = plan_geometry(world, plan, np.random.default_rng([SEED, size]), ERROR_M, DRIFT_PX)
    # A chip, the search around it, its diagonal turned by the view, and what the low-pass needs.
    reach_px = int((1.25 * 50.0 * CHIP_GSD_M + 3.0 * np.hypot(SIGMA_M, 1.0) + 20.0) / GSD_M)
    write_around(
        folder / "scene.tif",
        TiledView(world, geometry, SEED),
        geometry.delivered,
        geometry.delivered.project(points.lon_lat_h),
        reach_px,
    )
    axis = np.linspace(0.0, size - 1.0, 25)
    line_sample = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    shown = surface_seen(world, geometry.true_model, line_sample)
    np.savez(folder / "truth.npz", line_sample=line_sample, lon_lat_h=shown)


def make_block(folder: Path, world: World, size: int) -> ControlPoints:
    """Points measured in six views whose models are true, well spread over the ground of a scene."""
    rng = np.random.default_rng(SEED)
    side_px = int((size * GSD_M + 2.0 * REFERENCE_MARGIN_M) / REFERENCE_GSD_M)
    references = []
    for number, (incidence_deg, azimuth_deg, acquired_at) in enumerate(REFERENCES):
        plan = ViewPlan(
            f"reference_{number}",
            place(world),
            (side_px, side_px),
            REFERENCE_GSD_M,
            incidence_deg,
            azimuth_deg,
            acquired_at,
        )
        geometry = plan_geometry(world, plan, rng)
        image = TiledView(world, geometry, SEED + 1 + number)
        references.append(Scene(image, geometry.rpc, geometry.acquisition, 0.0))
    step = (np.arange(CANDIDATES_A_SIDE) + 0.5) / CANDIDATES_A_SIDE - 0.5
    grid = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    grid += rng.uniform(-0.3, 0.3, grid.shape) / CANDIDATES_A_SIDE
    metres = np.array(metres_per_degree(float(world.centre_lon_lat[1]), 0.0))
    lon_lat = world.centre_lon_lat + grid * (size * GSD_M - 2.0 * BORDER_M) / metres
    points, cut = lay_points(world, references, lon_lat, (CHIP_GSD_M,))
    low, high = points.lon_lat_h[:, :2].min(axis=0), points.lon_lat_h[:, :2].max(axis=0)
    metadata = BlockMetadata(
        id="bench",
        version="1",
        title="Points of simulated ground",
        description="",
        license="",
        extent=np.array([low, [high[0], low[1]], high, [low[0], high[1]]]),
        created=datetime(2024, 7, 1, tzinfo=UTC),
        specification=BlockSpecification((CHIP_GSD_M,), len(REFERENCES)),
        provenance=Provenance(
            "benchmarks", "1", tuple(scene.acquisition.image_id for scene in references), {}
        ),
    )
    write_block(folder / "block", metadata, points, cut, {})
    return points


def write_around(path: Path, image: ImageSource, model: RpcModel, places: Array, reach_px: int) -> None:
    """Write an image as a tiled, compressed GeoTIFF with RPC tags, true only around some places.

    Between them a piece of the image is repeated, so that every block costs what a block of an image
    costs, on disk and to read.

    Args:
        path: the file.
        image: what is rendered around the places.
        model: for the tags.
        places: (n, 2) line, sample.
        reach_px: how far around them, along lines and samples.
    """
    lines, samples = image.shape
    first = np.maximum(np.floor(places).astype(int) - reach_px, 0)
    last = np.minimum(np.ceil(places).astype(int) + reach_px + 1, image.shape)
    shown = (last > first).all(axis=1)
    first, last = first[shown], last[shown]
    side = _FILL_SIDE * BLOCK_PX
    texture = image.read(Window(lines // 2, samples // 2, side, side)).astype(np.uint16)
    fill = np.tile(texture, (1, -(-samples // side)))[:, :samples]
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=lines,
        width=samples,
        count=1,
        dtype="uint16",
        tiled=True,
        blockxsize=BLOCK_PX,
        blockysize=BLOCK_PX,
        compress="deflate",
        predictor=2,
        BIGTIFF="IF_SAFER",
    ) as file:
        file.rpcs = gdal_rpc(model)
        for line in range(0, lines, BLOCK_PX):
            count = min(BLOCK_PX, lines - line)
            start = line % side
            strip = fill[start : start + count].copy()
            for k in np.flatnonzero((first[:, 0] < line + count) & (last[:, 0] > line)):
                top, bottom = max(first[k, 0], line), min(last[k, 0], line + count)
                left, right = (int(edge[k, 1]) for edge in (first, last))
                window = Window(int(top), left, int(bottom - top), right - left)
                strip[top - line : bottom - line, left:right] = image.read(window)
            file.write(strip, 1, window=RasterWindow(0, line, samples, count))


def place(world: World) -> tuple[float, float]:
    """Longitude and latitude of the middle of everything."""
    lon, lat = world.centre_lon_lat.tolist()
    return lon, lat
