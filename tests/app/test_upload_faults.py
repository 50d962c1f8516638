"""Failures between the moment a whole upload is stored and the commit that records it."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.main import create_app
from amers.app.storage import Storage
from tests.app.callers import Bearer, Caller
from tests.app.s3_server import running_bucket
from tests.app.sending import PIECE, TUS, said, zipped
from tests.app.worker_processes import wait_until
from tests.command_line import environment_of
from tests.service_process import free_port
from tests.statements import run_sql
from tests.unproven import unproven_storage

pytestmark = pytest.mark.thorough

TIFF = b"II*\0" + bytes(range(256)) * 40
MODEL = b"LINE_OFF: 1"
PURPOSES = ("image", "archive", "model", "block")
CUT = "perform pg_terminate_backend(pg_backend_pid())"
"""The connection breaks while the database commits: everything is rolled back."""
WAIT = "perform pg_sleep(120)"
COMPLETIONS = {
    "upload": "new.finished_at is not null",
    "scene": "new.state = 'uploaded' and new.models <> '{}'::jsonb or new.state <> old.state",
}
"""Which updates record a stored file."""


@pytest.fixture(params=["folder", "bucket"])
def settings(
    request: pytest.FixtureRequest, dsn: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Settings]:
    """An installation with its files in a folder, and one with them in a bucket."""
    if request.param == "folder":
        yield Settings(database_url=dsn, data_folder=tmp_path / "data")
        return
    with running_bucket(monkeypatch) as url:
        yield Settings(database_url=dsn, data_folder=tmp_path / "data", storage_url=url)


@pytest.fixture
def storage(settings: Settings) -> Storage:
    return unproven_storage(settings)


@contextmanager
def at_commit(dsn: str, table: str, statement: str) -> Iterator[None]:
    """Every transaction that records a stored file in a table executes a statement while it commits."""
    with engine.connect(dsn) as connection:
        run_sql(
            connection,
            "create function fault() returns trigger language plpgsql as"
            f" $$ begin {statement}; return null; end $$",
        )
        run_sql(
            connection,
            f"create constraint trigger fault after update on {table} deferrable initially deferred"
            f" for each row when ({COMPLETIONS[table]}) execute function fault()",
        )
    try:
        yield
    finally:
        with engine.connect(dsn) as connection:
            run_sql(
                connection,
                "select pg_terminate_backend(pid) from pg_stat_activity where state = 'active'"
                " and datname = current_database() and pid <> pg_backend_pid()",
            )
            run_sql(connection, "drop function fault cascade")


def content_of(purpose: str) -> bytes:
    return {
        "image": TIFF,
        "archive": zipped({"IMG.TIF": TIFF, "IMG_RPC.TXT": MODEL}),
        "model": MODEL,
        "block": b"PK\3\4" * 20,
    }[purpose]


def announce(http: httpx.Client, me: dict[str, str], purpose: str) -> str:
    """The address of a new upload, without any piece."""
    values = {"filename": {"image": "IMG.TIF", "model": "IMG_RPC.TXT"}.get(purpose, "a.zip")}
    if purpose == "block":
        values["purpose"] = "block"
    if purpose == "model":
        scene = http.post("/scenes?name=IMG.TIF", content=TIFF, headers=me).json()["id"]
        http.put(f"/scenes/{scene}/files/IMG_RPC.TXT", content=b"former", headers=me).raise_for_status()
        values["scene"] = scene
    length = {"Upload-Length": str(len(content_of(purpose)))}
    reply = http.post("/uploads", headers=me | TUS | length | said(**values))
    assert reply.status_code == 201, reply.text
    return reply.headers["location"]


def send(http: httpx.Client, me: dict[str, str], url: str, start: int, data: bytes) -> httpx.Response:
    return http.patch(url, content=data, headers=me | TUS | PIECE | {"Upload-Offset": str(start)})


def check_settled(http: httpx.Client, me: dict[str, str], url: str, purpose: str, storage: Storage):
    """HEAD reports the whole file, an empty piece at its end completes it, and all of it is stored."""
    size = len(content_of(purpose))
    head = http.head(url, headers=me | TUS)
    assert (head.status_code, head.headers.get("upload-offset")) == (200, str(size))
    for _ in range(2):
        settled = send(http, me, url, size, b"")
        assert settled.status_code == 204, settled.text
    document = http.get(url, headers=me).json()
    assert (document["state"], document["offset"]) == ("finished", size)
    assert list(storage.scratch().iterdir()) == [], "nothing is left in the scratch folder"
    if purpose == "block":
        (key,) = storage.keys("uploads")
        assert storage.open(key).read() == content_of("block")
        return
    scene = http.get(f"/scenes/{document['scene']}", headers=me).json()
    assert scene["state"] == "uploaded"
    files = {scene["file"]: TIFF} | {name: MODEL for name in scene["models"]}
    assert len(files) == (1 if purpose == "image" else 2)
    for name, content in files.items():
        assert http.get(f"/scenes/{scene['id']}/files/{name}", headers=me).content == content
    assert len(storage.keys(f"scenes/{scene['id']}")) == len(files)


@pytest.mark.parametrize("purpose", PURPOSES)
def test_an_upload_stored_when_the_database_fails_is_completed_by_its_sender(
    client: TestClient, bearer: Bearer, storage: Storage, dsn: str, purpose: str
):
    me = bearer("admin")
    url = announce(client, me, purpose)
    with at_commit(dsn, "upload", CUT):
        failed = send(client, me, url, 0, content_of(purpose))
        assert failed.status_code == 503, failed.text
        again = send(client, me, url, len(content_of(purpose)), b"")
        assert again.status_code == 503, again.text
    check_settled(client, me, url, purpose, storage)


@pytest.mark.long
@pytest.mark.parametrize("settings", ["folder"], indirect=True)
@pytest.mark.parametrize("purpose", PURPOSES)
def test_an_upload_stored_when_the_api_is_killed_is_completed_by_its_sender(
    settings: Settings, bearer: Bearer, storage: Storage, dsn: str, purpose: str, tmp_path: Path
):
    me = bearer("admin")
    with (
        at_commit(dsn, "upload", WAIT),
        killed_service(settings, tmp_path / "log") as base,
        httpx.Client(base_url=base) as http,
    ):
        url = announce(http, me, purpose)
        before = storage.keys("uploads") + storage.keys("scenes")
        with pytest.raises(httpx.TimeoutException):
            http.patch(
                url,
                content=content_of(purpose),
                headers=me | TUS | PIECE | {"Upload-Offset": "0"},
                timeout=2.0,
            )
        stored = storage.keys("uploads") + storage.keys("scenes")
        assert stored != before or purpose == "model"
    with TestClient(create_app(settings)) as client:
        check_settled(client, me, url.replace(base, "http://testserver"), purpose, storage)


@contextmanager
def killed_service(settings: Settings, log: Path) -> Iterator[str]:
    """The address of `amers serve`, whose processes are all killed at the end."""
    port = free_port()
    environment = environment_of(settings)
    command = [sys.executable, "-m", "amers", "serve", "--no-worker", "--port", str(port)]
    with log.open("wb") as output:
        service = subprocess.Popen(
            command, env=environment, stdout=output, stderr=output, start_new_session=True
        )
    try:
        wait_until(lambda: "running on" in log.read_text(), "the service answers")
        yield f"http://127.0.0.1:{port}"
    finally:
        os.killpg(service.pid, signal.SIGKILL)
        service.wait(30)


def test_a_scene_whose_commit_fails_leaves_nothing_and_can_be_sent_again(
    me: Caller, storage: Storage, dsn: str
):
    with at_commit(dsn, "scene", CUT):
        reply = me.post("/scenes?name=a.tif", content=TIFF)
        assert reply.status_code == 503, reply.text
    assert me.get("/scenes").json()["scenes"] == []
    assert storage.keys("scenes") == []
    assert me.post("/scenes?name=a.tif", content=TIFF).status_code == 201


def test_a_scene_keeps_its_image_when_the_confirmation_of_its_commit_is_lost(
    client: TestClient, me: Caller, storage: Storage, monkeypatch: pytest.MonkeyPatch
):
    from amers.app.db import scenes

    database = client.app.state.database  # type: ignore[attr-defined]
    finish = scenes.finish_upload

    def committed_and_lost(connection, *arguments):
        with database.transaction() as other:
            finish(other, *arguments)
        run_sql(connection, "select pg_terminate_backend(pg_backend_pid())")

    monkeypatch.setattr(scenes, "finish_upload", committed_and_lost)
    assert me.post("/scenes?name=a.tif", content=TIFF).status_code == 503
    (scene,) = me.get("/scenes").json()["scenes"]
    assert scene["state"] == "uploaded"
    assert me.get(f"/scenes/{scene['id']}/files/a.tif").content == TIFF


@pytest.mark.parametrize("former", [None, b"LINE_OFF: 2"])
def test_a_side_file_whose_commit_fails_leaves_no_row_that_lies(
    me: Caller, storage: Storage, dsn: str, former: bytes | None
):
    scene = me.post("/scenes?name=a.tif", content=TIFF).json()["id"]
    url = f"/scenes/{scene}/files/a_RPC.TXT"
    if former is not None:
        me.put(url, content=former).raise_for_status()
    with at_commit(dsn, "scene", CUT):
        assert me.put(url, content=MODEL).status_code == 503
    assert me.get(f"/scenes/{scene}").json()["models"] == []
    assert storage.keys(f"scenes/{scene}") == [f"scenes/{scene}/a.tif"]
    assert me.put(url, content=MODEL).status_code == 200
    assert me.get(url).content == MODEL


def test_a_block_whose_commit_fails_leaves_nothing_and_can_be_sent_again(
    bearer: Bearer, storage: Storage, dsn: str
):
    me = bearer("admin")
    with at_commit(dsn, "upload", CUT):
        reply = me.put("/blocks/uploads/a.zip", content=content_of("block"))
        assert reply.status_code == 503, reply.text
    assert storage.keys("uploads") == []
    assert me.put("/blocks/uploads/a.zip", content=content_of("block")).is_success
