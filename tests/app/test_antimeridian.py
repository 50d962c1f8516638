"""Data across the antimeridian: images, their block, the store, and a scene registered on it."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from uuid import UUID

import geopandas
import numpy as np
import pytest
import shapely
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.features.antimeridian import on_the_map
from amers.app.db.features.crs import EPSG_3857
from amers.app.db.points import control_points
from amers.app.db.scenes import set_footprint
from amers.app.storage import Storage
from amers.app.usecases.image_production import ProductionImages, run_image_production
from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.registration.control_sources import points_of_store
from amers.app.usecases.registration.register import ControlSources, SceneFiles, run_registration
from amers.services.formats.block.check import check_block
from amers.services.formats.images.raster import write_raster
from amers.services.imagery.scene import scene_footprint
from amers.services.production.image_production import ProductionOptions
from amers.services.simulation.view import SimulatedView, ViewPlan, simulate_block, simulate_view
from amers.services.simulation.world import World, make_world
from tests.app.served import serve_block

pytestmark = pytest.mark.long

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
    views = simulate_block(
        world(),
        rng,
        n_views=2,
        shape=SHAPE,
        gsd_m=1.0,
        error_m=BLOCK_SIGMA_M,
        largest_incidence_deg=20.0,
    )
    images = [as_file(view, folder) for view in views]
    options = ProductionOptions(fine_gsd_m=1.0, coarse_gsd_m=2.0, points=60, surface_pairs=0)
    delivered = ProductionImages(tuple(images), sigma_m=BLOCK_SIGMA_M)
    run_image_production(delivered, folder / "dateline", BlockIdentity("dateline"), options)
    return Made(folder / "dateline", as_file(later_view(), folder))


@pytest.fixture
def published(made: Made, dsn: str, storage: Storage) -> None:
    with engine.connect(dsn) as connection:
        serve_block(connection, storage, made.block)


def test_points_of_both_sides_are_made_and_spread_as_anywhere(made: Made) -> None:
    contents = check_block(made.block)
    lon = contents.points.lon_lat_h[:, 0]
    assert (lon > 179.99).sum() >= 8
    assert (lon < -179.99).sum() >= 8
    assert len(lon) >= 30
    assert np.ptp(contents.document.metadata.extent[:, 0]) < 0.02


@pytest.mark.thorough
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


def test_boxes_find_what_lies_on_their_side(made: Made, published: None, bearer) -> None:
    lon = check_block(made.block).points.lon_lat_h[:, 0]
    for box, sides in [
        ("179.9,-17.1,-179.9,-16.9", 2),
        ("179.9,-17.1,180,-16.9", 1),
        ("-180,-17.1,-179.9,-16.9", 1),
    ]:
        asked = f"items?bbox={box}&limit=1000"
        points = bearer("read").get(f"/collections/points/{asked}").json()
        expected = len(lon) if sides == 2 else int(((lon > 0.0) == box.endswith(",180,-16.9")).sum())
        assert points["numberReturned"] == expected, box
        blocks = bearer("admin").get(f"/collections/blocks/{asked}").json()
        assert blocks["numberReturned"] == 1, box


def outlines_of(client: TestClient, headers: dict[str, str], how: str = "GET", **asked: Any) -> Any:
    path = "/collections/blocks/items" if how == "GET" else "/collections/blocks/search"
    place = {"params": asked} if how == "GET" else {"json": asked}
    return client.request(how, path, headers=headers, **place).json()["features"]


def test_an_outline_across_is_two_counterclockwise_parts(
    published: None, client: TestClient, bearer
) -> None:
    (block,) = outlines_of(client, bearer("read"))
    assert block["geometry"]["type"] == "MultiPolygon"
    parts = [shapely.Polygon(*rings) for rings in block["geometry"]["coordinates"]]
    assert all(part.exterior.is_ccw for part in parts)
    west, east = sorted(parts, key=lambda part: -part.bounds[0])
    assert west.bounds[2] == 180.0
    assert east.bounds[0] == -180.0
    assert west.bounds[0] > 179.9
    assert east.bounds[2] < -179.9


@pytest.mark.parametrize("form", ["parquet", "fgb", "gpkg"])
def test_files_hold_both_parts(published: None, bearer, tmp_path: Path, form: str) -> None:
    reply = bearer("read").get(f"/collections/blocks/items?f={form}")
    path = tmp_path / f"blocks.{form}"
    path.write_bytes(reply.content)
    read = geopandas.read_parquet(path) if form == "parquet" else geopandas.read_file(path)
    assert read.geometry.geom_type.tolist() == ["MultiPolygon"]
    assert read.total_bounds[[0, 2]].tolist() == [-180.0, 180.0]


@pytest.mark.parametrize("x", [0, 255], ids=["west of America", "east of Asia"])
def test_tiles_of_both_sides_show_the_block(published: None, bearer, x: int) -> None:
    row = int((1.0 - np.arcsinh(np.tan(np.radians(CENTRE[1]))) / np.pi) / 2.0 * 256)
    tile = bearer("read").get(f"/collections/blocks/tiles/WebMercatorQuad/8/{row}/{x}")
    assert b"dateline" in tile.content


AROUND = [[179.9, -17.1], [180.1, -17.1], [180.1, -16.9], [179.9, -16.9], [179.9, -17.1]]
BEFORE = [[lon if lon < 180.0 else 180.0, lat] for lon, lat in AROUND]
TURNED = [[lon - 360.0, lat] for lon, lat in AROUND]
BEYOND = [[-180.0 if lon < 180.0 else lon - 360.0, lat] for lon, lat in AROUND]


@pytest.mark.parametrize("ring", [AROUND, TURNED, BEFORE, BEYOND], ids=["on", "turned", "west", "east"])
def test_geometries_of_queries_intersect_features_on_either_side(
    made: Made, published: None, client: TestClient, bearer, ring: list[list[float]]
) -> None:
    lon = check_block(made.block).points.lon_lat_h[:, 0]
    inside = np.ones(len(lon), bool) if ring in (AROUND, TURNED) else (lon > 0.0) == (ring is BEFORE)
    polygon = {"type": "Polygon", "coordinates": [ring]}
    text = ", ".join(f"{x} {y}" for x, y in ring)
    questions = (
        {"intersects": polygon},
        {"filter": {"op": "s_intersects", "args": [{"property": "geometry"}, polygon]}},
        {"filter": f"s_intersects(geometry, polygon(({text})))"},
    )
    for question in questions:
        asked = {**question, "limit": 1000}
        points = bearer("read").post("/collections/points/search", json=asked).json()
        assert points["numberReturned"] == inside.sum()
        assert len(outlines_of(client, bearer("read"), "POST", **question)) == 1


def test_a_geometry_in_metres_goes_on_beyond_the_edge_of_the_map(
    made: Made, published: None, bearer
) -> None:
    east, north = 20_037_508.342789244, -1_920_000.0
    ring = [(east + x, north + y) for x, y in [(-9e4, -9e4), (9e4, -9e4), (9e4, 9e4), (-9e4, 9e4)]]
    text = ", ".join(f"{x} {y}" for x, y in [*ring, ring[0]])
    question = {
        "filter": f"s_intersects(geometry, polygon(({text})))",
        "filter-crs": EPSG_3857.uri,
        "limit": 1000,
    }
    page = bearer("read").post("/collections/points/search", json=question).json()
    assert page["numberReturned"] == len(check_block(made.block).points)


@pytest.mark.parametrize(
    "wrong",
    [
        {"type": "Polygon", "coordinates": [[[0, 0], [1, 1], [0, 1], [1, 0], [0, 0]]]},
        {"type": "Point", "coordinates": [361.0, 0.0]},
        {"type": "Circle"},
    ],
    ids=["crosses itself", "too far", "no geometry"],
)
def test_a_geometry_that_cannot_be_used_is_refused_by_the_name_it_came_under(
    bearer, wrong: dict[str, Any]
) -> None:
    meets = {"op": "s_intersects", "args": [{"property": "geometry"}, wrong]}
    for name, value in (("intersects", wrong), ("filter", meets)):
        reply = bearer("read").post("/collections/points/search", json={name: value})
        assert reply.status_code == 400
        assert reply.json()["detail"].startswith(f"{name}: ")


def test_a_scene_across_is_a_stac_item_whose_box_begins_in_the_east(
    bearer, made: Made, dsn: str
) -> None:
    caller = bearer("register")
    sent = caller.post("/scenes?name=a.tif", content=made.scene.read_bytes()).json()
    outline = np.array([(179.5, -17.0), (180.5, -17.0), (180.5, -16.0), (179.5, -16.0)])
    with engine.connect(dsn) as connection:
        set_footprint(connection, UUID(sent["id"]), outline)
    item = caller.get(f"/collections/scenes/items/{sent['id']}").json()
    assert item["geometry"]["type"] == "MultiPolygon"
    assert item["bbox"] == [179.5, -17.0, -179.5, -16.0]
    document = caller.get("/search?bbox=-180,-17,-179.9,-16").json()
    assert [one["id"] for one in document["features"]] == [sent["id"]]


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ("POLYGON ((179 0, 181 0, 181 1, 179 1, 179 0))", 2),
        ("POLYGON ((180 0, 181 0, 181 1, 180 1, 180 0))", 1),
        ("POLYGON ((-200 0, 200 0, 200 1, -200 1, -200 0))", 1),
        ("LINESTRING (170 0, 190 10)", 2),
        ("POINT (181 5)", 1),
        ("MULTIPOINT (181 5, 10 5)", 2),
    ],
)
def test_what_lies_across_is_cut_and_nothing_of_it_is_lost(shape: str, expected: int) -> None:
    whole = shapely.from_wkt(shape)
    cut = on_the_map(whole)
    assert len(shapely.get_parts(cut)) == expected
    assert shapely.get_dimensions(cut) == shapely.get_dimensions(whole)
    assert np.abs(shapely.get_coordinates(cut)[:, 0]).max() <= 180.0
    overlap = 40.0 if "-200" in shape else 0.0
    assert cut.area == pytest.approx(whole.area - overlap)
    assert cut.length == pytest.approx(whole.length) or whole.area > 0.0


@pytest.mark.thorough
def test_a_scene_is_registered_on_points_of_the_store(
    made: Made, published: None, settings: Settings, storage: Storage, tmp_path: Path
) -> None:
    assert settings.database_url is not None
    files = SceneFiles(made.scene, sigma_m=SIGMA_M)
    with engine.pooled(settings.database_url.get_secret_value(), settings) as database:
        sources = ControlSources(points_of_store(database, storage))
        done = run_registration(files, sources, tmp_path / "out")
    measures = done.registration.measures
    assert measures.active.sum() >= 15
    assert (measures.lon_lat_h[measures.active, 0] > 0.0).any()
    assert (measures.lon_lat_h[measures.active, 0] < 0.0).any()
    truth = later_view().geometry.true_model
    ground = check_block(made.block).points.lon_lat_h
    left_px = done.registration.model.project(ground) - truth.project(ground)
    # The common part of the errors is the error of the block's frame.
    assert np.hypot(*(left_px - np.median(left_px, axis=0)).T).max() < a_pixel
    assert np.hypot(*np.median(left_px, axis=0)) < 4.0 * BLOCK_SIGMA_M
    assert (tmp_path / "out" / "control_points.geojson").stat().st_size > 0
