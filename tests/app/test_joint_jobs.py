"""Scenes registered together by the process `register-scenes`, and what uses their registrations."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
import rasterio
import shapely
from fastapi.testclient import TestClient
from jsonschema import validate
from rasterio.transform import from_origin

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.engine import Database
from amers.app.storage import Storage
from amers.app.usecases.retention import remove_old_results
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.formats.vector.layers import read_layer
from amers.services.map_grid import xy_of_lon_lat
from amers.services.reports.document import failure_schema
from amers.services.types import Frame
from tests.app.callers import Bearer
from tests.app.flat_world import (
    CENTRE,
    GROUND_H,
    GSD_M,
    SIGMA_M,
    FlatWorld,
    make_flat_world,
    publish_world,
)
from tests.app.joint_world import (
    A_FIFTH_OF_A_PIXEL,
    SCENES,
    true_model,
    write_scene,
    write_scenes,
)
from tests.app.ledger import bytes_in_ledger, bytes_in_storage, job_runner, make_token
from tests.app.registration_outputs import largest_error_px
from tests.app.test_vectors import drawn
from tests.app.worker_processes import ended, running_worker
from tests.statements import run_sql

pytestmark = [pytest.mark.long, pytest.mark.thorough]

UTM = "EPSG:32631"
EXECUTION = "/processes/{}/execution"
Headers = dict[str, str]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    # As large as scenes must be for the verdict "good".
    return make_flat_world(
        tmp_path_factory.mktemp("world"), points=100, frame=Frame.from_sigmas(2.0, 3.0)
    )


@pytest.fixture(scope="module")
def folder(world: FlatWorld, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes of the ground of the block, and one of other ground."""
    return write_scenes(world, tmp_path_factory.mktemp("scenes"))


@dataclass(frozen=True)
class Caller:
    """A caller of a service, whose jobs are done here."""

    client: TestClient
    headers: Headers
    run: Callable[..., dict]

    def upload(self, image: Path) -> str:
        """Upload a scene; returns its id."""
        path = f"/scenes?name={image.name}&sigma_m={SIGMA_M}"
        reply = self.client.post(path, content=image.read_bytes(), headers=self.headers)
        scene: str = reply.json()["id"]
        return scene

    def lay(self, scene: str, path: Path) -> None:
        """Upload a file beside the image of a scene."""
        where = f"/scenes/{scene}/files/{path.name}"
        laid = self.client.put(where, content=path.read_bytes(), headers=self.headers)
        assert laid.status_code == 200, laid.text

    def done(self, process: str, **inputs: object) -> tuple[str, dict]:
        """The id and the results of a successful job."""
        job = self.run(process, **inputs)
        assert job["status"] == "successful", job
        answer = self.client.get(f"/jobs/{job['jobID']}/results", headers=self.headers)
        return job["jobID"], answer.json()

    def refusal(self, process: str, **inputs: object) -> tuple[int, str]:
        """Status and reason of a refused execution."""
        reply = self.client.post(
            EXECUTION.format(process), json={"inputs": inputs}, headers=self.headers
        )
        return reply.status_code, reply.json().get("detail", "")


@pytest.fixture
def me(
    client: TestClient,
    bearer: Bearer,
    database: Database,
    settings: Settings,
    world: FlatWorld,
    dsn: str,
    storage: Storage,
) -> Caller:
    """A caller of a service with the points of the world."""
    publish_world(dsn, storage, world)
    headers = bearer("register")
    return Caller(client, headers, job_runner(client, database, settings, headers))


@pytest.fixture
def stranger(me: Caller, bearer: Bearer) -> Caller:
    return Caller(me.client, make_token(me.client, bearer("admin")), me.run)


@pytest.fixture
def scenes(me: Caller, folder: Path) -> dict[str, str]:
    """The ids of the uploaded scenes of the ground."""
    return {name: me.upload(folder / f"{name}.tif") for name in SCENES}


