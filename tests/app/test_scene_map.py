"""A registered scene on the map, before and after, as tiles for its owner."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from uuid import UUID

import cv2
import numpy as np
import pytest
import rasterio
from fastapi.testclient import TestClient
from rasterio.transform import from_origin

from amers.app.config import Settings
from amers.app.db.engine import Database
from amers.app.storage import Storage
from amers.app.usecases.registered_scene import SceneModel
from amers.app.usecases.scene_map import LAYERS, MappedScene, map_scene
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.sensor_models.correction_json import format_correction
from amers.services.orthorectification.tile_limits import TILE_PX, TileLimits
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.sensors.correction import no_correction
from amers.services.types import Array
from tests.app.callers import Bearer, Caller
from tests.app.flat_world import (
    CENTRE,
    GROUND_H,
    SIGMA_M,
    FlatWorld,
    make_flat_world,
    publish_world,
)
from tests.app.ledger import job_runner, make_token
from tests.app.test_orthorectification import MODEL, write_inputs

pytestmark = pytest.mark.thorough

MERCATOR_M = 40_075_016.68557849
"""Width of the map of the web."""
a_quarter_of_a_pixel_m = 0.11
"""Of the finest tiles, on the ground."""
largest_tile_bytes = 8 * TILE_PX**2
Run = Callable[..., dict]


@dataclass(frozen=True)
class SceneOnMap:
    """A registered scene that a service has drawn on the map.

    Attributes:
        client: of the service.
        me: headers of the owner.
        job: of the drawing.
        results: of it.
        registration: job of the registration.
        report: of it.
    """

    client: TestClient
    me: dict[str, str]
    job: str
    results: dict
    registration: str
    report: dict

    @property
    def levels(self) -> list[TileLimits]:
        return [TileLimits(**one) for one in self.results["tile_limits"]]

    def path(self, layer: str, zoom: int, row: int, column: int) -> str:
        return f"/jobs/{self.job}/map/{layer}/tiles/WebMercatorQuad/{zoom}/{row}/{column}"

    def mosaic(self, layer: str, level: TileLimits) -> Array:
        """All tiles of a zoom (lines, samples, 2): grey values, and 1 where there are any."""
        rows = [
            np.hstack([self.tile(layer, level.zoom, row, column) for column in columns(level)])
            for row in range(level.first_row, level.last_row + 1)
        ]
        return np.vstack(rows)

    def tile(self, layer: str, zoom: int, row: int, column: int) -> Array:
        reply = self.client.get(self.path(layer, zoom, row, column), headers=self.me)
        assert reply.status_code == 200, reply.text
        assert len(reply.content) < largest_tile_bytes
        pixels = cv2.imdecode(np.frombuffer(reply.content, np.uint8), cv2.IMREAD_UNCHANGED)
        assert pixels.shape[:2] == (TILE_PX, TILE_PX)
        if reply.headers["content-type"] == "image/jpeg":
            return np.dstack([pixels, np.ones_like(pixels)]).astype(np.float64)
        assert reply.headers["content-type"] == "image/png"
        return np.dstack([pixels[:, :, 0], pixels[:, :, 3] // 255]).astype(np.float64)


def columns(level: TileLimits) -> range:
    return range(level.first_column, level.last_column + 1)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"))


@pytest.fixture
def run(client: TestClient, database: Database, settings: Settings, me: Caller) -> Run:
    return job_runner(client, database, settings, me)


@pytest.fixture
def on_map(
    client: TestClient, me: Caller, run: Run, world: FlatWorld, dsn: str, storage: Storage
) -> SceneOnMap:
    publish_world(dsn, storage, world)
    path = f"/scenes?name=scene.tif&sigma_m={SIGMA_M}"
    scene = me.post(path, content=world.tagged.read_bytes()).json()["id"]
    registration = run("register-scene", scene=scene)["jobID"]
    drawn = run("map-scene", scene=scene, registration=registration)
    assert drawn["status"] == "successful", str(drawn)
    files = me.get(f"/jobs/{registration}/results").json()
    report = me.get(files["report.json"]["href"]).json()
    results = me.get(f"/jobs/{drawn['jobID']}/results").json()
    return SceneOnMap(client, me, drawn["jobID"], results, registration, report)


def step_m(zoom: int) -> float:
    """Metres on the ground per pixel of a tile in the scene."""
    return float(MERCATOR_M / TILE_PX / 2**zoom * np.cos(np.radians(CENTRE[1])))


def test_raw_and_registered_tiles_differ_by_the_correction_of_the_report(
    on_map: SceneOnMap, world: FlatWorld
) -> None:
    finest = on_map.levels[0]
    raw, registered = (on_map.mosaic(layer, finest) for layer in ("raw", "registered"))
    inside = slice(400, -400)
    (east_px, south_px), agreement = cv2.phaseCorrelate(
        registered[inside, inside, 0], raw[inside, inside, 0], np.ones(raw[inside, inside, 0].shape)
    )
    assert agreement > 0.5
    moved_m = np.hypot(east_px, south_px) * step_m(finest.zoom)
    assert moved_m == pytest.approx(on_map.report["correction"]["shift_m"], abs=a_quarter_of_a_pixel_m)
    line_px, sample_px = on_map.report["correction"]["shift_px"]
    assert np.sign([south_px, east_px]).tolist() == np.sign([line_px, sample_px]).tolist()


def test_a_registered_tile_shows_the_ground_at_its_place_on_the_map(
    on_map: SceneOnMap, world: FlatWorld
) -> None:
    finest = on_map.levels[0]
    shown = on_map.mosaic("registered", finest)
    line, sample = np.mgrid[500 : shown.shape[0] - 500 : 7, 500 : shown.shape[1] - 500 : 7]
    x = (finest.first_column + (sample + 0.5) / TILE_PX) / 2**finest.zoom
    y = (finest.first_row + (line + 0.5) / TILE_PX) / 2**finest.zoom
    lon, lat = 360.0 * x - 180.0, np.degrees(np.arctan(np.sinh(np.pi * (1.0 - 2.0 * y))))
    ground = np.column_stack([lon.ravel(), lat.ravel(), np.full(lon.size, GROUND_H)])
    places = world.true_model.project(ground).astype(np.float32)
    truth = cv2.remap(world.ground, places[:, 1], places[:, 0], cv2.INTER_LINEAR).ravel()
    assert np.corrcoef(truth, shown[line, sample, 0].ravel())[0, 1] > 0.95


def test_coarser_tiles_show_the_same_and_nothing_outside_of_the_scene(on_map: SceneOnMap) -> None:
    levels = on_map.levels
    assert [level.zoom for level in levels] == list(range(levels[0].zoom, levels[-1].zoom - 1, -1))
    assert max(levels[-1].rows, levels[-1].columns) <= 2
    covered_m2 = []
    for fine, coarse in pairwise(levels):
        grey, valid = np.moveaxis(on_map.mosaic("raw", fine), -1, 0)
        top, left = TILE_PX * (fine.first_row % 2), TILE_PX * (fine.first_column % 2)
        less = on_map.mosaic("raw", coarse)
        same = less[top // 2 :, left // 2 :][: len(grey) // 2, : grey.shape[1] // 2]
        mean = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        whole = cv2.resize(valid, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) == 1.0
        assert np.corrcoef(mean[whole], same[whole, 0])[0, 1] > 0.98
        covered_m2 += [
            one[:, :, 1].sum() * step_m(z.zoom) ** 2
            for one, z in ((np.dstack([grey, valid]), fine), (less, coarse))
        ]
    scene_m2 = (1200 * 0.5) ** 2
    assert covered_m2 == pytest.approx([scene_m2] * len(covered_m2), rel=0.02)


def test_the_outlines_run_along_the_pixels_of_their_own_model(on_map: SceneOnMap) -> None:
    """Not around both: the registration moved the scene by many pixels of the tiles."""
    finest = on_map.levels[0]
    for layer in LAYERS:
        lon, lat = np.transpose(on_map.results["outlines"][layer])
        x = (lon + 180.0) / 360.0
        y = 0.5 - np.arctanh(np.sin(np.radians(lat))) / (2.0 * np.pi)
        first = np.array([finest.first_column, finest.first_row])
        corners = (np.column_stack([x, y]) * 2**finest.zoom - first) * TILE_PX - 0.5
        valid = on_map.mosaic(layer, finest)[:, :, 1].astype(np.uint8)
        inside = np.zeros_like(valid)
        cv2.fillPoly(inside, [np.round(corners).astype(np.int32)], 1)
        edge_px = cv2.arcLength(corners.astype(np.float32)[:, None], True)
        assert (inside != valid).sum() < 1.5 * edge_px, layer


def test_tiles_are_only_for_the_owner_and_with_the_scope_to_read(
    on_map: SceneOnMap, bearer: Bearer
) -> None:
    client, level = on_map.client, on_map.levels[0]
    path = on_map.path("raw", level.zoom, level.first_row, level.first_column)
    reply = client.get(path, headers=on_map.me)
    assert reply.headers["cache-control"] == "private, no-cache"
    assert reply.headers["x-content-type-options"] == "nosniff"
    known = {"If-None-Match": reply.headers["etag"]}
    assert client.get(path, headers={**on_map.me, **known}).status_code == 304
    assert client.get(path, headers=bearer("admin")).status_code == 200
    stranger = make_token(client, bearer("admin"))
    for headers, status in ((stranger, 404), (bearer("monitor"), 403), ({}, 401)):
        for asked in ({}, known):
            assert client.get(path, headers={**headers, **asked}).status_code == status
    assert client.delete(f"/jobs/{on_map.job}", headers=on_map.me).status_code == 200
    assert client.get(path, headers={**on_map.me, **known}).status_code == 404


def test_places_without_a_tile_are_not_found(on_map: SceneOnMap) -> None:
    client, level = on_map.client, on_map.levels[0]
    here = (level.zoom, level.first_row, level.first_column)
    absent = [
        on_map.path("raw", *place)
        for place in (
            (level.zoom, level.first_row - 1, level.first_column),
            (level.zoom, level.first_row, level.last_column + 1),
            (level.zoom + 1, level.first_row, level.first_column),
            (level.zoom, -1, -1),
            (-1, 0, 0),
            (10**9, 10**30, 10**30),
        )
    ]
    absent += [
        on_map.path("raw", *here).replace("WebMercatorQuad", "WorldCRS84Quad"),
        on_map.path("raw", *here).replace(on_map.job, str(UUID(int=1))),
        on_map.path("raw", *here).replace(on_map.job, on_map.registration),
    ]
    absent += [on_map.path("other", *here), on_map.path("raw", "a", 0, 0)]  # type: ignore[arg-type]
    for path in absent:
        reply = client.get(path, headers=on_map.me)
        assert reply.status_code == 404, f"{path}: {reply.text}"


def test_a_map_is_refused_without_a_registration_of_the_scene(
    on_map: SceneOnMap, bearer: Bearer, world: FlatWorld
) -> None:
    client, me = on_map.client, on_map.me
    scene = client.post("/scenes?name=b.tif", content=world.tagged.read_bytes(), headers=me).json()["id"]
    stranger = make_token(client, bearer("admin"))
    known = {"scene": scene, "registration": on_map.registration}
    for more, headers, status in (
        ({}, me, 422),
        ({"vertical": "ellipsoid"}, me, 422),
        ({"dem": "../dem.tif"}, me, 422),
        ({}, stranger, 404),
        ({}, bearer("read"), 403),
        ({}, {}, 401),
    ):
        body = {"inputs": {**known, **more}}
        reply = client.post("/processes/map-scene/execution", json=body, headers=headers)
        assert reply.status_code == status, reply.text


def drawn_on(terrain: TerrainFile | None, image: Path, folder: Path) -> tuple[MappedScene, list[bytes]]:
    """The map of a scene whose registration moved it by a line, and both files of tiles."""
    shape = (300, 400)
    moved = replace(no_correction(shape), parameters=np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    registration = folder / "registration"
    registration.mkdir(exist_ok=True)
    stated = CorrectionAccuracy(moved, np.zeros((6, 6)), np.zeros(2))
    text = format_correction(stated, "shift", applies_to="tags", carried="tags")
    (registration / "correction.json").write_text(text)
    lon, lat, height_m = (float(number) for number in MODEL.ground_offset)
    point = {"type": "Point", "coordinates": [lon, lat, height_m]}
    features = [{"type": "Feature", "geometry": point, "properties": {}}]
    document = {"type": "FeatureCollection", "features": features}
    (registration / "control_points.geojson").write_text(json.dumps(document))
    outputs = {layer: folder / f"{layer}.tiles" for layer in LAYERS}
    mapped = map_scene(SceneModel(image, registration=registration), terrain, outputs)
    return mapped, [path.read_bytes() for path in outputs.values()]


def test_a_terrain_as_high_as_the_points_gives_the_same_tiles(tmp_path: Path) -> None:
    image, dem = write_inputs(tmp_path)
    on_points, tiles = drawn_on(None, image, tmp_path)
    on_terrain, same = drawn_on(TerrainFile(dem, "ellipsoid"), image, tmp_path)
    assert on_points.heights == "that of one control point"
    assert on_terrain.heights != on_points.heights
    assert on_terrain.limits == on_points.limits
    raw, registered = tiles
    assert raw != registered
    assert [len(one) for one in same] == pytest.approx([len(one) for one in tiles], rel=0.02)


def test_an_ortho_image_is_drawn_where_its_grid_and_its_correction_put_it(tmp_path: Path) -> None:
    lon, lat, _ = MODEL.ground_offset
    step = 1.0 / 111_320.0
    pixels = np.arange(300 * 400, dtype=np.uint16).reshape(300, 400) // 2 + 1
    profile = {"driver": "GTiff", "height": 300, "width": 400, "count": 1, "dtype": "uint16"}
    transform = from_origin(lon - 200 * step, lat + 150 * step, step, step)
    with rasterio.open(
        tmp_path / "ortho.tif", "w", crs="EPSG:4326", transform=transform, **profile
    ) as file:
        file.write(pixels, 1)
    mapped, (raw, registered) = drawn_on(None, tmp_path / "ortho.tif", tmp_path)
    west, south, east, north = mapped.bounds
    assert west == pytest.approx(lon - 200 * step, abs=step)
    assert east == pytest.approx(lon + 200 * step, abs=step)
    assert north == pytest.approx(lat + 151 * step, abs=step / 2.0)
    assert north - south == pytest.approx(300 * step, abs=step / 2.0)
    assert raw != registered
