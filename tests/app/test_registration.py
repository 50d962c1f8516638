"""From an image and a block to a refined model: by HTTP with a worker, and by the command line."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from fastapi.testclient import TestClient
from jsonschema import validate

from app.config import Settings
from app.db import engine
from app.storage import Storage
from app.usecases.blocks import ingest_block, publish_block
from app.usecases.ground_control import points_of_block, points_of_store
from app.usecases.registration import SceneFiles, run_registration
from app.usecases.registration_files import OUTPUTS
from services.formats.control_point_files import read_control_points
from services.formats.rpc_files import read_rpc
from services.registration import RegistrationOptions
from services.reports.document import report_schema
from services.sensors.base import SensorModel
from services.sensors.correction import CorrectedModel, no_correction
from services.sensors.refined import refined_rpc
from services.sensors.rpc import RpcModel
from tests.app.flat_world import CENTRE, GROUND_H, SIGMA_M, FlatWorld, make_flat_world
from tests.app.workers import ended, running_worker, wait_until

pytestmark = pytest.mark.long

A_TENTH_OF_A_PIXEL = 0.1
A_MILLIONTH_OF_A_PIXEL = 1e-6
MASKED_LINES = 400
COMMON_FILES = set(OUTPUTS)

Bearer = Callable[[str], dict[str, str]]
Amers = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    """A block and a scene whose model is wrong by a known shift."""
    return make_flat_world(tmp_path_factory.mktemp("world"))


@pytest.fixture
def published(world: FlatWorld, dsn: str, storage: Storage) -> None:
    """The points of the world, in the store and visible."""
    with engine.connect(dsn) as connection:
        block = ingest_block(connection, storage, world.block).block
        publish_block(connection, str(block.number))


@pytest.fixture
def amers(settings: Settings, tmp_path: Path) -> Amers:
    """Runs the command `amers` on the installation of the test."""
    assert settings.database_url is not None
    environment = os.environ | {
        "AMERS_DATABASE_URL": settings.database_url.get_secret_value(),
        "AMERS_DATA_FOLDER": str(settings.data_folder),
    }

    def run(*arguments: object) -> "subprocess.CompletedProcess[str]":
        return subprocess.run(
            [sys.executable, "-m", "app.cli.main", *map(str, arguments)],
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )

    return run


def largest_error_px(found: RpcModel, truth: SensorModel) -> float:
    """Largest distance in the image between two models, over the ground of the scene."""
    step = np.linspace(-0.003, 0.003, 5)
    lon, lat, h = np.meshgrid(
        step + CENTRE[0], step + CENTRE[1], GROUND_H + np.array([-50.0, 0.0, 50.0])
    )
    ground = np.column_stack([lon.ravel(), lat.ravel(), h.ravel()])
    return float(np.linalg.norm(found.project(ground) - truth.project(ground), axis=1).max())


def assert_registered(folder: Path, world: FlatWorld) -> None:
    """The folder holds a report that keeps its schema and a model that is right."""
    report = json.loads((folder / "report.json").read_text())
    validate(report, report_schema())
    assert report["blocks"] == [{"id": "flat", "version": "1"}]
    refined = read_rpc(world.image, folder / "refined_RPC.TXT").model
    assert largest_error_px(refined, world.true_model) < A_TENTH_OF_A_PIXEL
    assert_exchanged(folder, report["equipment"]["active"])
    points = json.loads((folder / "control_points.geojson").read_text())["features"]
    active = [point for point in points if point["properties"]["status"] == "active"]
    assert len(active) == report["equipment"]["active"]
    assert "<html" in (folder / "report.html").read_text()


def assert_exchanged(folder: Path, active: int) -> None:
    """Every format holds the active points where the document of the registration has them."""
    document = read_control_points(folder / "control_points.geojson")
    used = document.take(document.active)
    assert len(used) == active
    for name in ("gcp", "points", "pts"):
        points = read_control_points(folder / f"control_points.{name}", "ellipsoid")
        assert (
            np.abs(points.line_sample[points.active] - used.line_sample).max() < A_MILLIONTH_OF_A_PIXEL
        )
    opf = read_control_points(folder / "control_points_opf.json")
    assert np.abs(opf.line_sample - used.line_sample).max() < A_MILLIONTH_OF_A_PIXEL
    assert np.abs(opf.lon_lat_h - used.lon_lat_h).max() == 0.0


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
):
    me = bearer("register")
    upload = client.post(
        f"/scenes?name=scene.tif&sigma_m={SIGMA_M}", content=world.image.read_bytes(), headers=me
    )
    scene = upload.json()["id"]
    write_check_points(tmp_path / "checks.geojson", world)
    write_mask(tmp_path / "mask.tif")
    for path in (world.rpc_text, tmp_path / "checks.geojson", tmp_path / "mask.tif"):
        laid = client.put(f"/scenes/{scene}/files/{path.name}", content=path.read_bytes(), headers=me)
        assert laid.status_code == 200, laid.text
    assert client.put(f"/scenes/{scene}/files/a.exe", content=b"MZ", headers=me).status_code == 422
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
    assert client.post(execution, json=wrong, headers=me).status_code == 422
    body = {"inputs": inputs}
    asked = client.post("/processes/register-scene/execution", json=body, headers=me)
    with running_worker(settings, tmp_path / "log"):
        done = ended(client, asked.headers["location"], me)
    assert (done["status"], done["progress"]) == ("successful", 100), done
    results = client.get(f"/jobs/{done['jobID']}/results", headers=me).json()
    assert results.pop("verdict") in ("good", "usable")
    assert results.pop("method") == "control points"
    assert set(results) == COMMON_FILES | {"scene_RPC.TXT", "scene.tif"}
    folder = tmp_path / "downloaded"
    folder.mkdir()
    for name, link in results.items():
        reply = client.get(link["href"], headers=me)
        assert reply.headers["content-type"].startswith(link["type"])
        (folder / name).write_bytes(reply.content)
        assert client.get(link["href"], headers=bearer("register")).status_code == 404
    assert_registered(folder, world)
    page = client.get(results["report.html"]["href"], headers=me)
    assert "default-src 'none'" in page.headers["content-security-policy"]
    for name in ("..%2Freport.json", "nothing.json", "%2e%2e"):
        assert client.get(f"/jobs/{done['jobID']}/results/{name}", headers=me).status_code == 404
    assert client.get(f"/scenes/{scene}", headers=me).json()["footprint"]["type"] == "Polygon"
    assert largest_error_px(read_rpc(folder / "scene.tif").model, world.true_model) < A_TENTH_OF_A_PIXEL
    report = json.loads((folder / "report.json").read_text())
    assert report["checks"][0]["accuracy"]["n"] == 36
    points = json.loads((folder / "control_points.geojson").read_text())["features"]
    under_the_mask = [
        one["properties"]["reason"]
        for one in points
        if one["properties"]["predicted_line"] < MASKED_LINES
    ]
    assert set(under_the_mask) <= {"nodata", "not_tried"}
    assert "nodata" in under_the_mask
    with engine.connect(dsn) as connection:
        counts = connection.execute(
            "select count(*) as tried, count(*) filter (where active) as active from measure"
        ).fetchone()
        used = connection.execute("select block_versions, options from registration").fetchone()
    assert counts == {"tried": report["equipment"]["visible"], "active": report["equipment"]["active"]}
    assert used is not None
    assert used["block_versions"] == [{"id": "flat", "version": "1"}]
    assert used["options"]["max_points"] == 30


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
    assert client.post(execution, json=body, headers=bearer("register")).status_code == 403
    first = client.post(execution, json=body, headers=admin).headers["location"]
    again = client.post(execution, json=body, headers=admin).headers["location"]
    bad = {"inputs": {"path": "../world0"}}
    outside = client.post(execution, json=bad, headers=admin).headers["location"]
    with running_worker(settings, tmp_path / "log"):
        done = [ended(client, job, admin) for job in (first, again, outside)]
    assert [job["status"] for job in done] == ["successful", "failed", "failed"]
    assert [job.get("error", {}).get("error") for job in done] == [None, "Conflict", "InputError"]
    results = client.get(f"{first}/results", headers=admin).json()
    assert (results["id"], results["state"], results["points"]) == ("flat", "published", 40)


def test_block_folder_and_store_give_the_same_registration(
    world: FlatWorld, published: None, settings: Settings, storage: Storage, tmp_path: Path
):
    assert settings.database_url is not None
    files, options = SceneFiles(world.tagged, sigma_m=SIGMA_M), RegistrationOptions()
    with engine.pooled(settings.database_url.get_secret_value(), settings) as database:
        stored = run_registration(files, points_of_store(database, storage), options, tmp_path / "a")
    folder = run_registration(files, points_of_block(world.block), options, tmp_path / "b")
    assert np.array_equal(stored.registration.measures.active, folder.registration.measures.active)
    difference_px = np.abs(
        stored.registration.adjustment.correction.parameters
        - folder.registration.adjustment.correction.parameters
    ).max()
    stored_as_real_px = 1e-3
    assert difference_px < stored_as_real_px


def test_the_command_registers_straight_from_a_block_folder(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    folder = tmp_path / "out"
    done = amers(
        "scene",
        "register",
        world.tagged,
        "--block",
        world.block,
        "--sigma-m",
        SIGMA_M,
        "-o",
        folder,
        "--json",
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["verdict"] in ("good", "usable")
    assert np.allclose(told["shift_px"], [14.0, -9.0], atol=A_TENTH_OF_A_PIXEL)
    assert {path.name for path in folder.iterdir()} == COMMON_FILES | {"tagged_RPC.TXT"}
    assert_registered(folder, world)
    beside = read_rpc(world.tagged, folder / "tagged_RPC.TXT").model
    assert largest_error_px(beside, world.true_model) < A_TENTH_OF_A_PIXEL


def write_mask(path: Path) -> None:
    """A mask four times coarser than the scene that hides its first lines."""
    hidden = np.zeros((300, 300), np.uint8)
    hidden[: MASKED_LINES // 4 + 30] = 1
    with rasterio.open(path, "w", driver="GTiff", width=300, height=300, count=1, dtype="uint8") as file:
        file.write(hidden, 1)


def write_check_points(path: Path, world: FlatWorld, moved_px: float = 0.0) -> None:
    """Ground that the truth places in the scene, as GeoJSON; marks are moved along the lines."""
    step = np.linspace(-0.002, 0.002, 6)
    lon, lat = (axis.ravel() for axis in np.meshgrid(step + CENTRE[0], step + CENTRE[1]))
    ground = np.column_stack([lon, lat, np.full(36, GROUND_H)])
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": place.tolist()},
            "properties": {"line": line + moved_px, "sample": sample, "sigma_px": 0.2, "check": True},
        }
        for place, (line, sample) in zip(ground, world.true_model.project(ground), strict=True)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))


def test_points_held_out_are_told_in_the_report_and_can_take_a_good_verdict_away(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    def register(moved_px: float) -> dict:
        write_check_points(tmp_path / "checks.geojson", world, moved_px)
        command = ("scene", "register", world.tagged, "--block", world.block, "--sigma-m", SIGMA_M)
        done = amers(
            *command, "--check-points", tmp_path / "checks.geojson", "-o", tmp_path / "out", "--json"
        )
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["check_points"] == 36
        report: dict = json.loads((tmp_path / "out" / "report.json").read_text())
        validate(report, report_schema())
        return report

    report = register(moved_px=0.0)
    (check,) = report["checks"]
    half_a_pixel_m = 0.25
    assert check["accuracy"]["n"] == 36
    assert 0.0 < check["accuracy"]["ce90_m"]["value"] < half_a_pixel_m
    assert check["image_residuals_px"]["xy"]["rms"] < A_TENTH_OF_A_PIXEL
    (criterion,) = [one for one in report["criteria"] if one["name"] == "check_points"]
    assert criterion["passed"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "independent check points of checks.geojson" in page
    (criterion,) = [one for one in register(5.0)["criteria"] if one["name"] == "check_points"]
    assert not criterion["passed"]
    assert criterion["value"] > criterion["limit"]


def test_check_points_of_another_image_are_refused_by_name(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    write_check_points(tmp_path / "checks.geojson", world)
    document = json.loads((tmp_path / "checks.geojson").read_text())
    (tmp_path / "checks.geojson").write_text(json.dumps({**document, "image": "other.tif"}))
    done = amers(
        "scene",
        "register",
        world.tagged,
        "--block",
        world.block,
        "-o",
        tmp_path / "out",
        "--check-points",
        tmp_path / "checks.geojson",
    )
    assert done.returncode == 2
    assert "checks.geojson: expected marks in tagged.tif, found marks in other.tif" in done.stderr


def test_the_command_registers_with_the_store_and_remembers_the_measures(
    amers: Amers, world: FlatWorld, published: None, tmp_path: Path, dsn: str
):
    folder = tmp_path / "out"
    command = ("scene", "register", world.image, "--sigma-m", SIGMA_M, "-o", folder)
    done = amers(*command, "--model", world.rpc_text)
    assert done.returncode == 0, done.stderr
    assert "verdict" in done.stdout
    assert_registered(folder, world)
    with engine.connect(dsn) as connection:
        rows = connection.execute(
            "select count(*) as n from registration join measure on registration_id = registration.id"
        ).fetchone()
    assert rows == {"n": 40}


def test_the_command_says_by_its_exit_code_what_went_wrong(
    amers: Amers, world: FlatWorld, tmp_path: Path
):
    def register(*arguments: object) -> tuple[int, str]:
        done = amers("scene", "register", *arguments, "--block", world.block, "-o", tmp_path / "out")
        assert "Traceback" not in done.stderr
        return done.returncode, done.stderr

    half = tmp_path / "half.tif"
    half.write_bytes(world.tagged.read_bytes()[:100_000])
    assert register(half)[0] == 2
    assert register(tmp_path / "missing.tif")[0] == 2
    bare = tmp_path / "bare.tif"
    bare.write_bytes(world.image.read_bytes())
    code, told = register(bare)
    assert code == 2
    assert "no sensor model" in told
    # The points are 8 m from where a model that claims a tenth of a metre expects them.
    code, told = register(world.tagged, "--sigma-m", 0.1)
    assert code == 3
    assert "found" in told


def test_the_command_lets_a_service_register(
    amers: Amers,
    token: Callable[[str], str],
    world: FlatWorld,
    published: None,
    settings: Settings,
    tmp_path: Path,
):
    log, folder = tmp_path / "serve.log", tmp_path / "out"
    scene = ("scene", "register", world.image, "--sigma-m", SIGMA_M, "-o", folder)
    with running_service(settings, log) as url:
        refused = amers(*scene, "--server", url, "--token", "wrong")
        assert (refused.returncode, "token" in refused.stderr) == (2, True), refused.stderr
        done = amers(*scene, "--server", url, "--token", token("register"), "--json")
        assert done.returncode == 0, done.stderr + log.read_text()
        assert_registered(folder, world)
    gone = amers(*scene, "--server", url, "--token", "any")
    assert (gone.returncode, "Traceback" in gone.stderr) == (1, False)


@contextmanager
def running_service(settings: Settings, log: Path) -> Iterator[str]:
    """`amers serve` on the installation of a test; yields its address."""
    assert settings.database_url is not None
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = os.environ | {
        "AMERS_DATABASE_URL": settings.database_url.get_secret_value(),
        "AMERS_DATA_FOLDER": str(settings.data_folder),
    }
    command = [sys.executable, "-m", "app.cli.main", "serve", "--port", str(port)]
    with log.open("wb") as output:
        service = subprocess.Popen(command, env=environment, stdout=output, stderr=output)
    try:
        wait_until(lambda: "running on" in log.read_text(), "the service answers")
        yield f"http://127.0.0.1:{port}"
    finally:
        service.terminate()
        service.wait(30)


def test_an_upload_cut_off_by_its_sender_leaves_nothing(
    token: Callable[[str], str], settings: Settings, storage: Storage, tmp_path: Path, dsn: str
):
    with running_service(settings, tmp_path / "serve.log") as url:
        port = int(url.rsplit(":", 1)[1])
        head = (
            "POST /scenes?name=a.tif HTTP/1.1\r\nHost: localhost\r\nContent-Length: 10000000\r\n"
            f"Authorization: Bearer {token('register')}\r\n\r\n"
        )
        with socket.create_connection(("127.0.0.1", port)) as sender:
            sender.sendall(head.encode() + b"II*\0" + bytes(1_000_000))
            unfinished = storage.folder / "unfinished"
            wait_until(lambda: list(unfinished.glob("*")), "the upload has begun", 20.0)

        def forgotten() -> bool:
            with engine.connect(dsn) as connection:
                row = connection.execute("select count(*) as n from scene").fetchone()
            return row == {"n": 0}

        wait_until(forgotten, "the scene is forgotten", 20.0)
        assert [path for path in storage.folder.rglob("*") if path.is_file()] == []
