"""Readiness names the part that does not work, the reason, and what to do."""

import socket
from collections.abc import Callable, Iterator
from typing import NamedTuple
from uuid import uuid4

import psycopg
import pytest
from fastapi.testclient import TestClient
from psycopg import sql

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.cluster.embedded import SUPERUSER, Cluster
from amers.app.db.engine import Database
from amers.app.main import create_app
from amers.app.storage import Marker, Storage, open_storage, write_marker
from amers.app.usecases import readiness
from amers.app.usecases.installation import Installation
from amers.app.usecases.readiness import Readiness
from tests.app.s3_server import KEYS
from tests.statements import run_in

NO_WORKER = {
    "status": "degraded",
    "reason": "no worker is alive: jobs wait until `amers worker` runs",
}
OK = {"status": "ok"}


@pytest.fixture(autouse=True)
def checked_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """No result is repeated."""
    monkeypatch.setattr(readiness, "VALID_S", 0.0)


@pytest.fixture
def part(client: TestClient) -> Callable[[str, int], dict[str, str]]:
    """Gets the state of one part, with the expected status of the reply."""

    def get(name: str, status: int) -> dict[str, str]:
        reply = client.get("/readyz")
        assert reply.status_code == status, reply.text
        state: dict[str, str] = reply.json()["parts"][name]
        return state

    return get


def test_a_service_with_a_worker_is_ready_and_without_one_it_still_answers(client, dsn):
    parts = {"database": OK, "schema": OK, "worker": NO_WORKER, "storage": OK, "disk": OK, "address": OK}
    reply = client.get("/readyz")
    assert (reply.status_code, reply.json()) == (200, {"status": "degraded", "parts": parts})
    run_in(engine.connect(dsn), "insert into procrastinate_workers default values")
    assert client.get("/readyz").json() == {"status": "ready", "parts": parts | {"worker": OK}}
    run_in(
        engine.connect(dsn), "update procrastinate_workers set last_heartbeat = now() - interval '60 s'"
    )
    assert client.get("/readyz").json()["parts"]["worker"] == NO_WORKER


def test_another_schema_is_named_with_what_to_do(part, dsn):
    run_in(engine.connect(dsn), "update alembic_version set version_num = '9999'")
    state = part("schema", 503)
    assert state["status"] == "failed"
    assert "9999" in state["reason"]
    assert "amers db upgrade" in state["reason"]


def test_a_database_that_does_not_answer_is_named(part, cluster: Cluster, dsn):
    name = dsn.split("dbname=")[1].split()[0]
    with psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as connection:
        for allowed in ("false", "true"):
            connection.execute(
                sql.SQL("alter database {} allow_connections {}").format(
                    sql.Identifier(name), sql.SQL(allowed)
                )
            )
            if allowed == "false":
                connection.execute(
                    "select pg_terminate_backend(pid) from pg_stat_activity where datname = %s", [name]
                )
                assert part("database", 503)["status"] == "failed"
    assert part("database", 200) == OK


def test_a_storage_of_another_installation_is_named_with_what_to_do(part, storage: Storage):
    write_marker(storage, Marker(uuid4(), 1))
    state = part("storage", 503)
    assert state["status"] == "failed"
    assert "amers store adopt" in state["reason"]
    assert not storage.exists(readiness.PROBE)


def test_a_damaged_marker_is_named(part, storage: Storage):
    storage.put("installation.json", [b"{"])
    assert "installation.json" in part("storage", 503)["reason"]


def test_a_storage_that_takes_no_files_is_named(part, storage: Storage):
    assert part("storage", 200) == OK
    storage.scratch().rmdir()
    (storage.folder / "unfinished").write_bytes(b"in the way")
    state = part("storage", 200)
    assert state["status"] == "degraded"
    assert "no file can be written" in state["reason"]


def test_a_disk_with_little_room_is_named(settings: Settings):
    full = settings.model_copy(update={"min_free_bytes": 1 << 62})
    with TestClient(create_app(full)) as client:
        reply = client.get("/readyz")
    assert (reply.status_code, reply.json()["status"]) == (200, "degraded")
    assert "AMERS_MIN_FREE_BYTES" in reply.json()["parts"]["disk"]["reason"]


class Disk(NamedTuple):
    """The bytes of a disk, as `shutil.disk_usage` gives them."""

    total: int
    used: int
    free: int


@pytest.mark.parametrize(("missing", "status"), [(0, "ok"), (1, "degraded")])
def test_a_disk_has_room_enough_to_the_byte(
    settings: Settings, database: Database, storage: Storage, monkeypatch, missing: int, status: str
):
    free = settings.min_free_bytes - missing
    monkeypatch.setattr(readiness.shutil, "disk_usage", lambda folder: Disk(10 * free, 9 * free, free))
    checker = Readiness(Installation(database, storage, settings))
    assert checker.check()["disk"].status == status
    checker.close()


@pytest.fixture
def silent_bucket(settings: Settings, monkeypatch: pytest.MonkeyPatch) -> Iterator[Settings]:
    """Settings of a bucket whose server takes connections and never replies."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        address = f"http://127.0.0.1:{server.getsockname()[1]}"
        for name, value in {**KEYS, "AWS_ENDPOINT_URL": address}.items():
            monkeypatch.setenv(name, value)
        yield settings.model_copy(update={"storage_url": "s3://silent/test"})


def test_a_storage_that_never_replies_does_not_hold_up_the_reply(
    silent_bucket: Settings, database: Database, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(readiness, "STORAGE_LIMIT_S", 0.3)
    checker = Readiness(Installation(database, open_storage(silent_bucket), silent_bucket))
    for _ in range(3):
        state = checker.check()["storage"]
        assert state.status == "failed"
        assert state.reason is not None
        assert "has not answered within 0.3 s" in state.reason
    checker.close()
