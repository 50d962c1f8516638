"""The store of every release: its dump is restored, upgraded, and used."""

import gzip
import hashlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import UUID

import psycopg
import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine, revisions
from amers.app.db.cluster.embedded import SUPERUSER, Cluster
from amers.app.db.engine import Database
from amers.app.db.jobs import attempts
from amers.app.main import create_app
from amers.app.storage import Storage
from amers.app.usecases import storage_identity
from amers.app.worker.sweep import sweep_jobs
from tests.app.conftest import EMPTY_TEMPLATE, TEMPLATE, fresh_database
from tests.app.full_storage import database_name
from tests.app.job_queue import LEASE_S
from tests.app.test_schema import catalogue, differences
from tests.statements import run_sql

FOLDER = Path(__file__).parents[1] / "golden" / "releases"
DUMPS = sorted(FOLDER.glob("*.sql.gz"))
LARGEST_DUMP_BYTES = 100_000
MADE_BY_THE_INSTALLATION_ITSELF = {"alembic_version", "spatial_ref_sys"}
EMPTY_IN_EVERY_DUMP = {"procrastinate_periodic_defers"}
STATES = {"accepted", "running", "successful", "failed", "dismissed"}
EXECUTE = "/processes/register-scene/execution"
MOMENT = re.compile(r"(\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d\.\d+)(?=\+00)")
"""A time that the database wrote; dates of scenes and images have no fractions of a second."""

Counts = dict[str, int]


@contextmanager
def restored(cluster: Cluster, path: Path) -> Iterator[str]:
    """The connection string of a dump in a database of its own."""
    with fresh_database(cluster, EMPTY_TEMPLATE) as dsn:
        # As in the private cluster of a release before roles: a superuser owns all of it.
        name = database_name(dsn)
        with psycopg.connect(cluster.dsn(name, SUPERUSER)) as connection:
            connection.execute(as_if_made_now(path).encode())
        cluster.hand_over(name)
        assert revisions.status(dsn).found == path.name.split(".")[0]
        yield dsn


@pytest.fixture(scope="module", params=DUMPS, ids=lambda path: path.name.split(".")[0])
def upgraded(cluster: Cluster, request: pytest.FixtureRequest) -> Iterator[tuple[str, Counts, Counts]]:
    """The connection string of an upgraded dump, and how many rows its tables had before and after."""
    with restored(cluster, request.param) as dsn:
        before = counts(dsn)
        revisions.upgrade(dsn)
        yield dsn, before, counts(dsn)


def as_if_made_now(path: Path) -> str:
    """The statements of a dump whose first row is five minutes old, so that delays go on from there."""
    statements = gzip.decompress(path.read_bytes()).decode()
    first = min(datetime.fromisoformat(found) for found in MOMENT.findall(statements))
    later = datetime.now(UTC).replace(tzinfo=None) - timedelta(minutes=5) - first

    def moved(found: re.Match[str]) -> str:
        moment = datetime.fromisoformat(found[1]) + later
        return moment.isoformat(found[1][10], "microseconds")

    return MOMENT.sub(moved, statements)


@pytest.fixture
def dsn(upgraded: tuple[str, Counts, Counts]) -> str:
    """The upgraded store instead of an empty one."""
    return upgraded[0]


@pytest.fixture
def headers(dsn: str) -> dict[str, dict[str, str]]:
    """The headers of the tokens of the dump, by name: they get new secrets, as only hashes are kept."""
    with psycopg.connect(dsn) as connection:
        names = [name for (name,) in connection.execute("select name from token where subject is null")]
        for name in names:
            digest = hashlib.sha256(f"secret of {name}".encode()).digest()
            connection.execute("update token set secret_hash = %s where name = %s", [digest, name])
    return {name: {"Authorization": f"Bearer secret of {name}"} for name in names}


