"""Administration of blocks over HTTP and with `amers block`."""

import json
import shutil
import zipfile
from pathlib import Path
from uuid import UUID

import pytest
from fastapi.testclient import TestClient
from numpy.testing import assert_allclose
from typer.testing import CliRunner

from amers.app.cli.main import app as commands
from amers.app.db import engine
from amers.app.errors import InputError
from amers.app.main import create_app
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.jobs import do_attempt
from tests.app.job_queue import claim
from tests.factories import BOX, make_block

pytestmark = pytest.mark.security


def ingested_by_job(client, settings, admin, body: dict) -> dict:
    """The outcome of an ingestion requested over HTTP and done by the code of the worker process."""
    reply = client.post("/blocks", json=body, headers=admin)
    assert reply.status_code == 201, reply.text
    job_id = UUID(reply.json()["jobID"])
    assert reply.headers["Location"].endswith(f"/jobs/{job_id}")
    ingesting = settings.model_copy(update={"ingest_folder": client.app.state.settings.ingest_folder})
    with engine.opened(ingesting) as database:
        with database.transaction() as connection:
            job = claim(connection, job_id, "a worker", 30.0)
        do_attempt(database, ingesting, job_id, job.attempt)
    return client.get(f"/jobs/{job_id}", headers=admin).json()


def archive_of(folder: Path, kind: str) -> bytes:
    return Path(shutil.make_archive(str(folder), kind, folder.parent, folder.name)).read_bytes()


@pytest.mark.parametrize("kind", ["zip", "tar"])
def test_a_block_is_uploaded_as_an_archive_and_ingested_by_a_job(
    client, settings, bearer, tmp_path, kind, admin
):
    made = make_block(tmp_path / "calanques_v1")
    path = f"/blocks/uploads/calanques.{kind}"
    assert bearer("register").put(path, content=b"x").status_code == 403
    reply = admin.put(path, content=archive_of(made.folder, kind))
    assert reply.status_code == 201, reply.text
    job = ingested_by_job(client, settings, admin, {**reply.json(), "publish": True, "priority": 2})
    assert job["status"] == "successful", job
    (feature,) = admin.get("/collections/blocks/items").json()["features"]
    assert feature["properties"]["state"] == "published"
    assert feature["properties"]["n_points"] == 40


def test_the_problems_of_a_refused_block_are_listed_with_their_reasons(
    client, settings, bearer, tmp_path
):
    made = make_block(tmp_path / "calanques_v1")
    with (made.folder / "chips/0000.npy").open("r+b") as chips:
        chips.seek(9_000)
        chips.write(b"\x01\x02")
    (made.folder / "stray.txt").write_text("not listed")
    admin = bearer("admin")
    upload = admin.put("/blocks/uploads/b.zip", content=archive_of(made.folder, "zip")).json()
    job = ingested_by_job(client, settings, admin, upload)
    assert job["status"] == "failed"
    problems = job["error"]["problems"]
    assert {problem["file"] for problem in problems} == {"chips/0000.npy", "stray.txt"}
    assert all(problem["found"] and problem["expected"] for problem in problems)
    assert admin.get("/collections/blocks/items").json()["features"] == []


def hostile_zip(path: Path, name: str) -> bytes:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("block/block.json", "{}")
        archive.writestr(name, "x")
    return path.read_bytes()


@pytest.mark.parametrize(
    ("name", "expected_message"),
    [("../../etc/x", "etc/x"), ("/etc/x", "etc/x"), ("elsewhere/x", "outside the folder")],
)
def test_an_archive_that_reaches_out_of_its_folder_is_refused(
    client, settings, admin, tmp_path, name, expected_message
):
    content = hostile_zip(tmp_path / "bad.zip", name)
    upload = admin.put("/blocks/uploads/bad.zip", content=content).json()
    job = ingested_by_job(client, settings, admin, upload)
    assert job["status"] == "failed"
    assert expected_message in job["message"]


@pytest.mark.parametrize("body", [{}, {"path": "a", "upload": str(UUID(int=1))}, {"folder": "a"}])
def test_an_ingestion_names_either_a_folder_or_an_upload(bearer, body):
    assert bearer("admin").post("/blocks", json=body).status_code == 422


def test_an_upload_that_is_not_there_is_not_ingested(bearer):
    reply = bearer("admin").post("/blocks", json={"upload": str(UUID(int=1))})
    assert reply.status_code == 404


