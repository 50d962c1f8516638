"""From an image and a block to a refined model: over HTTP with a worker, and by the use case."""

import json
from dataclasses import replace
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
from fastapi.testclient import TestClient
from jsonschema import validate

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.engine import Database
from amers.app.db.usage import read_usage
from amers.app.storage import Storage
from amers.app.usecases.registration.control_sources import points_of_block, points_of_store
from amers.app.usecases.registration.register import ControlSources, SceneFiles, run_registration
from amers.app.usecases.results import reconcile_results
from amers.app.usecases.retention import remove_old_results
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.sensors.refined import refined_rpc
from tests.app.callers import Bearer, Caller
from tests.app.flat_world import SIGMA_M, FlatWorld, make_flat_world, publish_world
from tests.app.registration_outputs import (
    A_TENTH_OF_A_PIXEL,
    CHECK_POINTS,
    COMMON_FILES,
    assert_masked,
    assert_registered,
    largest_error_px,
    write_check_points,
    write_mask,
)
from tests.app.worker_processes import ended, running_worker
from tests.statements import run_sql

pytestmark = pytest.mark.thorough


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    """A block and a scene whose model is wrong by a known shift."""
    return make_flat_world(tmp_path_factory.mktemp("world"))


@pytest.fixture
def published(world: FlatWorld, dsn: str, storage: Storage) -> None:
    """The points of the world, in the store and visible."""
    publish_world(dsn, storage, world)


def test_the_delivered_model_is_wrong_before(world: FlatWorld):
    delivered = read_rpc(world.tagged).model
    assert largest_error_px(delivered, world.true_model) > 10.0


def test_a_correction_that_mixes_lines_and_samples_is_carried_by_a_fitted_rpc(world: FlatWorld):
    shape = (1200, 1200)
    affine = replace(no_correction(shape), parameters=np.array([[9.0, 1.0, -2.0], [-7.0, 1.5, 0.5]]))
    corrected = CorrectedModel(world.true_model, affine)
    refined = refined_rpc(corrected, shape)
    a_hundredth_of_a_pixel = 0.01
    assert 0.0 < refined.max_error_px < a_hundredth_of_a_pixel
    assert largest_error_px(refined.model, corrected) < a_hundredth_of_a_pixel
    drift = replace(affine, parameters=np.array([[9.0, 1.0, 0.0], [-7.0, 0.0, 0.5]]))
    folded = refined_rpc(CorrectedModel(world.true_model, drift), shape)
    assert folded.max_error_px == 0.0
    assert largest_error_px(folded.model, CorrectedModel(world.true_model, drift)) < 1e-6


def test_a_scene_goes_from_upload_to_a_refined_model_by_http(
    client: TestClient,
    bearer: Bearer,
    settings: Settings,
    published: None,
    world: FlatWorld,
    tmp_path: Path,
    dsn: str,
    me: Caller,
):
    upload = me.post(f"/scenes?name=scene.tif&sigma_m={SIGMA_M}", content=world.image.read_bytes())
    scene = upload.json()["id"]
    write_check_points(tmp_path / "checks.geojson", world)
    write_mask(tmp_path / "mask.tif")
    for path in (world.rpc_text, tmp_path / "checks.geojson", tmp_path / "mask.tif"):
        laid = me.put(f"/scenes/{scene}/files/{path.name}", content=path.read_bytes())
        assert laid.status_code == 200, laid.text
    assert me.put(f"/scenes/{scene}/files/a.exe", content=b"MZ").status_code == 422
    inputs = {
        "scene": scene,
        "bands": "1",
        "mask": "mask.tif",
        "check_points": "checks.geojson",
        "copy_image": True,
        "options": {"max_points": 30},
    }
    wrong = {"inputs": {**inputs, "bands": "zero"}}
    execution = "/processes/register-scene/execution"
    assert me.post(execution, json=wrong).status_code == 422
    response = me.execute("register-scene", inputs)
    with running_worker(settings, tmp_path / "log"):
        ended_job = ended(client, response.headers["location"], me)
    assert (ended_job["status"], ended_job["progress"]) == ("successful", 100), ended_job
    results = me.get(f"/jobs/{ended_job['jobID']}/results").json()
    assert results.pop("verdict") in ("good", "usable")
    assert results.pop("method") == "control points"
    assert results.pop("verdict_scope") == "relative to the control points"
    worst_m = results.pop("relative_to_control_points")["ce90_m"]
    assert results.pop("on_the_earth")["ce90_m"] is None
    assert set(results) == COMMON_FILES | {"scene_RPC.TXT", "scene.tif"}
    folder = tmp_path / "downloaded"
    folder.mkdir()
    for name, link in results.items():
        reply = me.get(link["href"])
        assert reply.headers["content-type"].startswith(link["type"])
        (folder / name).write_bytes(reply.content)
        assert bearer("register").get(link["href"]).status_code == 404
    assert_registered(folder, world)
    page = me.get(results["report.html"]["href"])
    assert page.headers["content-security-policy"] == (
        "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"
    )
    for name in ("..%2Freport.json", "nothing.json", "%2e%2e"):
        assert me.get(f"/jobs/{ended_job['jobID']}/results/{name}").status_code == 404
    assert me.get(f"/scenes/{scene}").json()["footprint"]["type"] == "Polygon"
    assert largest_error_px(read_rpc(folder / "scene.tif").model, world.true_model) < A_TENTH_OF_A_PIXEL
    report = json.loads((folder / "report.json").read_text())
    # No point tells how the image is bent beneath the mask, over its first lines: none is held.
    ce90_px = np.array(report["predicted"]["ce90_px"])
    assert ce90_px[3:5].max() < 1.0 < ce90_px[0].min()
    assert worst_m == pytest.approx(0.5 * report["predicted"]["worst_px"], rel=0.05)
    assert report["predicted"]["worst_px"] < ce90_px[0].min()
    assert report["coverage"]["percent"] < 95.0
    assert report["checks"][0]["accuracy"]["n"] == CHECK_POINTS
    assert_masked(folder)
    with engine.connect(dsn) as connection:
        counts = run_sql(
            connection, "select count(*) as tried, count(*) filter (where active) as active from measure"
        ).fetchone()
        used = run_sql(connection, "select block_versions, options from registration").fetchone()
    assert counts == {
        "tried": report["point_counts"]["visible"],
        "active": report["point_counts"]["active"],
    }
    assert used is not None
    assert used["block_versions"] == [{"id": "flat", "version": "1"}]
    assert used["options"]["max_points"] == 30