def counts(dsn: str) -> Counts:
    """The number of rows of every table."""
    with psycopg.connect(dsn) as connection:
        tables = connection.execute(
            "select tablename from pg_tables where schemaname = 'public'"
        ).fetchall()
        return {
            name: row[0]
            for (name,) in tables
            if (row := connection.execute(f'select count(*) from public."{name}"').fetchone())  # type: ignore[arg-type]
        }


def all_rows(dsn: str, statement: str, *values: Any) -> list[dict[str, Any]]:
    """The rows of a statement."""
    with engine.connect(dsn) as connection:
        return [dict(row) for row in run_sql(connection, statement, list(values)).fetchall()]


def test_there_is_a_dump_and_each_is_small():
    assert DUMPS, FOLDER
    for path in DUMPS:
        assert path.stat().st_size < LARGEST_DUMP_BYTES, path


def test_a_dump_has_rows_in_every_table_and_jobs_in_every_state(
    upgraded: tuple[str, Counts, Counts], dsn: str
):
    _, before, _ = upgraded
    assert {name for name, count in before.items() if count == 0} <= EMPTY_IN_EVERY_DUMP
    states = {row["state"] for row in all_rows(dsn, "select distinct state from job")}
    assert states == STATES


def test_the_upgraded_schema_is_that_of_a_new_store(dsn: str, cluster: Cluster):
    with (
        fresh_database(cluster, TEMPLATE) as new,
        psycopg.connect(new) as expected,
        psycopg.connect(dsn) as found,
    ):
        assert differences(catalogue(found), catalogue(expected)) == {}


def test_an_upgrade_loses_no_row(upgraded: tuple[str, Counts, Counts]):
    _, before, after = upgraded
    for name in before.keys() - MADE_BY_THE_INSTALLATION_ITSELF:
        assert after[name] >= before[name], name


def test_the_points_of_a_release_are_served_and_suspended_ones_are_not(
    client: TestClient, headers, dsn: str
):
    admin, items = headers["administrator"], "/collections/points/items"
    page = client.get(f"{items}?limit=100", headers=admin).json()["features"]
    (suspended,) = all_rows(
        dsn, "select id, suspended_because from point where suspended_at is not null"
    )
    assert suspended["suspended_because"] == "the roof was rebuilt"
    assert len(page) == 11
    assert suspended["id"] not in {point["id"] for point in page}
    lon, lat, _ = page[-1]["geometry"]["coordinates"]
    box = ",".join(str(side) for side in (lon - 1e-6, lat - 1e-6, lon + 1e-6, lat + 1e-6))
    near = client.get(f"{items}?bbox={box}", headers=admin).json()["features"]
    assert [point["id"] for point in near] == [page[-1]["id"]]
    assert client.get(f"{items}/{page[-1]['id']}", headers=admin).status_code == 200
    blocks = client.get("/collections/blocks/items", headers=admin).json()["features"]
    states = {block["properties"]["state"] for block in blocks}
    assert states == {"published", "withdrawn", "staged"}


def test_the_tokens_of_a_release_keep_their_ends(client: TestClient, headers, dsn: str):
    status = {name: client.get("/scenes", headers=own).status_code for name, own in headers.items()}
    assert status == {"administrator": 200, "owner": 200, "other": 200, "revoked": 401, "expired": 401}
    (identity,) = all_rows(dsn, "select name, scopes from token where subject is not null")
    assert (identity["name"], identity["scopes"]) == ("surveyor", ["read"])


def test_the_jobs_of_a_release_are_shown_with_messages_and_results(client: TestClient, headers):
    listed = client.get("/jobs?limit=100", headers=headers["administrator"]).json()["jobs"]
    assert {job["status"] for job in listed} == STATES
    for job in listed:
        here = f"/jobs/{job['jobID']}"
        shown = client.get(here, headers=headers["administrator"])
        assert shown.status_code == 200, shown.text
        assert client.get(f"{here}/messages", headers=headers["administrator"]).json()["messages"]
    (done,) = (job["jobID"] for job in listed if job["status"] == "successful")
    results = client.get(f"/jobs/{done}/results", headers=headers["owner"])
    assert "report.json" in results.text, results.text
    assert client.get(f"/jobs/{done}", headers=headers["other"]).status_code == 404


