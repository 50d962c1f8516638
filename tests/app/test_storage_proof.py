"""A write goes only into a storage that carries the marker of this installation; else it is a 503."""

import errno
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from amers.app import reserve
from amers.app.cli.failures import failure
from amers.app.cli.main import app as amers
from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.engine import Database
from amers.app.db.jobs import jobs
from amers.app.errors import StorageOutage
from amers.app.main import create_app
from amers.app.storage import MARKER, Marker, Storage, open_storage, proof, write_marker
from amers.app.usecases import storage_identity
from amers.app.usecases.jobs import do_attempt
from amers.app.worker.attempt import Attempts
from amers.app.worker.run import main as run_attempt
from tests.app.callers import Bearer
from tests.app.full_storage import finish_job
from tests.app.s3_server import running_bucket
from tests.factories import make_block
from tests.statements import run_sql
from tests.unproven import unproven_storage

TIFF = b"II*\0" + bytes(1000)
TUS = {"Tus-Resumable": "1.0.0"}
PIECE = TUS | {"Content-Type": "application/offset+octet-stream"}
ANNOUNCED = TUS | {"Upload-Length": str(len(TIFF)), "Upload-Metadata": "filename YS50aWY="}


class Mount:
    """The folder of a storage, which can go away as an unmount lets it: an empty one stays."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._away = folder.with_name("away")

    def unmount(self) -> None:
        self.folder.rename(self._away)
        self.folder.mkdir()

    def mount(self) -> None:
        assert list(self.folder.iterdir()) == [], "nothing was written into the mount point"
        self.folder.rmdir()
        self._away.rename(self.folder)


@pytest.fixture
def mount(settings: Settings) -> Mount:
    return Mount(settings.data_folder / "storage")


def assert_refused(reply: Any, reason: str = "not mounted") -> None:
    """A 503 that says why, and when to try again."""
    assert reply.status_code == 503, reply.text
    assert "Retry-After" in reply.headers
    assert reason in reply.json()["detail"]
    assert "/" not in reply.json()["detail"], "no folder of the machine"


def test_while_the_storage_is_not_mounted_every_write_is_a_503_and_nothing_is_lost(
    client: TestClient, bearer: Bearer, storage: Storage, mount: Mount, dsn: str
):
    me, admin = bearer("register"), bearer("admin")
    with engine.connect(dsn) as connection:
        finish_job(connection, storage)
        (job,) = run_sql(connection, "select id from job").fetchall()
    scene = me.scene(TIFF, "name=a.tif")
    upload = client.post("/uploads", headers=me | ANNOUNCED).headers["location"]
    first = client.patch(upload, content=TIFF[:400], headers=me | PIECE | {"Upload-Offset": "0"})
    assert first.status_code == 204, first.text
    before = me.get("/scenes").json()

    mount.unmount()
    for method, path, headers, content in (
        ("POST", "/scenes?name=b.tif", me, TIFF),
        ("PUT", f"/scenes/{scene}/files/a_RPC.TXT", me, b"LINE_OFF: 1"),
        ("PUT", "/blocks/uploads/a.zip", admin, b"PK\3\4" * 10),
        ("POST", "/uploads", me | ANNOUNCED, b""),
        ("PATCH", upload, me | PIECE | {"Upload-Offset": "400"}, TIFF[400:]),
        ("DELETE", upload, me | TUS, b""),
        ("DELETE", f"/scenes/{scene}", me, b""),
        ("DELETE", f"/jobs/{job['id']}", admin, b""),
        ("GET", f"/scenes/{scene}/files/a.tif", me, b""),
    ):
        assert_refused(client.request(method, path, headers=headers, content=content))
    assert client.head(upload, headers=me | TUS).status_code == 503
    assert me.get("/scenes").json() == before
    assert client.get("/readyz").json()["parts"]["storage"]["status"] == "failed"
    with engine.connect(dsn) as connection:
        assert run_sql(connection, "select count(*) as n from upload").fetchone() == {"n": 1}

    mount.mount()
    assert me.get(f"/scenes/{scene}/files/a.tif").content == TIFF
    rest = client.patch(upload, content=TIFF[400:], headers=me | PIECE | {"Upload-Offset": "400"})
    assert rest.status_code == 204, rest.text
    name = rest.headers["amers-scene"]
    assert me.get(f"/scenes/{name}/files/a.tif").content == TIFF
    assert me.post("/scenes?name=b.tif", content=TIFF).status_code == 201
    assert me.delete(f"/scenes/{scene}").status_code == 204
    assert admin.delete(f"/jobs/{job['id']}").status_code == 200
    assert storage.keys("results") == []


def test_a_storage_that_goes_away_while_bytes_arrive_acknowledges_none_of_them(
    client: TestClient, bearer: Bearer, mount: Mount
):
    def chunks() -> Iterator[bytes]:
        yield TIFF
        mount.unmount()
        yield TIFF

    me = bearer("register")
    assert_refused(me.post("/scenes?name=a.tif", content=chunks()))
    mount.mount()
    assert me.get("/scenes").json()["scenes"] == []


def test_a_storage_of_another_installation_in_its_place_gets_no_file(
    client: TestClient, bearer: Bearer, storage: Storage, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(proof, "VALID_S", 0.0)
    me = bearer("register")
    assert me.post("/scenes?name=a.tif", content=TIFF).status_code == 201
    before = storage.keys("scenes")
    write_marker(storage, Marker(uuid4(), 1))
    assert_refused(me.post("/scenes?name=b.tif", content=TIFF), "another installation")
    assert storage.keys("scenes") == before


@pytest.fixture
def bucket(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> Iterator[Settings]:
    with running_bucket(monkeypatch) as url:
        yield settings.model_copy(update={"storage_url": url})


@pytest.mark.parametrize("marker", [None, Marker(uuid4(), 1)])
def test_an_emptied_bucket_or_another_one_gets_no_file(
    bucket: Settings, bearer: Bearer, monkeypatch: pytest.MonkeyPatch, marker: Marker | None
):
    monkeypatch.setattr(proof, "VALID_S", 0.0)
    me, unproven = bearer("register"), unproven_storage(bucket)
    with TestClient(create_app(bucket), raise_server_exceptions=False) as client:
        scene = client.post("/scenes?name=a.tif", content=TIFF, headers=me).json()["id"]
        ours = unproven.open(MARKER).read()
        if marker is None:
            unproven.delete(MARKER)
        else:
            write_marker(unproven, marker)
        assert_refused(
            client.post("/scenes?name=b.tif", content=TIFF, headers=me),
            "not mounted" if marker is None else "another installation",
        )
        assert_refused(client.delete(f"/scenes/{scene}", headers=me), "storage of files")
        assert len(unproven.keys("scenes")) == 1
        unproven.put(MARKER, [ours])
        assert client.post("/scenes?name=b.tif", content=TIFF, headers=me).status_code == 201


def test_commands_write_nothing_into_a_storage_that_is_not_mounted_and_say_so(
    client: TestClient,
    bearer: Bearer,
    settings: Settings,
    mount: Mount,
    tmp_path: Path,
    dsn: str,
    monkeypatch: pytest.MonkeyPatch,
):
    made = make_block(tmp_path / "block", count=5)
    monkeypatch.setenv("AMERS_DATABASE_URL", dsn)
    monkeypatch.setenv("AMERS_DATA_FOLDER", str(settings.data_folder))
    scene = bearer("register").scene(TIFF, "name=a.tif")
    mount.unmount()
    for words in (
        ["block", "ingest", str(made.folder)],
        ["db", "backup", str(tmp_path / "backup")],
        ["store", "usage"],
        ["store", "sweep"],
        ["store", "verify"],
        ["store", "trash", "empty"],
        ["store", "trash", "restore", "2026-11-22_310h"],
    ):
        result = CliRunner().invoke(amers, words)
        assert isinstance(result.exception, Exception), words
        sentence, status = failure(result.exception)
        assert status != 0
        assert "mounted" in sentence, (words, sentence)
        assert "should not happen" not in sentence
    assert not (tmp_path / "backup").exists()
    mount.mount()
    assert (mount.folder / "scenes" / scene / "a.tif").read_bytes() == TIFF
    result = CliRunner().invoke(amers, ["block", "ingest", str(made.folder)])
    assert result.exception is None, result.output


def test_a_storage_whose_folder_is_missing_is_made_by_nobody(
    client: TestClient, bearer: Bearer, settings: Settings, mount: Mount
):
    mount.unmount()
    mount.folder.rmdir()
    assert_refused(bearer("register").post("/scenes?name=a.tif", content=TIFF))
    with engine.opened(settings) as database:
        storage = open_storage(settings)
        assert not storage_identity.announce(database.transaction, storage)
        with pytest.raises(StorageOutage, match="mount"):
            storage_identity.adopt(database.transaction, storage)
    with TestClient(create_app(settings)) as again:
        assert again.get("/readyz").status_code == 503
    assert not mount.folder.exists()


def running_job(database: Database) -> UUID:
    with database.transaction() as connection:
        job = jobs.create(connection, kind="export-block", inputs={"bbox": [5.0, 43.0, 5.1, 43.1]})
        assert job is not None
        run_sql(connection, "update job set state = 'running', attempt = 1")
    return job.id


def test_an_attempt_without_a_storage_is_repeated_and_does_not_count(
    client: TestClient, database: Database, settings: Settings, mount: Mount
):
    settings = settings.model_copy(update={"lease_seconds": 1.0})
    job_id = running_job(database)
    mount.unmount()
    with pytest.raises(StorageOutage, match="not mounted"):
        do_attempt(database, settings, job_id, 1)
    with database.transaction() as connection:
        job = jobs.find(connection, job_id)
        run_sql(connection, "update job set state = 'accepted'")
    assert job is not None
    assert job.state == "running", "the outcome is left to the worker"

    worker = Attempts(database, None, settings, "w", lambda: False)  # type: ignore[arg-type]
    worker.do_next_job()
    with database.transaction() as connection:
        job = jobs.find(connection, job_id)
        assert job is not None
        assert (job.state, job.attempt) == ("accepted", 1), "nobody claims it"
        run_sql(connection, "update job set state = 'running'")
    for _ in range(5):
        worker._settle(job, 79)
        with database.transaction() as connection:
            job = jobs.find(connection, job_id)
            assert job is not None
            assert (job.state, job.failures) == ("accepted", 0)
            run_sql(connection, "update job set state = 'running'")
    mount.mount()


def test_a_process_of_a_job_tells_its_worker_that_the_storage_is_away(
    client: TestClient,
    database: Database,
    settings: Settings,
    mount: Mount,
    dsn: str,
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setenv("AMERS_DATABASE_URL", dsn)
    monkeypatch.setenv("AMERS_DATA_FOLDER", str(settings.data_folder))
    monkeypatch.setattr("amers.app.worker.run.limit_memory", lambda limit: None)
    monkeypatch.setattr("amers.app.worker.run.limit_files", lambda limit: None)
    job_id = running_job(database)
    mount.unmount()
    assert run_attempt([str(job_id), "1", str(os.getpid()), str(1 << 33)]) == 79
    mount.mount()


@pytest.mark.parametrize(
    ("number", "status", "reason"),
    [
        (errno.EROFS, 503, "read-only"),
        (errno.ENOSPC, 507, "full"),
        (errno.EDQUOT, 507, "full"),
        (errno.EACCES, 503, "rights"),
        (errno.EPERM, 503, "may not"),
        (errno.EIO, 503, "input and output"),
        (errno.ESTALE, 503, "stale"),
        (errno.ENOTCONN, 503, "gone"),
    ],
)
def test_a_storage_that_takes_no_files_says_why_and_is_read_all_the_same(
    client: TestClient,
    bearer: Bearer,
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    status: int,
    reason: str,
):
    def fail(*arguments: object, **named: object) -> None:
        raise OSError(number, os.strerror(number), "a file")

    me = bearer("register")
    scene = me.scene(TIFF, "name=a.tif")
    upload = client.post("/uploads", headers=me | ANNOUNCED).headers["location"]
    with monkeypatch.context() as patch:
        patch.setattr("amers.app.storage.folder.mkstemp", fail)
        patch.setattr("amers.app.usecases.uploads._append", fail)
        refused = me.post("/scenes?name=b.tif", content=TIFF)
        piece = client.patch(upload, content=TIFF, headers=me | PIECE | {"Upload-Offset": "0"})
        for reply in (refused, piece):
            assert reply.status_code == status, reply.text
            assert reason in reply.json()["detail"]
            assert "Retry-After" in reply.headers
        assert me.get(f"/scenes/{scene}/files/a.tif").content == TIFF
        assert len(me.get("/scenes").json()["scenes"]) == 2, "and the open upload"
        ready = client.get("/readyz")
        assert (ready.status_code, ready.json()["status"]) == (200, "degraded")
        assert reason in ready.json()["parts"]["storage"]["reason"]
    assert me.post("/scenes?name=b.tif", content=TIFF).status_code == 201


def test_reading_looks_at_no_marker_and_a_write_reads_it_once_a_second(
    settings: Settings, database: Database, monkeypatch: pytest.MonkeyPatch
):
    storage = storage_identity.opened(database, settings)
    looks: list[float] = []
    closely = Storage.look_closely

    def counted(self: Storage) -> Any:
        looks.append(time.monotonic())
        return closely(self)

    storage.put("scenes/a", [b"a"])
    monkeypatch.setattr(Storage, "look_closely", counted)
    monkeypatch.setattr(proof, "VALID_S", 1000.0)
    for _ in range(20):
        storage.put("scenes/a", [b"a"])
        storage.open("scenes/a").close()
    assert looks == []
    monkeypatch.setattr(proof, "VALID_S", 0.0)
    storage.open("scenes/a").close()
    assert looks == []
    storage.put("scenes/a", [b"a"])
    assert looks != []


def test_a_service_on_a_read_only_database_starts_and_reads(
    client: TestClient, bearer: Bearer, settings: Settings, database: Database
):
    me = bearer("register")
    scene = me.scene(TIFF, "name=a.tif")
    name = str(settings.database_url.get_secret_value()).split("dbname=")[1].split()[0]  # type: ignore[union-attr]
    with database.transaction() as connection:
        run_sql(connection, f'alter database "{name}" set default_transaction_read_only = on')
    with TestClient(create_app(settings), raise_server_exceptions=False) as again:
        reply = again.get(f"/scenes/{scene}/files/a.tif", headers=me)
        assert (reply.status_code, reply.content) == (200, TIFF)
        assert again.post("/scenes?name=b.tif", content=TIFF, headers=me).status_code == 503


class _Remounted:
    """A storage that is not mounted any more while somebody reads its marker."""

    place = "somewhere"

    def __init__(self, installation: UUID) -> None:
        self.here: str = "the storage"
        self.reading, self.go_on = threading.Event(), threading.Event()
        self._marker = Marker(installation, 1)

    def look(self) -> str:
        return self.here

    def look_closely(self) -> tuple[str, Marker | None]:
        here = self.here
        self.reading.set()
        assert self.go_on.wait(10.0)
        return here, self._marker if here == "the storage" else None


def test_who_waits_for_the_proof_of_another_place_takes_none() -> None:
    installation = uuid4()
    storage, known = _Remounted(installation), proof.Proof()
    known.bind(installation)
    first = threading.Thread(target=known.require, args=(storage,))
    first.start()
    assert storage.reading.wait(10.0)
    storage.here = "the mount point"
    outcome: list[Exception | object] = []

    def require() -> None:
        try:
            outcome.append(known.require(storage))
        except StorageOutage as outage:
            outcome.append(outage)

    second = threading.Thread(target=require)
    second.start()
    time.sleep(0.2)  # It has looked, and waits for the first.
    storage.go_on.set()
    first.join()
    second.join()
    assert isinstance(outcome[0], StorageOutage), outcome


def test_nothing_is_written_before_the_installation_is_known(settings: Settings) -> None:
    storage = open_storage(settings)
    storage.folder.mkdir(parents=True)
    with pytest.raises(StorageOutage, match="not known yet"):
        storage.put("scenes/a", [TIFF])
    assert list(storage.folder.iterdir()) == []


def test_a_storage_that_was_away_at_the_start_is_prepared_when_it_is_back(
    client: TestClient, bearer: Bearer, mount: Mount, settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    me = bearer("register")
    monkeypatch.setattr(storage_identity, "RETRY_S", 0.1)
    reserve_file = settings.data_folder / reserve.NAME
    reserve.give_up(settings)
    mount.unmount()
    with TestClient(create_app(settings), raise_server_exceptions=False) as late:
        assert_refused(late.post("/scenes?name=a.tif", content=TIFF, headers=me))
        mount.mount()
        deadline = time.monotonic() + 20.0
        while not reserve_file.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        assert reserve_file.exists()
        assert late.post("/scenes?name=a.tif", content=TIFF, headers=me).status_code == 201


def test_a_job_under_way_leaves_the_mount_point_empty(client: TestClient, mount: Mount) -> None:
    storage: Storage = client.app.state.storage  # type: ignore[attr-defined]

    def work() -> None:
        with storage.scratch_folder("job-") as folder:
            mount.unmount()
            (folder / "result" / "attempt").mkdir(parents=True)

    with pytest.raises(StorageOutage):
        work()
    mount.mount()  # It checks that nothing was written into the mount point.


def test_a_job_under_way_takes_nothing_from_a_storage_of_another_installation(
    client: TestClient, mount: Mount
) -> None:
    storage: Storage = client.app.state.storage  # type: ignore[attr-defined]
    other = Storage(mount.folder)

    def work() -> None:
        with storage.scratch_folder("job-"):
            mount.unmount()
            write_marker(other, Marker(uuid4(), 1))
            other.scratch()

    with pytest.raises(StorageOutage):
        work()
    assert (mount.folder / "unfinished").is_dir()
