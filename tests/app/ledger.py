"""The ledger of the storage beside the storage itself, for tests of quotas."""

from collections.abc import Callable
from uuid import UUID, uuid4

from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import usage
from amers.app.db.engine import Connection, Database
from amers.app.storage import Storage
from amers.app.usecases.jobs import do_attempt
from tests.app.callers import Caller
from tests.app.job_queue import claim

LEDGER_PREFIXES = ("scenes", "results", "uploads")
"""What belongs to owners; chips belong to the installation."""


def bytes_in_storage(storage: Storage) -> int:
    """The bytes of all files that belong to owners, those that are arriving included."""
    stored = sum(storage.size(key) for prefix in LEDGER_PREFIXES for key in storage.keys(prefix))
    return stored + sum(path.stat().st_size for path in storage.scratch().rglob("*") if path.is_file())


def bytes_in_ledger(connection: Connection) -> int:
    """The bytes of all owners by their rows."""
    return sum(one.total_bytes for one in usage.read_all_usage(connection))


def make_token(client: TestClient, admin: dict[str, str], **quotas: object) -> Caller:
    """A new caller who may read and register."""
    body = {"name": f"caller {uuid4()}", "scopes": ["register"], **quotas}
    made = client.post("/tokens", json=body, headers=admin)
    assert made.status_code == 201, made.text
    return Caller(lambda: client, {"Authorization": f"Bearer {made.json()['secret']}"})


def job_runner(
    client: TestClient, database: Database, settings: Settings, me: dict[str, str]
) -> Callable[..., dict]:
    """Executes a process for a caller and does its job here; returns the job as the caller sees it."""

    def run(process: str, **inputs: object) -> dict:
        reply = client.post(f"/processes/{process}/execution", json={"inputs": inputs}, headers=me)
        assert reply.status_code == 201, reply.text
        job_id = UUID(reply.json()["jobID"])
        with database.transaction() as connection:
            assert claim(connection, job_id, "a worker", 30.0)
        do_attempt(database, settings, job_id, 1)
        job: dict = client.get(f"/jobs/{job_id}", headers=me).json()
        return job

    return run
