"""Disks that fill up during an upload or an ingestion: a clear error and no partial data."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psycopg
import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine, revisions
from amers.app.db.cluster.embedded import DATABASE, SUPERUSER, Cluster
from amers.app.errors import is_no_room
from amers.app.storage import Storage
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.garbage_collection import Bin, remove_unnamed_chips
from tests.app.callers import Bearer
from tests.app.conftest import stored_files
from tests.app.small_disk import Disk
from tests.app.worker_processes import ended, running_worker
from tests.factories import make_block
from tests.statements import run_sql

pytestmark = [pytest.mark.long, pytest.mark.thorough]

MEBIBYTE = 1 << 20
ROOM = 3 * MEBIBYTE
TOO_MUCH = b"II*\0" + np.random.default_rng(1).bytes(4 * MEBIBYTE)
TUS = {"Tus-Resumable": "1.0.0"}
LEASE_S = 0.5
DATABASE_ROOM = 300 * MEBIBYTE
"""Enough for a database, its log and a block, and little more."""


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    """A small disk for the data folder of a test."""
    disk = Disk(tmp_path / "disk", ROOM)
    yield disk
    disk.remove()


@pytest.fixture
def settings(dsn: str, disk: Disk, tmp_path: Path) -> Settings:
    """An installation with its files on the small disk and its database elsewhere."""
    return Settings(
        database_url=dsn,
        data_folder=disk.folder / "data",
        lease_seconds=LEASE_S,
        ingest_folder=tmp_path,
    )


def files(storage: Storage) -> list[str]:
    """All files in the storage, finished or not."""
    return [str(path.relative_to(storage.folder)) for path in stored_files(storage)]


def test_an_upload_that_fills_the_disk_is_507_and_leaves_nothing(
    client: TestClient, bearer: Bearer, storage: Storage, disk: Disk
):
    me = bearer("register")
    refused = client.post("/scenes?name=a.tif", content=TOO_MUCH, headers=me)
    assert refused.status_code == 507, refused.text
    assert "full" in refused.json()["detail"]
    assert refused.headers["content-type"] == "application/problem+json"
    assert files(storage) == []
    assert client.get("/scenes", headers=me).json()["scenes"] == []

    disk.grow(4 * ROOM)
    accepted = client.post("/scenes?name=a.tif", content=TOO_MUCH, headers=me)
    assert accepted.status_code == 201, accepted.text
    assert storage.path(f"scenes/{accepted.json()['id']}/a.tif").read_bytes() == TOO_MUCH


def test_an_upload_in_pieces_goes_on_where_the_disk_was_full(
    client: TestClient, bearer: Bearer, storage: Storage, disk: Disk
):
    me = bearer("register") | TUS
    metadata = {"Upload-Metadata": "filename YS50aWY=", "Upload-Length": str(len(TOO_MUCH))}
    upload = client.post("/uploads", headers=me | metadata).headers["location"]
    piece = me | {"Content-Type": "application/offset+octet-stream"}
    refused = client.patch(upload, content=TOO_MUCH, headers=piece | {"Upload-Offset": "0"})
    assert refused.status_code == 507, refused.text

    arrived = int(client.head(upload, headers=me).headers["upload-offset"])
    assert 0 < arrived <= ROOM
    disk.grow(4 * ROOM)
    rest = client.patch(
        upload, content=TOO_MUCH[arrived:], headers=piece | {"Upload-Offset": str(arrived)}
    )
    assert rest.status_code == 204, rest.text
    assert storage.path(f"scenes/{rest.headers['amers-scene']}/a.tif").read_bytes() == TOO_MUCH
    assert len(files(storage)) == 1


def test_an_ingestion_that_fills_the_disk_fails_with_the_reason_and_works_once_there_is_room(
    client: TestClient, bearer: Bearer, settings: Settings, disk: Disk, tmp_path: Path, dsn: str
):
    made = make_block(tmp_path / "block", count=100, n_images=4)
    admin = bearer("admin")
    storage = Storage(settings.data_folder / "storage")

    def ingested() -> dict[str, object]:
        reply = client.post("/blocks", json={"path": "block"}, headers=admin)
        return ended(client, reply.headers["location"], admin)

    with running_worker(settings, tmp_path / "log.txt") as worker:
        failed = ingested()
        assert failed["status"] == "failed", failed
        assert "disk" in str(failed["message"])
        assert "full" in str(failed["message"])
        with engine.connect(dsn) as connection:
            assert run_sql(connection, "select from block").fetchall() == []
            remove_unnamed_chips(connection, Bin(storage))
        assert files(storage) == []

        disk.grow(20 * ROOM)
        assert ingested()["status"] == "successful"
        assert worker.poll() is None
    with engine.connect(dsn) as connection:
        (block,) = run_sql(connection, "select n_points from block").fetchall()
        assert block["n_points"] == len(made.points)
        assert remove_unnamed_chips(connection, Bin(storage)) == []


def test_a_full_disk_of_the_database_is_reported_and_the_block_loads_once_there_is_room(
    open_folder: Path, tmp_path: Path
):
    made = make_block(tmp_path / "block", count=2_000, n_images=2, gsds_m=(2.0,), dtype=np.uint8)
    storage = Storage(tmp_path / "storage")
    disk = Disk(open_folder / "full", DATABASE_ROOM)
    cluster = Cluster(disk.folder / "postgres", durable=False)
    try:
        with cluster.lease() as dsn:
            revisions.upgrade(dsn)
            with engine.connect(cluster.dsn(DATABASE, SUPERUSER)) as connection:
                # With a new segment of the log, it is the table that has no room.
                run_sql(connection, "select pg_switch_wal()")
                run_sql(connection, "checkpoint")
            ballast = disk.folder / "ballast"
            free = shutil.disk_usage(disk.folder).free
            ballast.write_bytes(bytes(free - MEBIBYTE // 2))
            with (
                pytest.raises(psycopg.OperationalError) as refused,
                engine.connect(dsn) as connection,
            ):
                lifecycle.ingest_block(connection, storage, made.folder)
            assert is_no_room(refused.value), refused.value
            ballast.unlink()
            # The server stops when its log has no room; restart it as `amers serve` does.
            cluster.revive()
            with engine.connect(dsn) as connection:
                assert run_sql(connection, "select from block").fetchall() == []
                lifecycle.ingest_block(connection, storage, made.folder)
            with engine.connect(dsn) as connection:
                (block,) = run_sql(connection, "select n_points from block").fetchall()
                assert block["n_points"] == 2_000
    finally:
        disk.remove()
