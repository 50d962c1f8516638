"""Scenes as STAC items: times, angles, footprints and files."""

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from fastapi.testclient import TestClient
from shapely.geometry import shape

from amers.app.config import Settings
from amers.app.db import engine, scenes
from amers.app.main import create_app
from amers.services.types import Acquisition
from tests.app.callers import Bearer, Caller
from tests.app.job_queue import store_registration

ITEMS = "/collections/scenes/items"
TAKEN = datetime(2024, 6, 21, 10, 30, tzinfo=UTC)
GSD_M = 0.5
seven_decimals_deg = 1e-7


@pytest.fixture
def scene(me: Caller) -> str:
    reply = me.post("/scenes?name=a.tif", content=b"II*\0" + bytes(100))
    scene = str(reply.json()["id"])
    me.put(f"/scenes/{scene}/files/a_RPC.TXT", content=b"LINE_OFF: 1")
    return scene


@pytest.fixture
def described(dsn: str, scene: str) -> Callable[..., None]:
    """Records what the files of the scene state, and an outline (n, 2) of lon, lat."""

    def describe(outline: list[list[float]], azimuth_deg: float = 90.0) -> None:
        taken = Acquisition(
            image_id="a",
            sensor="PHR1A",
            acquired_at=TAKEN,
            incidence_deg=12.0,
            azimuth_deg=azimuth_deg,
            sun_elevation_deg=60.0,
            sun_azimuth_deg=150.0,
        )
        with engine.connect(dsn) as connection:
            scenes.set_footprint(connection, UUID(scene), np.array(outline))
            scenes.describe(connection, UUID(scene), taken, (3000, 2000), GSD_M)

    return describe


@pytest.fixture
def item(me: Caller, scene: str) -> Callable[[], dict[str, Any]]:
    def item() -> dict[str, Any]:
        reply = me.get(f"{ITEMS}/{scene}")
        assert reply.status_code == 200, reply.text
        return dict(reply.json())

    return item


def test_an_item_has_what_the_files_of_a_scene_state(item, described):
    properties = item()["properties"]
    assert properties["datetime"] == properties["created"], "when it was taken is not known yet"
    assert "amers:acquired" not in properties
    assert "platform" not in properties, "what is not known is left out, as STAC has it"
    described([[5.0, 43.0], [5.2, 43.0], [5.2, 43.1], [5.0, 43.1]])
    now = item()
    properties = now["properties"]
    assert (
        datetime.fromisoformat(properties["datetime"])
        == TAKEN
        == datetime.fromisoformat(properties["amers:acquired"])
    )
    assert (properties["platform"], properties["gsd"], properties["proj:shape"]) == (
        "PHR1A",
        GSD_M,
        [3000, 2000],
    )
    assert (properties["view:incidence_angle"], properties["view:sun_elevation"]) == (12.0, 60.0)
    assert now["bbox"] == pytest.approx([5.0, 43.0, 5.2, 43.1], abs=seven_decimals_deg)


def test_stac_looks_from_the_sensor_to_the_scene(item, described):
    for from_the_ground, from_the_sensor in [(90.0, 270.0), (200.0, 20.0), (0.0, 180.0)]:
        described([[5.0, 43.0], [5.2, 43.0], [5.2, 43.1]], from_the_ground)
        assert item()["properties"]["view:azimuth"] == from_the_sensor, from_the_ground


def test_a_scene_across_the_antimeridian_has_its_west_greater_than_its_east(item, described):
    described([[179.9, -17.0], [180.1, -17.0], [180.1, -16.9], [179.9, -16.9]])
    assert item()["bbox"] == pytest.approx([179.9, -17.0, -179.9, -16.9], abs=seven_decimals_deg)


def test_scenes_are_filtered_by_the_property_names_of_items(me: Caller, scene: str, described):
    described([[5.0, 43.0], [5.2, 43.0], [5.2, 43.1]])

    def found(**query: str) -> list[str]:
        reply = me.get(ITEMS, params=query)
        assert reply.status_code == 200, reply.text
        return [feature["id"] for feature in reply.json()["features"]]

    assert found(datetime="2024-06-21") == found(filter="gsd < 0.6 and platform = 'PHR1A'") == [scene]
    assert found(filter='"view:sun_elevation" > 50') == found(title="a.tif") == [scene]
    assert found(datetime="2024-06-22/..") == found(title="b.tif") == []


