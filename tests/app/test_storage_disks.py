"""Storages on real disks that are unmounted, read-only or full: reads go on, and deletions work."""

import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from amers.app import reserve
from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.cluster import embedded
from amers.app.db.cluster.embedded import DATABASE, SUPERUSER, Cluster
from amers.app.db.engine import Database
from amers.app.main import create_app
from amers.app.storage import Storage, trash
from amers.app.usecases.blocks.lifecycle import ingest_block
from amers.app.usecases.installation import Installation
from amers.app.usecases.tokens import create_token
from tests.app.callers import Bearer
from tests.app.full_storage import finish_job
from tests.app.small_disk import BindMount, Disk
from tests.factories import make_block
from tests.statements import run_sql
from tests.unproven import unproven_storage

pytestmark = [pytest.mark.long, pytest.mark.thorough]

MEBIBYTE = 1 << 20
TIFF = b"II*\0" + bytes(MEBIBYTE)
DATABASE_ROOM = 400 * MEBIBYTE
LONGEST_REVIVAL_S = 60.0


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    """A small disk for the data folder of a test."""
    disk = Disk(tmp_path / "disk", 8 * MEBIBYTE)
    yield disk
    disk.remove()


@pytest.fixture
def on_disk(dsn: str, disk: Disk) -> Settings:
    """An installation with its files on the small disk and its database elsewhere."""
    return Settings(database_url=dsn, data_folder=disk.folder / "data", trash_days=7)


def test_a_storage_that_is_really_unmounted_gets_nothing_and_has_everything_after_the_remount(
    settings: Settings, bearer: Bearer, tmp_path: Path
):
    me, folder = bearer("register"), settings.data_folder / "storage"
    folder.mkdir(parents=True)
    (tmp_path / "source").mkdir()
    bind = BindMount(folder, tmp_path / "source")
    bind.mount()
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        scenes = []
        for _ in range(2):
            reply = client.post("/scenes?name=a.tif", content=TIFF, headers=me)
            assert reply.status_code == 201, reply.text
            scenes.append(reply.json()["id"])
            bind.unmount()
            refused = client.post("/scenes?name=b.tif", content=TIFF, headers=me)
            assert refused.status_code == 503, refused.text
            assert "not mounted" in refused.json()["detail"]
            assert client.get("/readyz").status_code == 503
            assert list(folder.iterdir()) == []
            bind.mount()
        for scene in scenes:
            assert client.get(f"/scenes/{scene}/files/a.tif", headers=me).content == TIFF
    bind.unmount()


def test_a_storage_that_is_mounted_read_only_is_read_and_says_so(
    on_disk: Settings, disk: Disk, bearer: Bearer
):
    me = bearer("register")
    with TestClient(create_app(on_disk), raise_server_exceptions=False) as client:
        scene = client.post("/scenes?name=a.tif", content=TIFF, headers=me).json()["id"]
        disk.protect()
        for method, path in (("POST", "/scenes?name=b.tif"), ("PUT", f"/scenes/{scene}/files/a.txt")):
            refused = client.request(method, path, content=TIFF, headers=me)
            assert refused.status_code == 503, refused.text
            assert "read-only" in refused.json()["detail"]
            assert "Retry-After" in refused.headers
        assert client.get(f"/scenes/{scene}/files/a.tif", headers=me).content == TIFF
        ready = client.get("/readyz")
        assert (ready.status_code, ready.json()["status"]) == (200, "degraded")
        for part in ("storage", "disk"):
            assert "read-only" in ready.json()["parts"][part]["reason"]
        disk.unprotect()
        assert client.post("/scenes?name=b.tif", content=TIFF, headers=me).status_code == 201