def test_a_job_that_finds_no_consensus_keeps_the_report_of_its_failure(
    client: TestClient,
    bearer: Bearer,
    settings: Settings,
    published: None,
    world: FlatWorld,
    tmp_path: Path,
    database: Database,
    storage: Storage,
    me: Caller,
):
    # The points lie 8 m from where a model with a stated accuracy of 0.1 m expects them.
    image = world.tagged.read_bytes()
    scene = me.scene(image, f"name=scene.tif&sigma_m={SIGMA_M}")
    body = {"inputs": {"scene": scene, "sigma_m": 0.1}}
    for unusable in (0, -1):
        assert me.execute("register-scene", body["inputs"] | {"sigma_m": unusable}).status_code == 422
    assert me.get(f"/scenes/{scene}").json()["registrations"] == []
    asked = me.post("/processes/register-scene/execution", json=body)
    with running_worker(settings, tmp_path / "log"):
        job = ended(client, asked.headers["location"], me)
    assert (job["status"], job.get("amers:verdict")) == ("failed", "not registered"), job
    assert me.get(f"/jobs/{job['jobID']}/results").status_code == 409
    links = {link["title"]: link for link in job["links"] if "/results/" in link["href"]}
    assert set(links) == {"report.json", "report.html", "report.txt"}
    report = me.get(links["report.json"]["href"]).json()
    validate(report, client.get("/schemas/failure.json").json())
    assert (report["scene"]["name"], report["visible"]) == ("scene", 40)
    assert report["search_stages"][-1]["tried"] == 40
    assert "--sigma-m" in report["next_steps"][0]["command"]
    page = me.get(links["report.html"]["href"])
    assert page.headers["content-type"].startswith("text/html")
    for text in (json.dumps(report), page.text):
        assert str(tmp_path) not in text
        assert "/tmp/" not in text
    assert bearer("register").get(links["report.html"]["href"]).status_code == 404
    (listed,) = me.get("/jobs").json()["jobs"]
    assert listed["amers:verdict"] == "not registered"
    (one,) = me.get(f"/scenes/{scene}").json()["registrations"]
    assert (one["job"], one["outcome"], one["verdict"]) == (job["jobID"], "failed", "not registered")
    assert bearer("register").get("/scenes").json()["scenes"] == []
    metrics = bearer("admin").get("/metrics").text
    assert 'amers_registration_jobs{verdict="not registered"} 1.0' in metrics
    # The files belong to the job: sweeps keep them, and retention removes them.
    reconcile_results(database, storage)
    folder = f"results/{job['jobID']}"
    sizes = storage.sizes(folder)
    assert len(sizes) == 3
    owner = UUID(me.get("/tokens/self").json()["id"])
    with database.transaction() as connection:
        assert read_usage(connection, owner).result_bytes == sum(sizes.values()), "of the owner's quota"
        run_sql(connection, "update job set finished_at = finished_at - interval '2 days'")
        run_sql(connection, "update uptime set elapsed_s = elapsed_s + 86400 * 2")
    remove_old_results(database, storage, days=1.0)
    assert storage.keys(folder) == []
    with database.transaction() as connection:
        assert read_usage(connection, owner).result_bytes == 0
    assert me.get(links["report.html"]["href"]).status_code == 404
    gone = me.get(f"/jobs/{job['jobID']}").json()
    assert not [link for link in gone["links"] if "/results/" in link["href"]]


