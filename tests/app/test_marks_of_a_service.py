"""Marks beside an image of a service: `register-scene` on them alone, and with points of the store."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.storage import Storage
from tests.app.callers import Bearer
from tests.app.flat_world import GROUND_H, SHIFT_PX, SIGMA_M, FlatWorld, make_flat_world, publish_world
from tests.app.registration_outputs import A_TENTH_OF_A_PIXEL
from tests.app.running_service import running_service
from tests.app.worker_processes import ended, running_worker
from tests.command_line import amers_here, environment_of
from tests.statements import run_sql

pytestmark = [pytest.mark.long, pytest.mark.thorough]

EXECUTION = "/processes/register-scene/execution"
STATED = {"control_sigma_m": [0.1, 0.1], "control_mark_sigma_px": 0.2}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="module")
def marks(world: FlatWorld) -> Path:
    """Four exact marks, whose file states neither heights nor sigmas."""
    picked = np.array([[200.0, 200.0], [200.0, 1000.0], [1000.0, 250.0], [900.0, 900.0]])
    ground = world.true_model.locate(picked, np.full(4, GROUND_H))
    rows = [
        ",".join(map(str, (f"GCP{k}", *place, *mark)))
        for k, (place, mark) in enumerate(zip(ground.tolist(), picked.tolist(), strict=True))
    ]
    path = world.block.parent / "marks.csv"
    path.write_text(
        "\n".join(["# pixel-origin=centre", "id,lon,lat,height_m,line,sample", *rows]) + "\n"
    )
    return path


def registered(
    client: TestClient,
    me: Bearer,
    settings: Settings,
    world: FlatWorld,
    marks: Path,
    log: Path,
    **inputs: object,
) -> dict:
    """The report of a job on the scene with its marks."""
    upload = me.post(f"/scenes?name=tagged.tif&sigma_m={SIGMA_M}", content=world.tagged.read_bytes())
    scene = upload.json()["id"]
    laid = me.put(f"/scenes/{scene}/files/{marks.name}", content=marks.read_bytes())
    assert laid.status_code == 200, laid.text
    alone = me.post(EXECUTION, json={"inputs": {"scene": scene, "method": "marks"}})
    assert alone.status_code == 422
    assert "method: of marks, whose file is missing" in alone.json()["detail"]
    values = {"scene": scene, "control": marks.name, "control_heights": "ellipsoid", **STATED, **inputs}
    response = me.execute("register-scene", values)
    with running_worker(settings, log):
        job = ended(client, response.headers["location"], me)
    assert job["status"] == "successful", job
    results = me.get(f"/jobs/{job['jobID']}/results").json()
    return me.get(results["report.json"]["href"]).json()


def test_a_job_registers_a_scene_on_marks_alone(
    client: TestClient,
    bearer: Bearer,
    settings: Settings,
    world: FlatWorld,
    marks: Path,
    dsn: str,
    tmp_path: Path,
) -> None:
    report = registered(
        client, bearer("register"), settings, world, marks, tmp_path / "log", method="marks"
    )
    assert [mark["status"] for mark in report["marks"]["marks"]] == ["used"] * 4
    (only,) = report["run"]["blocks"]
    assert (only["id"], only["version"]) == ("marks.csv", "marks")
    assert np.allclose(report["correction"]["shift_px"], SHIFT_PX, atol=A_TENTH_OF_A_PIXEL)
    with engine.connect(dsn) as connection:
        assert run_sql(connection, "select * from measure").fetchone() is None
        assert run_sql(connection, "select * from registration").fetchone() is not None


def test_points_of_the_store_and_marks_are_one_adjustment(
    client: TestClient,
    bearer: Bearer,
    settings: Settings,
    storage: Storage,
    world: FlatWorld,
    marks: Path,
    dsn: str,
    tmp_path: Path,
) -> None:
    publish_world(dsn, storage, world)
    report = registered(client, bearer("register"), settings, world, marks, tmp_path / "log")
    assert [mark["status"] for mark in report["marks"]["marks"]] == ["used"] * 4
    with engine.connect(dsn) as connection:
        row = run_sql(connection, "select count(*) as tried from measure").fetchone()
    assert row == {"tried": report["point_counts"]["visible"] - 4}


def test_the_command_sends_marks_to_a_service(
    settings: Settings,
    storage: Storage,
    world: FlatWorld,
    marks: Path,
    dsn: str,
    token: Callable[[str], str],
    tmp_path: Path,
) -> None:
    publish_world(dsn, storage, world)
    with running_service(settings, tmp_path / "log") as url:
        scene = ["scene", "register", world.tagged, "--sigma-m", SIGMA_M, "--control", marks]
        stated = ["--control-vertical", "ellipsoid", "--control-sigma-m", "0.1,0.1"]
        service = ["--server", url, "--token", token("register"), "-o", tmp_path / "out"]
        done = amers_here([*scene, *stated, *service], environment_of(settings))
    assert done.returncode == 0, done.stderr
    assert "GCP3" in done.stdout