def write_terrain(path: Path) -> Path:
    """Write the flat ground of the world."""
    place = from_origin(CENTRE[0] - 0.02, CENTRE[1] + 0.02, 0.001, 0.001)
    profile = {"driver": "GTiff", "height": 40, "width": 40, "count": 1, "crs": "EPSG:4326"}
    with rasterio.open(path, "w", **profile, dtype="float32", transform=place) as file:
        file.write(np.full((40, 40), GROUND_H, np.float32), 1)
    return path


def test_a_job_registers_uploaded_scenes_together(
    client: TestClient,
    bearer: Bearer,
    settings: Settings,
    me: Caller,
    scenes: dict[str, str],
    world: FlatWorld,
    folder: Path,
    tmp_path: Path,
    dsn: str,
):
    ids = scenes | {"wrong": me.upload(folder / "wrong.tif")}
    execution = EXECUTION.format("register-scenes")
    all_of_them = list(ids.values())
    for wrong in (
        [all_of_them[0]],
        [all_of_them[0], all_of_them[0]],
        [*all_of_them, "nothing"],
        [],
    ):
        assert me.refusal("register-scenes", scenes=wrong)[0] == 422
    assert me.refusal("register-scenes", scenes=all_of_them, rigorous="best")[0] == 422
    body = {"inputs": {"scenes": all_of_them}}
    assert client.post(execution, json=body, headers=bearer("register")).status_code == 404
    assert client.post(execution, json=body, headers=bearer("read")).status_code == 403
    job = client.post(execution, json=body, headers=me.headers).headers["location"]
    with running_worker(settings, tmp_path / "log"):
        done = ended(client, job, me.headers)
    assert done["status"] == "successful", done
    related = {link["href"] for link in done["links"] if link.get("title") == "scene"}
    assert related == {f"http://testserver/scenes/{scene}" for scene in all_of_them}
    results = client.get(f"/jobs/{done['jobID']}/results", headers=me.headers).json()
    assert results["verdict"] == "not registered"
    assert results["joined"] == []
    verdicts = {one["scene"]: one["verdict"] for one in results["scenes"]}
    assert verdicts.pop(ids["wrong"]) == "not registered"
    assert set(verdicts.values()) <= {"good", "usable"}
    report = client.get(results["report.json"]["href"], headers=me.headers).json()
    validate(report, client.get("/schemas/joint.json").json())
    refined = client.get(results[f"{ids['east']}/refined_RPC.TXT"]["href"], headers=me.headers)
    assert refined.headers["content-type"].startswith("text/plain")
    (tmp_path / "refined_RPC.TXT").write_bytes(refined.content)
    model = read_rpc(folder / "east.tif", tmp_path / "refined_RPC.TXT").model
    assert largest_error_px(model, true_model(world, "east")) < A_FIFTH_OF_A_PIXEL
    failure = client.get(results[f"{ids['wrong']}/report.json"]["href"], headers=me.headers)
    validate(failure.json(), failure_schema())
    with engine.connect(dsn) as connection:
        rows = run_sql(connection, "select job_id, scene_id from registration").fetchall()
    assert {str(row["scene_id"]) for row in rows} == set(verdicts)
    assert {str(row["job_id"]) for row in rows} == {done["jobID"]}


