"""Attempts at jobs: claimed under a lease, they report, end well or badly, or are given up.

Whatever an attempt writes names its number and is refused once the job has gone on without it, so that a
worker that comes back from the dead changes nothing.
"""

from datetime import timedelta
from typing import Any
from uuid import UUID

from psycopg.rows import class_row
from psycopg.types.json import Jsonb

from app.db.engine import Connection
from app.db.jobs.jobs import COLUMNS, Job
from app.db.jobs.queue import enqueue

LOST_WORKER = {"type": "lost-worker", "title": "The worker was lost"}


class LostJob(Exception):
    """The job went on without this attempt: dismissed, or taken over."""


def claim(connection: Connection, job_id: UUID, worker: str, lease_s: float) -> Job | None:
    """Begin the next attempt of an accepted job; None when it is not there to be taken."""
    with connection.cursor(row_factory=class_row(Job)) as cursor:
        return cursor.execute(
            f"""update job set state = 'running', attempt = attempt + 1, worker = %s,
                lease_until = clock_timestamp() + %s, progress = 0, message = 'started',
                claimed_at = clock_timestamp(),
                started_at = coalesce(started_at, clock_timestamp()), updated_at = clock_timestamp()
            where id = %s and state = 'accepted' returning {COLUMNS}""",
            (worker, timedelta(seconds=lease_s), job_id),
        ).fetchone()


def renew(connection: Connection, job_id: UUID, attempt: int, lease_s: float) -> None:
    """Prolong the lease of an attempt.

    Raises:
        LostJob: the attempt is over.
    """
    _write(
        connection,
        job_id,
        attempt,
        "lease_until = clock_timestamp() + %(lease)s",
        lease=timedelta(seconds=lease_s),
    )


def report(connection: Connection, job_id: UUID, attempt: int, percent: int, message: str) -> None:
    """Say where an attempt stands.

    Raises:
        LostJob: the attempt is over.
    """
    _write(
        connection,
        job_id,
        attempt,
        "progress = %(percent)s, message = %(message)s",
        percent=percent,
        message=message,
    )


def succeed(connection: Connection, job_id: UUID, attempt: int, results: dict[str, Any]) -> None:
    """End a job well; belongs into the transaction that writes its results, as the last statement.

    Raises:
        LostJob: the attempt is over; the transaction must be rolled back.
    """
    _write(
        connection,
        job_id,
        attempt,
        """state = 'successful', progress = 100, message = 'done', results = %(results)s, error = null,
           lease_until = null, finished_at = clock_timestamp()""",
        results=Jsonb(results),
    )


def fail(connection: Connection, job_id: UUID, attempt: int, error: dict[str, Any]) -> None:
    """End a job for good, with problem details that tell its owner why.

    Raises:
        LostJob: the attempt is over.
    """
    _write(
        connection,
        job_id,
        attempt,
        """state = 'failed', message = %(message)s, error = %(error)s, lease_until = null,
           finished_at = clock_timestamp()""",
        message=error.get("detail", error["title"]),
        error=Jsonb(error),
    )


def give_back(connection: Connection, job_id: UUID, attempt: int) -> None:
    """Return a job whose worker has to stop; this does not count as a failure.

    Raises:
        LostJob: the attempt is over.
    """
    _write(
        connection,
        job_id,
        attempt,
        "state = 'accepted', message = 'waiting for a worker', lease_until = null, worker = null",
    )
    enqueue(connection, job_id)


def try_again(connection: Connection, job_id: UUID, attempt: int, delay_s: float) -> None:
    """Return a job whose attempt ended without an outcome, to be done after a delay.

    Raises:
        LostJob: the attempt is over.
    """
    _write(
        connection,
        job_id,
        attempt,
        """state = 'accepted', failures = failures + 1, lease_until = null, worker = null,
           message = 'broke off, waiting for the next attempt'""",
    )
    enqueue(connection, job_id, delay_s)


def take_back(connection: Connection, failures_allowed: int) -> list[UUID]:
    """Return jobs whose lease is over to the queue, or fail those that lost too many workers.

    Rows that are being written are left to their writers.
    """
    with connection.cursor(row_factory=class_row(Job)) as cursor:
        lapsed = cursor.execute(
            f"""update job set failures = failures + 1, lease_until = null, worker = null,
                    state = 'accepted', message = 'the worker was lost, waiting for another',
                    updated_at = clock_timestamp()
                where id in (select id from job
                             where state = 'running' and lease_until < clock_timestamp()
                             for update skip locked)
                returning {COLUMNS}"""
        ).fetchall()
    for job in lapsed:
        if job.failures < failures_allowed:
            enqueue(connection, job.id)
            continue
        detail = f"the worker died {job.failures} times while it did this job"
        connection.execute(
            """update job set state = 'failed', message = %s, error = %s, finished_at = clock_timestamp()
               where id = %s""",
            (detail, Jsonb({**LOST_WORKER, "detail": detail, "failures": job.failures}), job.id),
        )
    return [job.id for job in lapsed]


def counting_attempts(connection: Connection, job_ids: list[UUID]) -> dict[UUID, int]:
    """The attempt of each of some jobs that is under way or succeeded, if its results are kept."""
    rows = connection.execute(
        "select id, attempt from job where id = any(%s) and results_removed_at is null"
        " and state in ('running', 'successful')",
        [job_ids],
    )
    return {row["id"]: row["attempt"] for row in rows}


def _write(connection: Connection, job_id: UUID, attempt: int, assignments: str, **values: Any) -> None:
    """Change the row of a running job if the attempt is still the one that counts."""
    written = connection.execute(
        f"""update job set {assignments}, updated_at = clock_timestamp()
            where id = %(id)s and attempt = %(attempt)s and state = 'running'""".encode(),
        {"id": job_id, "attempt": attempt, **values},
    )
    if written.rowcount != 1:
        raise LostJob(f"attempt {attempt} of job {job_id} is over")
