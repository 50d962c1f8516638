"""The whole work on a simulated world, compared with the truth: images, block, store, scene, report."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.usecases import storage_identity
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.demo_map import show_on_map
from amers.app.usecases.image_production import ProductionImages, run_image_production
from amers.app.usecases.installation import Installation
from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.registration.control_sources import points_of_store
from amers.app.usecases.registration.register import (
    ControlSources,
    SceneFiles,
    image_key,
    record_registration,
    run_registration,
)
from amers.app.usecases.registration.result_folder import replacing
from amers.services.adjustment.intersection import intersect
from amers.services.formats.images.raster import write_raster
from amers.services.geodesy import east_north_up, lon_lat_h_from_east_north_up
from amers.services.production.image_production import Production, ProductionOptions
from amers.services.quality.accuracy import Quantile, sample_quantile
from amers.services.registration.on_points import Registration
from amers.services.simulation.view import (
    SimulatedView,
    ViewPlan,
    simulate_block,
    simulate_view,
    true_ground,
    true_line_sample,
)
from amers.services.simulation.world import World, make_world
from amers.services.types import Array, Observations, Progress, part_of

_SEED = 1
"""Of all random numbers."""
_SIZE_M, _POSTING_M, _RELIEF_M = 2600.0, 1.0, 120.0
"""Of the world."""
_VIEWS = 4
"""Images that the block is made from."""
_SHAPE, _GSD_M = (2200, 2200), 1.0
"""Lines and samples of all images, and their ground sampling."""
_BLOCK_ERROR_M = 4.0
"""Error of the models of the block's images, each in a direction of its own."""
_SCENE_ERROR_M = (40.0, -30.0)
"""Error of the scene's model, east and north."""
_SCENE_SKEW_PX = 1.0
"""Additional error of the scene's model at the edges of the image."""
_PRODUCTION = ProductionOptions(fine_gsd_m=2.0, coarse_gsd_m=10.0, points=250, surface_pairs=1)


@dataclass(frozen=True)
class DemoCounts:
    """Numbers of points made, loaded into the store, and served for the scene's footprint."""

    produced: int
    ingested: int
    served: int


@dataclass(frozen=True)
class DemoOutcome:
    """The results of the demonstration beside the truth.

    Attributes:
        counts: of points.
        registration: of the scene.
        before_m: CE90 of the scene's delivered model against the truth.
        in_frame_px: CE90 of the registered model against the truth shifted into the block's frame.
        absolute_m: CE90 of the registered model against the truth.
        injected_m: east and north error of the scene's delivered model at its centre.
        to_recover_m: the same error relative to the block's frame.
        recovered_m: the error that the registration corrected there, east and north.
        frame_error_m: error of the block's frame, east, north, up.
        report: path of the report page.
    """

    counts: DemoCounts
    registration: Registration
    before_m: Quantile
    in_frame_px: Quantile
    absolute_m: Quantile
    injected_m: Array
    to_recover_m: Array
    recovered_m: Array
    frame_error_m: Array
    report: Path


@dataclass(frozen=True)
class _Truth:
    """The simulated world, the images of the block and the scene."""

    world: World
    sources: list[SimulatedView]
    scene: SimulatedView


def run_demo(folder: Path, settings: Settings, progress: Progress) -> DemoOutcome:
    """Simulate, produce, ingest, publish, query, register, and compare with the truth.

    Args:
        folder: for images, block and report; must be empty.
        settings: of a store for the demonstration alone, which keeps the block, the scene and its jobs.
        progress: receives the fraction done and a message.
    """
    truth = _simulate(progress)
    images = [_write_image(view, folder / "images") for view in truth.sources]
    image = _write_image(truth.scene, folder / "images")

    production = run_image_production(
        ProductionImages(tuple(images), sigma_m=_BLOCK_ERROR_M),
        folder / "block",
        BlockIdentity("demo", title="Demonstration on a simulated world", license="CC0-1.0"),
        _PRODUCTION,
        progress=part_of(progress, 0.3, 0.4),
    )
    with engine.opened(settings) as database:
        storage = storage_identity.opened(database, settings)
        progress(0.7, "ingesting the block")
        with database.transaction() as connection:
            ingested = lifecycle.ingest_block(connection, storage, folder / "block")
            lifecycle.publish_block(connection, str(ingested.block.number))
        sigma_m = float(np.hypot(*_SCENE_ERROR_M))
        find_points = points_of_store(database, storage)
        with replacing(folder / "registered") as new:
            registered = run_registration(
                SceneFiles(image, sigma_m=sigma_m),
                ControlSources(find_points),
                new,
                progress=part_of(progress, 0.75, 0.15),
            )
        with database.transaction() as connection:
            record_registration(connection, registered, image_key(image))
        n_served = len(find_points(registered.footprint).points)
        progress(0.9, "registering the scene in the service, and drawing it on the map")
        show_on_map(Installation(database, storage, settings), image, sigma_m)
    counts = DemoCounts(len(production.points), ingested.block.n_points, n_served)
    report = folder / "registered" / "report.html"
    return _compare(truth, production, registered.registration, counts, report)