def test_an_administrator_runs_the_whole_life_over_http(settings, bearer, tmp_path):
    folder = tmp_path / "incoming"
    folder.mkdir()
    made = make_block(folder / "calanques_v1")
    admin, reader = bearer("admin"), bearer("read")
    with TestClient(create_app(settings.model_copy(update={"ingest_folder": folder}))) as client:
        job = ingested_by_job(client, settings, admin, {"path": "calanques_v1"})
        assert job["status"] == "successful", job
        results = client.get(f"/jobs/{job['jobID']}/results", headers=admin).json()
        assert (results["state"], results["points"]) == ("staged", len(made.points))
        assert results["quality"]["share_reaching_quarter"] == 1.0
        location = f"/collections/blocks/items/{results['number']}"
        assert client.get(location, headers=admin).json()["properties"]["id"] == "calanques"
        assert client.get(location, headers=reader).status_code == 404
        assert client.get("/blocks/calanques/quality", headers=reader).status_code == 404
        assert client.post("/blocks/calanques/publish", headers=reader).status_code == 403

        again = ingested_by_job(client, settings, admin, {"path": "calanques_v1"})
        assert again["status"] == "failed"
        assert "already in the store" in again["message"]

        assert (
            client.post("/blocks/calanques/publish", headers=admin).json()["block"]["state"]
            == "published"
        )
        listed = client.get("/collections/blocks/items", headers=reader).json()
        assert [feature["properties"]["state"] for feature in listed["features"]] == ["published"]
        quality = client.get("/blocks/calanques/quality", headers=reader).json()
        assert quality["accuracy"] == [vars(figure) for figure in made.metadata.accuracy]
        assert quality["cells"][0][3] + sum(cell[3] for cell in quality["cells"][1:]) == 40
        extent = client.get("/collections/points", headers=reader).json()["extent"]["spatial"]["bbox"][0]
        assert_allclose(extent, BOX)

        assert client.post("/blocks/calanques/publish", headers=admin).status_code == 409
        assert (
            client.post("/blocks/calanques/withdraw", headers=admin).json()["block"]["state"]
            == "withdrawn"
        )
        assert client.get("/collections/blocks/items", headers=reader).json()["features"] == []
        assert (
            client.post("/blocks/calanques/restore", headers=admin).json()["block"]["state"]
            == "published"
        )
        raised = client.patch("/blocks/calanques", json={"priority": 3}, headers=admin)
        assert raised.json()["block"]["priority"] == 3
        assert client.post("/blocks/nothing/publish", headers=admin).status_code == 404


@pytest.mark.parametrize("path", ["../outside", "/etc", "", "a/../..", "link", "missing", "a\\b"])
def test_only_folders_below_the_allowed_one_are_ingested_by_request(tmp_path, path):
    allowed = tmp_path / "incoming"
    (allowed / "good").mkdir(parents=True)
    (tmp_path / "outside").mkdir()
    (allowed / "link").symlink_to(tmp_path / "outside")
    assert lifecycle.folder_to_ingest(allowed, "good") == allowed / "good"
    with pytest.raises(InputError, match="path"):
        lifecycle.folder_to_ingest(allowed, path)


def test_a_server_without_an_allowed_folder_names_the_missing_setting(client, settings, bearer):
    job = ingested_by_job(client, settings, bearer("admin"), {"path": "x"})
    assert job["status"] == "failed"
    assert "AMERS_INGEST_FOLDER" in job["message"]


@pytest.fixture
def run(settings, monkeypatch):
    """Runs a command on the test's database; returns its JSON output."""
    monkeypatch.setenv("AMERS_DATABASE_URL", settings.database_url.get_secret_value())
    monkeypatch.setenv("AMERS_DATA_FOLDER", str(settings.data_folder))

    def run(*arguments: str):
        result = CliRunner().invoke(commands, [*arguments, "--json"], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)

    return run


def test_the_whole_life_runs_from_the_command_line(run, tmp_path):
    made = make_block(tmp_path / "block")
    assert run("block", "ingest", str(made.folder))["block"]["state"] == "staged"
    assert run("block", "list")[0]["id"] == "calanques"
    assert run("block", "publish", "calanques")["state"] == "published"
    assert run("block", "show", "calanques@1")["points"] == 40
    assert run("block", "quality", "calanques")["points"] == 40
    newer = make_block(tmp_path / "newer", count=5, seed=2, version="2")
    assert run("block", "ingest", str(newer.folder), "--publish")["block"]["state"] == "published"
    assert {(row["version"], row["state"]) for row in run("block", "list")} == {
        ("1", "withdrawn"),
        ("2", "published"),
    }
    assert run("block", "show", "calanques")["version"] == "2"
    assert run("block", "quality", "calanques")["points"] == 5
    assert run("block", "withdraw", "calanques@2")["state"] == "withdrawn"


def test_commands_print_text_without_json(run, tmp_path):
    made = make_block(tmp_path / "block")
    runner = CliRunner()
    result = runner.invoke(commands, ["block", "ingest", str(made.folder)], catch_exceptions=False)
    assert result.exit_code == 0
    assert "staged" in result.stdout
    assert "points/km2" in result.stdout
    assert "100 %" in result.stderr
    for command in (["list"], ["show", "calanques"], ["quality", "calanques"], ["publish", "calanques"]):
        assert runner.invoke(commands, ["block", *command], catch_exceptions=False).exit_code == 0


def test_a_broken_block_is_refused_by_the_command_and_nothing_stays(run, tmp_path):
    made = make_block(tmp_path / "block")
    (Path(made.folder) / "views.parquet").unlink()
    result = CliRunner().invoke(commands, ["block", "ingest", str(made.folder)])
    assert result.exit_code != 0
    assert "views.parquet" in str(result.exception)
    assert run("block", "list") == []
