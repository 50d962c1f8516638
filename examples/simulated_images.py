"""Images of a simulated piece of ground, which stand in for your own in the examples."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

from amers.services.formats.images.raster import write_raster
from amers.services.sensors.base import SensorModel
from amers.services.simulation.view import (
    SimulatedView,
    ViewPlan,
    plan_geometry,
    simulate_block,
    simulate_view,
)
from amers.services.simulation.world import World, make_world

SHAPE = (700, 700)
GSD_M = 1.0


def write_block_images(folder: Path) -> list[Path]:
    """Write three overlapping images, each with a model that is 3 m wrong, and return their paths."""
    rng = np.random.default_rng(2)
    views = simulate_block(
        _world(), rng, n_views=3, shape=SHAPE, gsd_m=GSD_M, error_m=3.0, largest_incidence_deg=20.0
    )
    return [_write(view, folder) for view in views]


def write_scene(folder: Path) -> Path:
    """Write another image of the same ground, with a model that is 50 m wrong, and return its path."""
    world, rng = _world(), np.random.default_rng(3)
    return _write(simulate_view(world, _plan(world), rng, ground_error_m=(40.0, -30.0)), folder)


def true_model_of_scene() -> SensorModel:
    """The true model of that image; for a real image it is unknown."""
    world, rng = _world(), np.random.default_rng(3)
    return plan_geometry(world, _plan(world), rng, ground_error_m=(40.0, -30.0)).true_model


def write_terrain(path: Path) -> Path:
    """Write the heights of the ground above the ellipsoid, without buildings, and return the path."""
    world = _world()
    west, north = world.origin_lon_lat + world.step_deg / 2.0 * [-1.0, 1.0]
    lines, samples = world.terrain_m.shape
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=lines,
        width=samples,
        count=1,
        dtype="float32",
        crs="EPSG:4326",
        transform=from_origin(west, north, *world.step_deg),
    ) as file:
        file.write(world.terrain_m, 1)
    return path


def _plan(world: World) -> ViewPlan:
    lon, lat = (float(degrees) for degrees in world.centre_lon_lat)
    day = datetime(2024, 7, 3, 10, 30, tzinfo=UTC)
    return ViewPlan(
        "scene", (lon, lat), SHAPE, GSD_M, incidence_deg=11.0, azimuth_deg=200.0, acquired_at=day
    )


def _world() -> World:
    """A square kilometre of fields, woods and villages; the same at every call."""
    return make_world(np.random.default_rng(1), size_m=1000.0, posting_m=1.0)


def _write(view: SimulatedView, folder: Path) -> Path:
    """Write an image as a GeoTIFF that has its RPC in its tags, as a producer delivers it."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{view.geometry.plan.image_id}.tif"
    write_raster(path, view.pixels, view.geometry.delivered)
    return path