def test_a_registration_is_used_by_its_job_and_its_scene(
    me: Caller,
    stranger: Caller,
    bearer: Bearer,
    scenes: dict[str, str],
    world: FlatWorld,
    folder: Path,
    tmp_path: Path,
    database: Database,
    settings: Settings,
    storage: Storage,
):
    job, results = me.done("register-scenes", scenes=list(scenes.values()))
    assert results["verdict"] == "good", [one["reason"] for one in results["scenes"]]
    for scene in scenes.values():
        item = me.client.get(f"/collections/scenes/items/{scene}", headers=me.headers).json()
        refined = item["assets"]["refined-model"]["href"]
        assert refined == results[f"{scene}/refined_RPC.TXT"]["href"]
        assert me.client.get(refined, headers=me.headers).status_code == 200
        assert me.client.get(refined, headers=stranger.headers).status_code == 404

    # Each scene has its own model: one place on the ground, drawn in either.
    terrain = write_terrain(tmp_path / "dem.tif")
    place = np.array([[*CENTRE, GROUND_H]])
    truth = xy_of_lon_lat(UTM, place[:, :2])
    inputs = {"dem": "dem.tif", "vertical": "ellipsoid", "registration": job}
    vectors = {"vectors": "drawn.geojson", "options": {"pixels": "centre"}}
    for name, scene in scenes.items():
        line, sample = true_model(world, name).project(place)[0]
        me.lay(scene, drawn(tmp_path / "drawn.geojson", f"POINT ({sample} {line})"))
        me.lay(scene, terrain)
        _, answer = me.done("correct-vectors", scene=scene, crs=UTM, **inputs, **vectors)
        frame_m, relative_m = answer["on_the_earth"]["ce90_m"], answer["relative_to_control_points"]
        assert frame_m > np.hypot(2.146 * 2.0, relative_m["ce90_m"]) * 0.99
        file = tmp_path / "vectors.gpkg"
        file.write_bytes(me.client.get(answer["vectors.gpkg"]["href"], headers=me.headers).content)
        corrected = shapely.get_coordinates(read_layer(file).geometries)
        assert np.hypot(*(corrected - truth)[0]) < A_FIFTH_OF_A_PIXEL * GSD_M
    _, answer = me.done("orthorectify", scene=scenes["south"], map={"gsd_m": 2.0}, **inputs)
    assert answer["seen"] > 0.8

    other = me.upload(folder / "wrong.tif")
    for process, more in (("orthorectify", {}), ("correct-vectors", vectors)):
        assert me.refusal(process, scene=other, **inputs, **more) == (
            422,
            f"registration: job {job} did not register scene {other}",
        )
        assert stranger.refusal(process, scene=scenes["east"], **inputs, **more)[0] == 404

    of_admin = bearer("admin")
    admin = Caller(me.client, of_admin, job_runner(me.client, database, settings, of_admin))
    renewal = {"block": "flat", "jobs": [job]}
    assert me.refusal("renew-block", **renewal)[0] == 403
    status, reason = admin.refusal("renew-block", **renewal, scenes=[other])
    assert status == 422
    assert "registered no scene of the scenes named" in reason
    status, reason = admin.refusal("renew-block", **renewal, scenes=[scenes["east"], other])
    assert (status, reason) == (422, f"scenes: {other}: none of the jobs registered this scene")
    _, renewed = admin.done("renew-block", **renewal, scenes=[scenes["east"]])
    document = admin.client.get(renewed["renewal.json"]["href"], headers=admin.headers).json()
    with database.reading() as connection:
        rows = run_sql(connection, "select id, scene_id from registration").fetchall()
        assert bytes_in_ledger(connection) == bytes_in_storage(storage)
    of_scene = {str(row["scene_id"]): str(row["id"]) for row in rows}
    assert [one["registration"] for one in document["scenes"]] == [of_scene[scenes["east"]]]

    remove_old_results(database, storage, -1.0)
    assert storage.keys(f"results/{job}") == []
    assert me.refusal("orthorectify", scene=scenes["south"], **inputs) == (
        409,
        f"registration: the results of job {job} were removed; register scene {scenes['south']} again",
    )
    assert me.client.delete(f"/jobs/{job}", headers=me.headers).status_code == 200
    with database.reading() as connection:
        kept = run_sql(connection, "select job_id, files, verdict from registration").fetchall()
    assert len(kept) == 2
    assert all(row["job_id"] is None and row["files"] == {} for row in kept)
    assert me.refusal("orthorectify", scene=scenes["south"], **inputs)[0] == 422