def test_other_formats_have_the_same_scenes(me: Caller, scene: str, described):
    described([[5.0, 43.0], [5.2, 43.0], [5.2, 43.1]])
    for form in ("csv", "html", "gpkg", "parquet"):
        reply = me.get(ITEMS, params={"f": form, "datetime": "2024-06-21"})
        assert reply.status_code == 200, reply.text
    text = me.get(ITEMS, params={"f": "csv"}).text
    assert scene in text
    assert "view:sun_elevation" in text
    mercator = {"crs": "http://www.opengis.net/def/crs/EPSG/0/3857"}
    feature = me.get(ITEMS, params=mercator).json()["features"][0]
    assert "stac_version" not in feature, "items are in longitude and latitude"


def test_only_the_owner_gets_the_files_of_a_scene_until_it_is_removed(
    client: TestClient, me: Caller, bearer: Bearer, scene: str, item
):
    assets = item()["assets"]
    assert set(assets) == {"image", "a_RPC.TXT"}
    image, model = (assets[name]["href"] for name in ("image", "a_RPC.TXT"))
    assert me.get(image).content == b"II*\0" + bytes(100)
    assert me.get(model).content == b"LINE_OFF: 1"
    part = client.get(image, headers=me | {"Range": "bytes=0-2"})
    assert (part.status_code, part.content) == (206, b"II*")
    for href in (image, model):
        assert bearer("register").get(href).status_code == 404
        assert bearer("read").get(href).status_code == 403
        assert client.get(href).status_code == 401
    for name in ("b.tif", "..%2Fa.tif", "%2e%2e"):
        assert me.get(f"/scenes/{scene}/files/{name}").status_code == 404
    me.delete(f"/scenes/{scene}")
    assert item()["assets"] == {}
    assert item()["properties"]["amers:state"] == "removed"
    assert me.get(image).status_code == 404


def test_a_scene_on_the_server_is_taken_where_it_lies(
    settings: Settings, bearer: Bearer, tmp_path: Path
):
    folder, me = tmp_path / "archive", bearer("register")
    (folder / "2024").mkdir(parents=True)
    (folder / "2024" / "a.tif").write_bytes(b"II*\0" + bytes(100))
    (folder / "2024" / "notes.tif").write_bytes(b"no image")
    (tmp_path / "secret.tif").write_bytes(b"II*\0")
    (folder / "link.tif").symlink_to(tmp_path / "secret.tif")
    with TestClient(create_app(settings.model_copy(update={"scene_folder": folder}))) as client:

        def refer(path: str) -> Any:
            return client.post("/scenes/reference", json={"path": path, "sigma_m": 8.5}, headers=me)

        reply = refer("2024/a.tif")
        assert reply.status_code == 201, reply.text
        scene = reply.json()
        assert (scene["state"], scene["name"], scene["sigma_m"]) == ("uploaded", "a.tif", 8.5)
        assert client.get(reply.headers["location"], headers=me).json() == scene
        for path in ("../secret.tif", "link.tif", "2024", "2024/none.tif", str(tmp_path / "secret.tif")):
            assert refer(path).status_code == 422, path
        assert refer("2024/notes.tif").status_code == 422
        item = client.get(f"{ITEMS}/{scene['id']}", headers=me).json()
        assert item["assets"] == {}, "what lies on the server is not given away"
        body = {"inputs": {"scene": scene["id"]}}
        assert (
            client.post("/processes/register-scene/execution", json=body, headers=me).status_code == 201
        )
        model = client.put(f"/scenes/{scene['id']}/files/a_RPC.TXT", content=b"x", headers=me)
        assert model.status_code == 409
        assert client.delete(f"/scenes/{scene['id']}", headers=me).status_code == 204
    assert (folder / "2024" / "a.tif").exists()
    with TestClient(create_app(settings)) as client:
        closed = client.post("/scenes/reference", json={"path": "2024/a.tif"}, headers=me)
        assert "AMERS_SCENE_FOLDER" in closed.json()["detail"]


def test_an_item_of_a_registered_scene_has_the_area_for_which_accuracy_is_stated(item, scene, dsn):
    ring = [[5.0, 43.0], [5.1, 43.0], [5.1, 43.1], [5.0, 43.0]]
    coverage = {"percent": 81.5, "polygons_lon_lat": [[ring]]}
    with engine.connect(dsn) as connection:
        store_registration(connection, scene_id=UUID(scene), report={"coverage": coverage})
    properties = item()["properties"]
    assert properties["amers:held_percent"] == 81.5
    assert shape(properties["amers:held_area"]).area == pytest.approx(0.005)
    assert "amers:held_polygons" not in properties