def test_scenes_blocks_results_and_uploads_are_deleted_on_a_full_disk(
    on_disk: Settings, disk: Disk, bearer: Bearer, tmp_path: Path, dsn: str
):
    admin = bearer("admin")
    made = make_block(tmp_path / "block", count=5)
    tus = admin | {"Tus-Resumable": "1.0.0"}
    with TestClient(create_app(on_disk), raise_server_exceptions=False) as client:
        storage = unproven_storage(on_disk)
        with engine.connect(dsn) as connection:
            block = ingest_block(connection, storage, made.folder).block
            finish_job(connection, storage)
            (job,) = run_sql(connection, "select id from job").fetchall()
        scene = client.post("/scenes?name=a.tif", content=TIFF, headers=admin).json()["id"]
        announced = {"Upload-Length": "20", "Upload-Metadata": "filename YS50aWY="}
        upload = client.post("/uploads", headers=tus | announced).headers["location"]
        disk.fill()
        assert client.post("/scenes?name=b.tif", content=TIFF, headers=admin).status_code == 507
        assert "the disk of the data folder" in client.get("/readyz").json()["parts"]["disk"]["reason"]
        for path in (
            f"/scenes/{scene}",
            f"/jobs/{job['id']}",
            f"/blocks/{block.id}@{block.version}",
            upload,
        ):
            reply = client.delete(path, headers=tus)
            assert reply.status_code in (200, 204), reply.text
        assert [storage.keys(name) for name in ("scenes", "results", "chips")] == [[], [], []]
        assert storage.unfinished("upload-") == []
        assert len(storage.keys(trash.TRASH)) == 1, "renamed, not copied"
        assert trash.empty(storage) == 1


def test_the_reserve_is_given_up_for_a_deletion_and_made_again(
    database: Database, on_disk: Settings, disk: Disk
):
    storage = unproven_storage(on_disk)
    with TestClient(create_app(on_disk)):
        pass
    file = on_disk.data_folder / reserve.NAME
    assert file.stat().st_size == reserve.STORAGE_BYTES
    ballast = disk.fill()

    def delete() -> int:
        (disk.folder / "rows").write_bytes(bytes(1000))
        return 7

    assert reserve.deleting(on_disk, delete) == 7
    assert not file.exists()
    reserve.keep(on_disk)
    assert not file.exists(), "there is no room for it"
    ballast.unlink()
    reserve.keep(on_disk)
    assert file.stat().st_size == reserve.STORAGE_BYTES
    assert Installation(database, storage, on_disk).storage is storage


def test_a_private_database_on_a_full_disk_deletes_scenes_though_its_log_cannot_grow(
    open_folder: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(
        embedded, "_cluster", lambda settings: Cluster(settings.data_folder / "postgres", durable=False)
    )
    disk = Disk(open_folder / "private", DATABASE_ROOM)
    settings = Settings(data_folder=disk.folder / "data")
    try:
        with TestClient(create_app(settings), raise_server_exceptions=False) as client:
            cluster = Cluster(settings.data_folder / "postgres", durable=False)
            with engine.connect(cluster.dsn(DATABASE)) as connection:
                secret = create_token(connection, "a test", ["admin"]).secret
            client.headers["Authorization"] = f"Bearer {secret}"
            scenes = [
                client.post("/scenes?name=a.tif", content=TIFF).raise_for_status().json()["id"]
                for _ in range(2)
            ]
            file = settings.data_folder / reserve.NAME
            assert file.stat().st_size == reserve.DATABASE_BYTES
            ballast = disk.fill()
            with suppress(Exception), engine.connect(cluster.dsn(DATABASE, SUPERUSER)) as connection:
                # The next row needs a new segment of the log.
                run_sql(connection, "select pg_switch_wal()")
            for scene in scenes:
                _delete(client, f"/scenes/{scene}", settings)
            assert Storage(settings.data_folder / "storage").keys("scenes") == []
            assert not file.exists(), "the room was needed"
            ballast.unlink()
            client.get("/readyz")
            assert file.stat().st_size == reserve.DATABASE_BYTES
    finally:
        disk.remove()


def _delete(client: TestClient, path: str, settings: Settings) -> None:
    """Delete, and start the database again where it stopped, as `amers serve` does every 2 s."""
    deadline = time.monotonic() + LONGEST_REVIVAL_S
    while (reply := client.delete(path)).status_code != 204:
        assert reply.status_code in (503, 507), reply.text
        assert time.monotonic() < deadline, reply.text
        with suppress(embedded.ServerFailure):
            embedded.revive(settings)
        time.sleep(0.2)
