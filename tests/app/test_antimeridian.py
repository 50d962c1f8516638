"""Longitude 180 through the middle: images, their block, the store, and a scene registered on it."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

from app.config import Settings
from app.db import engine
from app.db.points import control_points
from app.storage import Storage
from app.usecases.blocks import ingest_block, publish_block
from app.usecases.ground_control import points_of_store
from app.usecases.production import BlockIdentity, run_production
from app.usecases.registration import SceneFiles, run_registration
from services.formats.block_check import check_block
from services.formats.raster import write_raster
from services.production import ProductionOptions
from services.registration import RegistrationOptions
from services.scene import scene_footprint
from services.simulation.view import SimulatedView, ViewPlan, simulate_block, simulate_view
from services.simulation.world import World, make_world

CENTRE = (180.0, -17.0)
SHAPE = (480, 480)
ERROR_M = (21.0, -13.0)
SIGMA_M = 12.0
BLOCK_SIGMA_M = 2.0
a_pixel = 1.0


@cache
def world() -> World:
    return make_world(
        np.random.default_rng(6), size_m=760.0, posting_m=1.0, relief_m=20.0, centre_lon_lat=CENTRE
    )


@cache
def later_view() -> SimulatedView:
    plan = ViewPlan("later", CENTRE, SHAPE, 1.0, incidence_deg=9.0, azimuth_deg=150.0)
    return simulate_view(world(), plan, np.random.default_rng(7), ERROR_M)


def as_file(view: SimulatedView, folder: Path) -> Path:
    path = folder / f"{view.geometry.acquisition.image_id}.tif"
    write_raster(path, view.pixels, view.geometry.delivered)
    return path


@dataclass(frozen=True)
class Made:
    """A block folder and the file of a scene."""

    block: Path
    scene: Path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("antimeridian")
    rng = np.random.default_rng(8)
    views = simulate_block(world(), rng, 2, SHAPE, 1.0, BLOCK_SIGMA_M, 20.0)
    images = [as_file(view, folder) for view in views]
    options = ProductionOptions(fine_gsd_m=1.0, coarse_gsd_m=2.0, points=60)
    run_production(images, folder / "dateline", BlockIdentity("dateline"), options, BLOCK_SIGMA_M)
    return Made(folder / "dateline", as_file(later_view(), folder))


@pytest.fixture
def published(made: Made, dsn: str, storage: Storage) -> None:
    with engine.connect(dsn) as connection:
        block = ingest_block(connection, storage, made.block).block
        publish_block(connection, str(block.number))


def test_points_of_both_sides_are_made_and_spread_as_anywhere(made: Made) -> None:
    contents = check_block(made.block)
    lon = contents.points.lon_lat_h[:, 0]
    assert (lon > 179.99).sum() >= 8
    assert (lon < -179.99).sum() >= 8
    assert len(lon) >= 30
    assert np.ptp(contents.document.metadata.extent[:, 0]) < 0.02


def test_a_footprint_finds_the_points_of_both_sides(made: Made, published: None, dsn: str) -> None:
    points = check_block(made.block).points
    scene = later_view().as_scene(SIGMA_M)
    with engine.connect(dsn) as connection:
        found = control_points(connection, scene_footprint(scene)).points
    seen = later_view().geometry.delivered.project(points.lon_lat_h)
    inside = ((seen >= 0.0) & (seen <= np.array(SHAPE) - 1.0)).all(axis=1)
    assert len(found) >= inside.sum() > 0
    assert (found.lon_lat_h[:, 0] > 0.0).any()
    assert (found.lon_lat_h[:, 0] < 0.0).any()


@pytest.mark.parametrize(
    ("box", "sides"),
    [("179.9,-17.1,-179.9,-16.9", 2), ("179.9,-17.1,180,-16.9", 1), ("-180,-17.1,-179.9,-16.9", 1)],
    ids=["both sides", "east of Asia", "west of America"],
)
def test_boxes_find_what_lies_on_their_side(
    made: Made, published: None, client: TestClient, bearer, box: str, sides: int
) -> None:
    lon = check_block(made.block).points.lon_lat_h[:, 0]
    asked = f"items?bbox={box}&limit=1000"
    points = client.get(f"/collections/points/{asked}", headers=bearer("read")).json()
    expected = len(lon) if sides == 2 else int(((lon > 0.0) == box.endswith(",180,-16.9")).sum())
    assert points["numberReturned"] == expected
    blocks = client.get(f"/collections/blocks/{asked}", headers=bearer("admin")).json()
    assert blocks["numberReturned"] == 1


def test_a_scene_is_registered_on_points_of_the_store(
    made: Made, published: None, settings: Settings, storage: Storage, tmp_path: Path
) -> None:
    assert settings.database_url is not None
    files = SceneFiles(made.scene, sigma_m=SIGMA_M)
    with engine.pooled(settings.database_url.get_secret_value(), settings) as database:
        find = points_of_store(database, storage)
        done = run_registration(files, find, RegistrationOptions(), tmp_path / "out")
    measures = done.registration.measures
    assert measures.active.sum() >= 15
    assert (measures.lon_lat_h[measures.active, 0] > 0.0).any()
    assert (measures.lon_lat_h[measures.active, 0] < 0.0).any()
    truth = later_view().geometry.true_model
    ground = check_block(made.block).points.lon_lat_h
    left_px = done.registration.model.project(ground) - truth.project(ground)
    # What all points share is the error of the block's own frame.
    assert np.hypot(*(left_px - np.median(left_px, axis=0)).T).max() < a_pixel
    assert np.hypot(*np.median(left_px, axis=0)) < 4.0 * BLOCK_SIGMA_M
    assert (tmp_path / "out" / "control_points.geojson").stat().st_size > 0