def test_quotas_count_what_a_release_has_kept(
    client: TestClient, headers, dsn: str, database: Database, storage: Storage
):
    storage.folder.mkdir(parents=True)
    storage_identity.adopt(database.transaction, storage)
    (scene,) = all_rows(dsn, "select id from scene where name = 'scene.tif'")
    body = {"inputs": {"scene": str(scene["id"])}}
    (owner,) = all_rows(
        dsn,
        "select job_quota, (select count(*) from job where owner = token.id"
        " and state in ('accepted', 'running')) as open_jobs from token where name = 'owner'",
    )
    for _ in range(owner["job_quota"] - owner["open_jobs"]):
        assert client.post(EXECUTE, json=body, headers=headers["owner"]).status_code == 201
    refused = client.post(EXECUTE, json=body, headers=headers["owner"])
    assert refused.status_code == 429, refused.text
    too_large = client.post(
        "/scenes?name=a.tif", content=b"II*\0" + bytes(9_500_000), headers=headers["owner"]
    )
    assert too_large.status_code == 413, too_large.text


def test_a_request_of_a_release_is_recognised_by_its_key(client: TestClient, headers, dsn: str):
    (job,) = all_rows(dsn, "select id, inputs from job where idempotency_key = 'first'")
    body = {"inputs": job["inputs"]}
    again = client.post(EXECUTE, json=body, headers={**headers["other"], "Idempotency-Key": "first"})
    assert (again.status_code, again.json()["jobID"]) == (201, str(job["id"]))


def test_the_audit_of_a_release_is_kept_and_only_grows(client: TestClient, headers, dsn: str):
    listed = client.get("/audit?limit=1000", headers=headers["administrator"]).json()["changes"]
    kinds = {change["kind"] for change in listed}
    assert kinds >= {"token", "block", "scene", "job", "point", "reference_image"}
    with (
        pytest.raises(psycopg.errors.InsufficientPrivilege),
        psycopg.connect(dsn) as connection,
    ):
        connection.execute("delete from audit")


def test_the_queue_of_a_release_goes_on(settings: Settings, dsn: str):
    """Last, because it claims: waiting jobs in turn, the job of a dead worker, none before its time."""
    waiting = all_rows(
        dsn, "select id, not_before > now() as delayed, owner from job where state = 'accepted'"
    )
    assert [row["delayed"] for row in waiting].count(True) == 1
    (running,) = all_rows(dsn, "select id from job where state = 'running'")
    with engine.pooled(dsn, settings) as database:
        with database.transaction() as connection:
            run_sql(connection, "update job set updated_at = now() - interval '1 hour'")
        sweep_jobs(database, LEASE_S)
        claimed: list[tuple[UUID, UUID | None]] = []
        with database.transaction() as connection:
            tickets = run_sql(
                connection,
                "select count(*) as n from procrastinate_jobs"
                " where status = 'todo' and coalesce(scheduled_at, now()) <= now()",
            ).fetchone()
            while (job := attempts.claim_next(connection, "w", LEASE_S)) is not None:
                claimed.append((job.id, job.owner))
    due = {row["id"] for row in waiting if not row["delayed"]} | {running["id"]}
    assert {job for job, _ in claimed} == due
    assert tickets is not None
    assert tickets["n"] >= len(due), "no job waits without a ticket"
    assert len({owner for _, owner in claimed[:2]}) == 2, "the owners take turns"


def test_a_release_starts_as_a_service(settings: Settings, dsn: str):
    with TestClient(create_app(settings)) as client:
        assert client.get("/healthz").status_code == 200
