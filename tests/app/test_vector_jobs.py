"""Vectors between raw scenes and the map, by a service."""

import json
from collections.abc import Callable
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
import shapely
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db.engine import Database
from amers.app.db.jobs import jobs
from amers.app.storage import Storage
from amers.services.formats.vector.layers import read_layer
from amers.services.map_grid import xy_of_lon_lat
from amers.services.types import Frame
from tests.app.callers import Bearer, Caller
from tests.app.job_queue import store_registration
from tests.app.ledger import job_runner, make_token
from tests.app.test_orthorectification import in_the_image, write_inputs
from tests.app.test_vectors import UTM, a_millimetre, drawn, on_ground, registered

A_HUNDREDTH_PX = 0.01
LINES_OFF = 7
"""By which the delivered model is off and the registered one is not."""
OUTPUTS = ("vectors", "vertices")

Run = Callable[..., dict]
Upload = Callable[[Path], None]


@pytest.fixture
def run(client: TestClient, database: Database, settings: Settings, me: Caller) -> Run:
    return job_runner(client, database, settings, me)


@pytest.fixture
def scene(me: Caller, tmp_path: Path) -> str:
    """An uploaded scene with flat ground beside it."""
    image, dem = write_inputs(tmp_path)
    scene: str = me.scene(image.read_bytes())
    lay(me, scene, dem)
    return scene


def lay(me: Caller, scene: str, path: Path) -> None:
    """Upload a file beside the image of a scene."""
    laid = me.put(f"/scenes/{scene}/files/{path.name}", content=path.read_bytes())
    assert laid.status_code == 200, laid.text


@pytest.fixture
def registration(scene: str, storage: Storage, database: Database, tmp_path: Path) -> str:
    """The job of a registration of the scene."""
    folder = registered(tmp_path / "made", in_the_image(LINES_OFF), Frame.from_sigmas(3.0, 3.0))
    names = ("correction.json", "refined_RPC.TXT")
    keys = {name: storage.put_file(f"results/a/1/{name}", folder / name).key for name in names}
    with database.transaction() as connection:
        job = jobs.create(connection, "register-scene", {})
        assert job is not None
        store_registration(connection, job_id=job.id, scene_id=UUID(scene), files=keys)
    return str(job.id)


@pytest.fixture
def inputs(scene: str) -> dict[str, object]:
    return {"scene": scene, "vectors": "drawn.geojson", "dem": "dem.tif", "vertical": "ellipsoid"}


def results(
    client: TestClient, me: dict[str, str], ended: dict, folder: Path, suffix: str
) -> tuple[dict, dict[str, np.ndarray]]:
    """The results of a job, and the coordinates in each of its files, which are written to a folder."""
    assert ended["status"] == "successful", str(ended)
    answer = client.get(f"/jobs/{ended['jobID']}/results", headers=me).json()
    places = {}
    for name in (f"{kind}.{suffix}" for kind in OUTPUTS):
        served = client.get(answer[name]["href"], headers=me)
        kind = {"gpkg": "application/geopackage+sqlite3", "geojson": "application/geo+json"}[suffix]
        assert served.headers["content-type"].startswith(kind)
        (folder / name).write_bytes(served.content)
        places[name] = shapely.get_coordinates(read_layer(folder / name).geometries)
    return answer, places


def test_a_service_corrects_vectors_uploaded_beside_a_scene(
    client: TestClient,
    me: Caller,
    run: Run,
    inputs: dict[str, object],
    registration: str,
    tmp_path: Path,
) -> None:
    lines = drawn(tmp_path / "drawn.geojson", "LINESTRING (100.5 -50.5, 300.5 -250.5)")
    lay(me, str(inputs["scene"]), lines)
    ended = run("correct-vectors", **inputs, registration=registration, crs=UTM)
    answer, places = results(client, me, ended, tmp_path, "gpkg")
    assert (answer["features"], answer["vertices"], answer["left_out"]) == (1, 2, [])
    assert answer["on_the_earth"]["ce90_m"] > answer["relative_to_control_points"]["ce90_m"]
    expected = on_ground(in_the_image(LINES_OFF), [50, 250], [100, 300])
    for actual in places.values():
        np.testing.assert_allclose(actual, xy_of_lon_lat(UTM, expected), atol=a_millimetre)

    ended = run("correct-vectors", **inputs, registration=registration, format="geojson")
    for actual in results(client, me, ended, tmp_path, "geojson")[1].values():
        np.testing.assert_allclose(actual, expected, atol=1e-8)

    failed = run("correct-vectors", **inputs, options={"pixels": "corner"})
    assert failed["error"]["error"] == "InputError"
    assert "with --pixels qgis all of them lie inside" in failed["error"]["detail"]
    for process, wrong, says in (
        ("correct-vectors", {"registration": str(UUID(int=1))}, "did not register scene"),
        ("correct-vectors", {"vectors": "drawn.gpkg"}, "one of .geojson, .json expected"),
        ("correct-vectors", {"options": {"sigma_px": -1.0}}, "sigma_px: -1 found, 0 or more expected"),
        ("correct-vectors", {"format": "shp"}, "format: Input should be 'gpkg' or 'geojson'"),
        ("project-vectors", {"registration": str(UUID(int=1))}, "did not register scene"),
        ("project-vectors", {"vectors": "../drawn.geojson"}, "is not the name of a file"),
        ("project-vectors", {"options": {"tolerance_px": 0.0}}, "tolerance_px: 0 found, more than 0 px"),
        ("project-vectors", {"options": {"sigma_px": 1.0}}, "options.sigma_px: no such input"),
    ):
        refused = me.execute(process, inputs | wrong)
        assert refused.status_code == 422
        assert says in refused.json()["detail"]


