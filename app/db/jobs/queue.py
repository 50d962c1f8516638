"""The queue that workers take jobs from: one entry a job, or more, which do no harm."""

from datetime import timedelta
from uuid import UUID

import procrastinate
from psycopg.rows import scalar_row

from app.db.engine import Connection, driver

QUEUE = "amers"
TASK = "amers:job"
SWEEP_LOCK = 0x414D4552
"""Advisory lock that keeps two workers from sweeping at once."""

queue = procrastinate.App(connector=procrastinate.SyncPsycopgConnector())
"""Only writes queue entries, through the connection of the caller's transaction; it is never opened."""


def enqueue(connection: Connection, job_id: UUID, delay_s: float = 0.0) -> None:
    """Put a job into the queue; a job that is in it twice is done once."""
    queue.configure_task(
        TASK,
        queue=QUEUE,
        schedule_in={"milliseconds": int(1000 * delay_s)} if delay_s else None,
        connection=driver(connection),
    ).defer(job_id=str(job_id))


def enqueue_forgotten(connection: Connection, after_s: float) -> list[UUID]:
    """Put accepted jobs into the queue that are in it no longer, for instance after a restore."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        forgotten: list[UUID] = cursor.execute(
            """select id from job where state = 'accepted' and updated_at < clock_timestamp() - %s
               and not exists (select from procrastinate_jobs where task_name = %s and status = 'todo'
                               and args ->> 'job_id' = job.id::text)
               for update skip locked""",
            (timedelta(seconds=after_s), TASK),
        ).fetchall()
    for job_id in forgotten:
        connection.execute("update job set updated_at = clock_timestamp() where id = %s", (job_id,))
        enqueue(connection, job_id)
    return forgotten


def forget_dead_entries(connection: Connection, silent_s: float) -> None:
    """Delete the queue entries that died with their workers; the jobs themselves are taken back."""
    connection.execute("select * from procrastinate_prune_stalled_workers_v1(%s)", (silent_s,))
    connection.execute(
        "delete from procrastinate_jobs where task_name = %s and status = 'doing' and worker_id is null",
        (TASK,),
    )


def may_sweep(connection: Connection) -> bool:
    """Whether nobody else sweeps; holds until the end of the transaction."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        cursor.execute("select pg_try_advisory_xact_lock(%s)", (SWEEP_LOCK,))
        return bool(cursor.fetchone())
