"""Databases of another Amers are refused: at the start, and when they are upgraded meanwhile."""

import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine, revisions
from amers.app.db.engine import Database
from amers.app.db.jobs import attempts
from amers.app.errors import InputError
from amers.app.main import create_app
from amers.app.worker.attempt import Attempts
from tests.app.callers import Caller
from tests.statements import run_in

FOREIGN = ("9999", "00001", "8f2c1d0b7a6e")
"""Of a newer Amers, and of other programs that use Alembic."""


def set_revision(dsn: str, revision: str) -> None:
    run_in(engine.connect(dsn), "update alembic_version set version_num = %s", [revision])


@pytest.mark.parametrize("revision", FOREIGN)
def test_api_and_worker_do_not_start_on_a_foreign_schema(settings: Settings, dsn: str, revision: str):
    set_revision(dsn, revision)
    with (
        pytest.raises(InputError, match=rf"revision {revision}, which this Amers does not know"),
        engine.opened(settings),
    ):
        pass
    with pytest.raises(InputError, match="AMERS_DATABASE_URL"), TestClient(create_app(settings)):
        pass
    with pytest.raises(InputError, match="does not know"):
        revisions.upgrade(dsn)


def test_an_older_schema_is_to_be_upgraded(settings: Settings, dsn: str):
    set_revision(dsn, "0001")
    with pytest.raises(InputError, match="run `amers db upgrade`"), engine.opened(settings):
        pass


@pytest.mark.thorough
@pytest.mark.parametrize("command", [("serve", "--no-worker"), ("worker",)])
def test_the_commands_end_with_the_reason(dsn: str, tmp_path: Path, command: tuple[str, ...]):
    set_revision(dsn, "9999")
    environment = {"AMERS_DATABASE_URL": dsn, "AMERS_DATA_FOLDER": str(tmp_path), "PATH": "/usr/bin"}
    words = [sys.executable, "-m", "amers", *command]
    environment["PYTHONPATH"] = ":".join(sys.path)
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=90)
    assert done.returncode != 0
    assert "9999" in done.stderr
    assert "Traceback" not in done.stderr


def test_an_upgrade_under_a_running_service_is_noticed(
    client: TestClient, me: Caller, settings: Settings, dsn: str
):
    scene = me.post("/scenes?name=a.tif", content=b"II*\0" + bytes(100)).json()["id"]
    body = {"inputs": {"scene": scene}}
    job = me.post("/processes/register-scene/execution", json=body).json()["jobID"]
    database: Database = client.app.state.database  # type: ignore[attr-defined]
    worker = Attempts(database, cast(Any, None), settings, "a worker", lambda: False)
    set_revision(dsn, "9999")
    with pytest.raises(InputError, match="restart it"):
        worker.do_next_job()
    assert me.get(f"/jobs/{job}").json()["status"] == "accepted"
    ready = client.get("/readyz")
    assert ready.status_code == 503
    assert "9999" in ready.text
    set_revision(dsn, revisions.newest_revision())
    with database.transaction() as connection:
        claimed = attempts.claim_next(connection, "a worker", 60.0, 1)
    assert claimed is not None, "the job waits for a worker that fits"
    assert str(claimed.id) == job
