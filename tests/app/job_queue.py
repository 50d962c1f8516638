"""Jobs in the queue of a test, in the states that workers bring them into."""

from typing import Any
from uuid import UUID, uuid4

from amers.app.db import registrations
from amers.app.db.engine import Connection, Database
from amers.app.db.jobs import attempts, jobs
from amers.app.db.jobs.jobs import Job
from tests.statements import run_in, run_sql

LEASE_S = 30.0


def requested(
    connection: Connection, kind: str, inputs: dict[str, Any], *of: UUID | None, **more: Any
) -> Job:
    """A job as it is requested, under a key that nobody has used."""
    job = jobs.create(connection, kind, inputs, *of, **more)
    assert job is not None
    return job


def new_job(database: Database) -> Job:
    """An accepted job."""
    with database.transaction() as connection:
        return requested(connection, "register-scene", {"scene": str(uuid4())})


def claim(
    connection: Connection, job_id: UUID, worker: str = "w", lease_s: float = LEASE_S
) -> Job | None:
    """The job, claimed by a worker before all others; None when no job waits."""
    run_sql(
        connection, "update job set priority = 100 where id = %s and state = 'accepted'", [str(job_id)]
    )
    job = attempts.claim_next(connection, worker, lease_s)
    assert job is None or job.id == job_id
    return job


def claimed(database: Database, job_id: UUID, worker: str = "w", lease_s: float = LEASE_S) -> Job:
    """The job, claimed by a worker."""
    with database.transaction() as connection:
        job = claim(connection, job_id, worker, lease_s)
    assert job is not None
    return job


def state_of(database: Database, job_id: UUID) -> Job:
    """The present row of the job."""
    with database.transaction() as connection:
        job = jobs.find(connection, job_id)
    assert job is not None
    return job


def store_registration(connection: Connection, **stated: Any) -> UUID:
    """The id of a good registration without scene, job and files, but for what is stated of it."""
    nothing: dict[str, Any] = {"job_id": None, "scene_id": None, "block_versions": [], "options": {}}
    nothing |= {"report": {}, "verdict": "good", "files": {}}
    return registrations.insert_registration(connection, **nothing | stated)


def let_lease_lapse(database: Database, job_id: UUID) -> None:
    """Let the lease of the job expire."""
    run_in(
        database.transaction(),
        "update job set lease_until = now() - interval '1 second' where id = %s",
        [job_id],
    )


def tickets(connection: Connection) -> int:
    """The number of tickets that workers may take, now or later."""
    (row,) = run_sql(
        connection, "select count(*) as n from procrastinate_jobs where status = 'todo'"
    ).fetchall()
    return int(row["n"])