@pytest.mark.endurance
def test_a_scene_joins_those_of_an_earlier_job(
    me: Caller,
    stranger: Caller,
    scenes: dict[str, str],
    world: FlatWorld,
    folder: Path,
    tmp_path: Path,
    database: Database,
    storage: Storage,
):
    first, before = me.done("register-scenes", scenes=list(scenes.values()))
    kept = {key: storage.path(key).read_bytes() for key in storage.keys(f"results/{first}")}
    # Of the same name as one that it joins.
    path = tmp_path / "east.tif"
    truth = true_model(world, "south")
    write_scene(path, truth, (6.0, 4.0), world.ground, np.random.default_rng(9))
    new = me.upload(path)
    for wrong, status, says in (
        ({"scenes": []}, 422, "scenes: 0 given, with 2 that they join; at least one"),
        (
            {"scenes": [new, scenes["east"]]},
            422,
            f"job {first} has registered one of these scenes already",
        ),
        ({"join": str(UUID(int=1))}, 404, f"no job {UUID(int=1)}"),
    ):
        refused = me.refusal("register-scenes", **({"scenes": [new], "join": first} | wrong))
        assert refused[0] == status
        assert says in refused[1]
    theirs = stranger.upload(path)
    assert stranger.refusal("register-scenes", scenes=[theirs], join=first) == (404, f"no job {first}")
    waiting = {
        process: me.client.post(
            EXECUTION.format(process), json={"inputs": inputs}, headers=me.headers
        ).json()["jobID"]
        for process, inputs in (
            ("register-scene", {"scene": new}),
            ("register-scenes", {"scenes": [new], "join": first}),
        )
    }
    assert me.refusal("register-scenes", scenes=[new], join=waiting["register-scene"]) == (
        422,
        f"join: job {waiting['register-scene']} is of the process register-scene, one of "
        "register-scenes is expected",
    )
    assert me.refusal("register-scenes", scenes=[new], join=waiting["register-scenes"]) == (
        409,
        f"join: job {waiting['register-scenes']} is accepted, successful is expected",
    )

    second, answer = me.done("register-scenes", scenes=[new], join=first)
    assert sorted(answer["joined"]) == sorted(scenes.values())
    assert [one["scene"] for one in answer["scenes"]] == [new]
    assert answer["verdict"] in ("good", "usable")
    refined = me.client.get(answer[f"{new}/refined_RPC.TXT"]["href"], headers=me.headers)
    (tmp_path / "refined_RPC.TXT").write_bytes(refined.content)
    model = read_rpc(path, tmp_path / "refined_RPC.TXT").model
    assert largest_error_px(model, truth) < A_FIFTH_OF_A_PIXEL
    report = me.client.get(answer["report.json"]["href"], headers=me.headers).json()
    assert len(report["joined"]) == 2
    assert {key: storage.path(key).read_bytes() for key in storage.keys(f"results/{first}")} == kept
    served = me.client.get(before["scenes.json"]["href"], headers=me.headers).json()
    assert sorted(one["image"] for one in served["scenes"]) == sorted(scenes.values())

    # Those that the second job joined take part in what joins it.
    third = me.upload(path)
    assert me.refusal("register-scenes", scenes=[scenes["south"]], join=second)[0] == 422
    last, answer = me.done("register-scenes", scenes=[third], join=second)
    assert sorted(answer["joined"]) == sorted([*scenes.values(), new])

    assert me.client.delete(f"/scenes/{scenes['south']}", headers=me.headers).status_code < 300
    again = me.upload(path)
    refused = me.refusal("register-scenes", scenes=[again], join=last)
    assert refused == (409, f"scene {scenes['south']} is removed, uploaded is expected")
    remove_old_results(database, storage, -1.0)
    refused = me.refusal("register-scenes", scenes=[again], join=last)
    assert refused == (409, f"join: the results of job {last} were removed; register its scenes again")