def test_a_job_whose_verdict_is_failed_says_so_in_every_list(
    client: TestClient,
    me: Caller,
    settings: Settings,
    published: None,
    world: FlatWorld,
    tmp_path: Path,
):
    image = world.tagged.read_bytes()
    scene = me.scene(image, f"name=scene.tif&sigma_m={SIGMA_M}")
    strict = {"options": {"qualification": {"usable_active_points": 1000}}}
    asked = [
        me.execute("register-scene", {"scene": scene, **more}).headers["location"]
        for more in (strict, {})
    ]
    with running_worker(settings, tmp_path / "log"):
        failed, done = (ended(client, job, me) for job in asked)
    assert failed["status"] == done["status"] == "successful"
    assert (failed["amers:verdict"], done["amers:verdict"]) in (("failed", "good"), ("failed", "usable"))
    assert failed["message"] == "done, verdict failed: do not use the refined model"
    assert done["message"] == f"done, verdict {done['amers:verdict']}"
    listed = me.get("/jobs").json()["jobs"]
    assert {job["jobID"]: job["amers:verdict"] for job in listed} == {
        job["jobID"]: job["amers:verdict"] for job in (failed, done)
    }
    assert [job["amers:sceneNames"] for job in listed] == [["scene.tif"]] * 2
    (newest,) = me.get("/scenes").json()["scenes"][0]["registrations"]
    assert (newest["job"], newest["outcome"]) == (done["jobID"], "registered")
    for name in ("relative_to_control_points", "on_the_earth"):
        assert newest[name] == done[f"amers:{name}"]
    both = me.get(f"/scenes/{scene}").json()["registrations"]
    assert [(one["outcome"], one["verdict"]) for one in both] == [
        ("registered", done["amers:verdict"]),
        ("failed", "failed"),
    ]


def test_a_block_is_ingested_by_a_job_of_an_administrator(
    client: TestClient,
    bearer: Bearer,
    settings: Settings,
    world: FlatWorld,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setenv("AMERS_INGEST_FOLDER", str(world.block.parent))
    execution, admin = "/processes/ingest-block/execution", bearer("admin")
    body = {"inputs": {"path": "block", "publish": True}}
    assert bearer("register").post(execution, json=body).status_code == 403
    first = admin.post(execution, json=body).headers["location"]
    again = admin.post(execution, json=body).headers["location"]
    bad = {"inputs": {"path": "../world0"}}
    outside = admin.post(execution, json=bad).headers["location"]
    with running_worker(settings, tmp_path / "log"):
        ended_jobs = [ended(client, job, admin) for job in (first, again, outside)]
    assert [job["status"] for job in ended_jobs] == ["successful", "failed", "failed"]
    assert [job.get("error", {}).get("error") for job in ended_jobs] == [None, "Conflict", "InputError"]
    results = admin.get(f"{first}/results").json()
    assert (results["id"], results["state"], results["points"]) == ("flat", "published", 40)


def test_block_folder_and_store_give_the_same_registration(
    world: FlatWorld, published: None, settings: Settings, storage: Storage, tmp_path: Path
):
    assert settings.database_url is not None
    files = SceneFiles(world.tagged, sigma_m=SIGMA_M)
    with engine.pooled(settings.database_url.get_secret_value(), settings) as database:
        of_store = ControlSources(points_of_store(database, storage))
        stored = run_registration(files, of_store, tmp_path / "a")
    of_block = ControlSources(points_of_block(world.block))
    folder = run_registration(files, of_block, tmp_path / "b")
    assert np.array_equal(stored.registration.measures.active, folder.registration.measures.active)
    difference_px = np.abs(
        stored.registration.adjustment.correction.parameters
        - folder.registration.adjustment.correction.parameters
    ).max()
    stored_as_real_px = 1e-3
    assert difference_px < stored_as_real_px
