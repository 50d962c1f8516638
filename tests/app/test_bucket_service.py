"""A service with its files in a bucket: a registration from end to end, and an outage of the bucket."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.main import create_app
from amers.app.usecases.blocks.lifecycle import ingest_block, publish_block
from amers.services.formats.sensor_models.rpc_files import read_rpc
from tests.app.callers import Bearer
from tests.app.flat_world import SIGMA_M, FlatWorld, make_flat_world
from tests.app.registration_outputs import A_TENTH_OF_A_PIXEL, largest_error_px
from tests.app.s3_server import running_bucket
from tests.app.worker_processes import ended, running_worker
from tests.unproven import unproven_storage

pytestmark = pytest.mark.thorough

EXECUTE = "/processes/register-scene/execution"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"))


@pytest.fixture
def url(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    with running_bucket(monkeypatch) as url:
        # For the worker, which is a separate process.
        monkeypatch.setenv("AMERS_STORAGE_URL", url)
        yield url


@pytest.fixture
def settings(dsn: str, tmp_path: Path, url: str) -> Settings:
    return Settings(database_url=dsn, data_folder=tmp_path / "data", storage_url=url)


def test_a_scene_is_registered_with_all_files_in_a_bucket(
    client: TestClient, bearer: Bearer, settings: Settings, world: FlatWorld, dsn: str, tmp_path: Path
):
    storage, me = unproven_storage(settings), bearer("register")
    with engine.connect(dsn) as connection:
        block = ingest_block(connection, storage, world.block).block
        publish_block(connection, str(block.number))
    upload = client.post(
        f"/scenes?name=scene.tif&sigma_m={SIGMA_M}", content=world.image.read_bytes(), headers=me
    )
    scene = upload.json()["id"]
    client.put(f"/scenes/{scene}/files/scene_RPC.TXT", content=world.rpc_text.read_bytes(), headers=me)
    reply = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me)
    with running_worker(settings, tmp_path / "log"):
        ended_job = ended(client, reply.headers["location"], me)
    assert ended_job["status"] == "successful", ended_job
    results = client.get(f"{reply.headers['location']}/results", headers=me).json()
    refined = client.get(results["refined_RPC.TXT"]["href"], headers=me)
    assert refined.headers["content-length"] == str(len(refined.content))
    (tmp_path / "refined_RPC.TXT").write_bytes(refined.content)
    found = read_rpc(world.image, tmp_path / "refined_RPC.TXT").model
    assert largest_error_px(found, world.true_model) < A_TENTH_OF_A_PIXEL
    item = client.get(f"/collections/scenes/items/{scene}", headers=me).json()
    assert client.get(item["assets"]["image"]["href"], headers=me).content == world.image.read_bytes()
    assert not [path for path in settings.data_folder.rglob("*") if path.is_file()], "all in the bucket"
    assert len(storage.keys(f"results/{ended_job['jobID']}")) == len(
        [value for value in results.values() if isinstance(value, dict) and "href" in value]
    )
    assert client.delete(f"/scenes/{scene}", headers=me).status_code == 204
    assert storage.keys(f"scenes/{scene}") == []


def test_an_outage_of_the_bucket_is_reported_and_ends(
    dsn: str, bearer: Bearer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    image, me = b"II*\0" + bytes(1000), bearer("register")
    with running_bucket(monkeypatch) as url:
        settings = Settings(database_url=dsn, data_folder=tmp_path / "data", storage_url=url)
        with TestClient(create_app(settings), raise_server_exceptions=False) as client:
            scene = client.post("/scenes?name=a.tif", content=image, headers=me).json()["id"]
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{nobody.getsockname()[1]}")
        with TestClient(create_app(settings), raise_server_exceptions=False) as client:
            for reply in (
                client.post("/scenes?name=b.tif", content=image, headers=me),
                client.get(f"/scenes/{scene}/files/a.tif", headers=me),
                client.put(f"/scenes/{scene}/files/a_RPC.TXT", content=b"LINE_OFF: 1", headers=me),
            ):
                assert reply.status_code == 503, reply.text
                assert reply.headers["content-type"] == "application/problem+json"
                assert reply.headers["retry-after"]
                assert "storage" in reply.json()["detail"]
                assert "127.0.0.1" not in reply.text, "nothing of the inside is told"
            listed = client.get("/scenes", headers=me).json()["scenes"]
            assert [(one["id"], one["models"]) for one in listed] == [(scene, [])], "nothing half done"
