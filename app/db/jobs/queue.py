"""The queue that workers take jobs from; a second entry of the same job does no harm."""

from functools import cache
from typing import TYPE_CHECKING
from uuid import UUID

from sqlalchemy import func, select, update

from app.db.engine import Connection, driver
from app.db.schema import clock, job
from app.db.statements import named

if TYPE_CHECKING:
    import procrastinate

QUEUE = "amers"
TASK = "amers:job"
SWEEP_LOCK = 0x414D4552
"""Advisory lock that keeps two workers from sweeping at once."""

FORGOTTEN_JOBS = named("jobs.sql", "forgotten_jobs")
PRUNE_SILENT_WORKERS = named("jobs.sql", "prune_silent_workers")
DELETE_DEAD_ENTRIES = named("jobs.sql", "delete_dead_entries")


def enqueue(connection: Connection, job_id: UUID, delay_s: float = 0.0) -> None:
    """Put a job into the queue, in the transaction of its row; a job with two entries is done once."""
    _queue().configure_task(
        TASK,
        queue=QUEUE,
        schedule_in={"milliseconds": int(1000 * delay_s)} if delay_s else None,
        connection=driver(connection),
    ).defer(job_id=str(job_id))


def enqueue_forgotten(connection: Connection, after_s: float) -> list[UUID]:
    """Put accepted jobs into the queue that it does not have any more, for instance after a restore."""
    forgotten = list(connection.scalars(FORGOTTEN_JOBS, {"after_s": after_s, "task": TASK}))
    for job_id in forgotten:
        connection.execute(update(job).where(job.c.id == job_id).values(updated_at=clock))
        enqueue(connection, job_id)
    return forgotten


def forget_dead_entries(connection: Connection, silent_s: float) -> None:
    """Delete the queue entries of dead workers; the jobs themselves are taken back."""
    connection.execute(PRUNE_SILENT_WORKERS, {"silent_s": silent_s})
    connection.execute(DELETE_DEAD_ENTRIES, {"task": TASK})


def may_sweep(connection: Connection) -> bool:
    """Whether nobody else sweeps; true until the end of the transaction."""
    return bool(connection.scalar(select(func.pg_try_advisory_xact_lock(SWEEP_LOCK))))


@cache
def _queue() -> "procrastinate.App":
    """Writes queue entries through the connection of the caller's transaction; it is never opened."""
    # Imported by the first job: readers of the store start without it.
    import procrastinate

    return procrastinate.App(connector=procrastinate.SyncPsycopgConnector())