def _simulate(progress: Progress) -> _Truth:
    rng = np.random.default_rng(_SEED)
    progress(0.0, "simulating a world")
    world = make_world(rng, _SIZE_M, _POSTING_M, _RELIEF_M)
    progress(0.05, f"simulating {_VIEWS} images for the block")
    sources = simulate_block(
        world,
        rng,
        n_views=_VIEWS,
        shape=_SHAPE,
        gsd_m=_GSD_M,
        error_m=_BLOCK_ERROR_M,
    )
    progress(0.25, "simulating the scene")
    return _Truth(world, sources, _scene(world, rng))


def _scene(world: World, rng: np.random.Generator) -> SimulatedView:
    lon, lat = (float(v) for v in world.centre_lon_lat)
    plan = ViewPlan(
        image_id="scene",
        lon_lat=(lon, lat),
        shape=_SHAPE,
        gsd_m=_GSD_M,
        incidence_deg=12.0,
        azimuth_deg=100.0,
        acquired_at=datetime(2024, 8, 20, 10, 30, tzinfo=UTC),
    )
    skew_px = np.array([[0.0, 0.0, _SCENE_SKEW_PX], [0.0, _SCENE_SKEW_PX, 0.0]])
    return simulate_view(world, plan, rng, _SCENE_ERROR_M, skew_px)


def _write_image(view: SimulatedView, folder: Path) -> Path:
    """Write a simulated image with its delivered model as a GeoTIFF; returns its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{view.geometry.plan.image_id}.tif"
    write_raster(path, view.pixels, view.geometry.delivered)
    return path


def _compare(
    truth: _Truth,
    production: Production,
    registration: Registration,
    counts: DemoCounts,
    report: Path,
) -> DemoOutcome:
    """The outcome beside the truth, over a grid of the ground that the scene shows."""
    world, scene = truth.world, truth.scene
    origin = np.append(world.centre_lon_lat, np.mean(world.height_range_m))
    frame_m = _frame_error_m(truth.sources, production, origin)
    ground = _grid(scene, world)
    moved = lon_lat_h_from_east_north_up(east_north_up(ground, origin) + frame_m, origin)
    true_px = true_line_sample(scene, ground)
    gsd_m = scene.geometry.plan.gsd_m
    model = registration.model
    delivered = scene.geometry.delivered
    centre = _centre(scene, world)
    centre_moved = lon_lat_h_from_east_north_up(east_north_up(centre, origin) + frame_m, origin)
    true_centre = true_line_sample(scene, centre)

    def metres(error_px: Array) -> Array:
        derivative = delivered.project_derivative(centre)[0, :, :2]
        return np.asarray(np.linalg.solve(derivative, error_px[0]), dtype=np.float64)

    return DemoOutcome(
        counts=counts,
        registration=registration,
        before_m=_ce90((delivered.project(ground) - true_px) * gsd_m),
        in_frame_px=_ce90(model.project(moved) - true_px),
        absolute_m=_ce90((model.project(ground) - true_px) * gsd_m),
        injected_m=metres(delivered.project(centre) - true_centre),
        to_recover_m=metres(delivered.project(centre_moved) - true_centre),
        recovered_m=metres(delivered.project(centre_moved) - model.project(centre_moved)),
        frame_error_m=frame_m,
        report=report,
    )


def _frame_error_m(sources: list[SimulatedView], production: Production, origin: Array) -> Array:
    """East, north, up (3,) from the true positions of the block's points to the positions in the block.

    An adjusted model projects a point of the block to the image position that shows it. The rays of the
    true models through these image positions intersect at the true position of the point.
    """
    points = production.points.lon_lat_h
    n, views = len(points), len(sources)
    seen = np.stack([model.project(points) for model in production.adjustment.models], axis=1)
    rays = Observations(
        np.repeat(np.arange(n), views),
        np.tile(np.arange(views), n),
        seen.reshape(-1, 2),
        np.ones(n * views),
    )
    true = intersect([view.geometry.true_model for view in sources], rays, n)
    return np.asarray(
        np.median(east_north_up(points, origin) - east_north_up(true.lon_lat_h, origin), axis=0)
    )


def _grid(scene: SimulatedView, world: World) -> Array:
    """Ground points (n, 3) that the scene shows, on a regular grid of the image."""
    lines, samples = scene.pixels.shape
    axes = np.linspace(0.0, lines - 1.0, 21), np.linspace(0.0, samples - 1.0, 21)
    line_sample = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    ground = true_ground(scene, world, line_sample)
    return np.asarray(ground[np.isfinite(ground).all(axis=1)])


def _centre(scene: SimulatedView, world: World) -> Array:
    """Ground point (1, 3) at the centre of the scene."""
    return true_ground(scene, world, (np.array([scene.pixels.shape]) - 1.0) / 2.0)


def _ce90(error: Array) -> Quantile:
    return sample_quantile(np.hypot(error[:, 0], error[:, 1]))