def test_vectors_of_the_map_come_into_a_registered_scene_and_back(
    client: TestClient,
    me: Caller,
    run: Run,
    inputs: dict[str, object],
    registration: str,
    tmp_path: Path,
) -> None:
    lines, samples = [50.0, 250.0], [100.0, 300.0]
    lon_lat = on_ground(in_the_image(LINES_OFF), lines, samples)
    far = lon_lat[0] + 0.5
    wkt = [
        f"LINESTRING ({', '.join(f'{lon} {lat}' for lon, lat in lon_lat)})",
        f"POINT ({far[0]} {far[1]})",
    ]
    lay(me, str(inputs["scene"]), drawn(tmp_path / "drawn.geojson", *wkt))
    expected = np.column_stack([np.array(samples) + 0.5, -np.array(lines) - 0.5])
    for suffix in ("gpkg", "geojson"):
        ended = run("project-vectors", **inputs, registration=registration, format=suffix)
        answer, places = results(client, me, ended, tmp_path, suffix)
        assert (answer["features"], answer["outside"], answer["hidden_vertices"]) == (1, 1, 0)
        assert answer["left_out"] == []
        for actual in places.values():
            np.testing.assert_allclose(actual[[0, -1]], expected, atol=A_HUNDREDTH_PX)
    rows = read_layer(tmp_path / "vertices.gpkg").attributes.to_pylist()
    np.testing.assert_allclose([rows[0]["lon"], rows[0]["lat"]], lon_lat[0], atol=1e-8)

    # What came out goes in again, as the map page sends it.
    again = tmp_path / "again.geojson"
    again.write_bytes((tmp_path / "vectors.geojson").read_bytes())
    lay(me, str(inputs["scene"]), again)
    back = inputs | {"vectors": again.name}
    ended = run("correct-vectors", **back, registration=registration, format="geojson")
    places = results(client, me, ended, tmp_path, "geojson")[1]
    np.testing.assert_allclose(places["vectors.geojson"][[0, -1]], lon_lat, atol=1e-6)

    ended = run("project-vectors", **inputs, options={"pixels": "centre", "clip": True})
    delivered = results(client, me, ended, tmp_path, "gpkg")[1]["vectors.gpkg"]
    moved = np.column_stack([samples, np.array(lines) + LINES_OFF])
    np.testing.assert_allclose(delivered[[0, -1]], moved, atol=A_HUNDREDTH_PX)


@pytest.mark.parametrize(
    "crs", ["EPSG:5773", "EPSG:4978", "EPSG:999999", "urn:ogc:def:crs:IAU:2015:30100"]
)
def test_vectors_in_a_reference_system_that_is_no_map_end_the_job_with_its_name(
    me: Caller, run: Run, inputs: dict[str, object], tmp_path: Path, crs: str
) -> None:
    lon, lat = on_ground(in_the_image(), [50], [100])[0]
    document = {
        "type": "FeatureCollection",
        "crs": {"type": "name", "properties": {"name": crs}},
        "features": [
            {
                "type": "Feature",
                "properties": {},
                "geometry": {"type": "Point", "coordinates": [lon, lat]},
            }
        ],
    }
    path = tmp_path / "drawn.geojson"
    path.write_text(json.dumps(document))
    lay(me, str(inputs["scene"]), path)
    failed = run("project-vectors", **inputs)
    assert failed["status"] == "failed", str(failed)
    assert "reference system" in failed["error"]["detail"]


@pytest.mark.parametrize("process", ["correct-vectors", "project-vectors"])
def test_a_stranger_cannot_use_a_scene_for_vectors(
    client: TestClient, bearer: Bearer, tmp_path: Path, process: str
) -> None:
    image, _ = write_inputs(tmp_path)
    owner, stranger = bearer("register"), make_token(client, bearer("admin"))
    scene = owner.scene(image.read_bytes())
    body = {"inputs": {"scene": scene, "vectors": "a.geojson", "dem": "dem.tif"}}
    for headers, status in ((stranger, 404), (bearer("read"), 403), ({}, 401)):
        reply = client.post(f"/processes/{process}/execution", json=body, headers=headers)
        assert reply.status_code == status


def test_what_cannot_be_used_is_left_out_by_name_and_a_taken_name_is_changed(
    client: TestClient,
    me: Caller,
    run: Run,
    inputs: dict[str, object],
    registration: str,
    tmp_path: Path,
) -> None:
    lines = drawn(tmp_path / "drawn.geojson", "POINT (100.5 -50.5)", "POINT (1 -1)", "POINT (2 -2)")
    document = json.loads(lines.read_text())
    document["features"][0]["properties"]["geom"] = "a name of mine"
    document["features"][1]["geometry"]["type"] = "Circle"
    lines.write_text(json.dumps(document))
    lay(me, str(inputs["scene"]), lines)
    ended = run("correct-vectors", **inputs, registration=registration, crs=UTM)
    answer, _ = results(client, me, ended, tmp_path, "gpkg")
    assert (answer["features"], answer["left_out"]) == (2, [])
    assert answer["unusable"] == {"2": "unknown type of geometry 'Circle'"}
    assert answer["renamed"] == {"geom": "geom_1"}
    read = read_layer(tmp_path / "vectors.gpkg").attributes
    assert read["geom_1"].to_pylist() == ["a name of mine", None]
