"""Jobs: what was asked, where it stands, who works on it; and their entries in the queue.

A job is claimed for an attempt under a lease. Whatever an attempt writes names its number and is refused
once the job has gone on without it, so that a worker that comes back from the dead changes nothing.
"""

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Literal
from uuid import UUID, uuid4

import procrastinate
from psycopg.rows import class_row, scalar_row
from psycopg.types.json import Jsonb

from app.db.engine import Connection

JobState = Literal["accepted", "running", "successful", "failed", "dismissed"]
Response = Literal["document", "raw"]

QUEUE = "amers"
TASK = "amers:job"
DURATION_S = "extract(epoch from coalesce(finished_at, clock_timestamp()) - started_at)"
LOST_WORKER = {"type": "lost-worker", "title": "The worker was lost"}
SWEEP_LOCK = 0x414D4552
"""Advisory lock that keeps two workers from sweeping at once."""

queue = procrastinate.App(connector=procrastinate.SyncPsycopgConnector())
"""Only writes queue entries, through the connection of the caller's transaction; it is never opened."""

COLUMNS = """id, kind, state, progress, message, inputs, outputs, response, owner, attempt, failures,
    created_at, claimed_at, started_at, finished_at, updated_at, error, results, results_removed_at"""


class LostJob(Exception):
    """The job went on without this attempt: dismissed, or taken over."""


@dataclass(frozen=True)
class Job:
    """One row of the table.

    Attributes:
        kind: the process that was asked for.
        progress: percent.
        inputs: what it was asked with.
        outputs: name of each output asked for, to how it shall be sent; None: all of them.
        response: whether results are told in a document or sent as they are.
        owner: the token that asked; None for the command line.
        attempt: number of the last claim.
        failures: attempts that ended without an outcome: a crash, an outage, a lost worker.
        claimed_at, started_at: when the last attempt began, and the first.
        error: problem details of a failure.
        results: what a successful job made.
        results_removed_at: when the files of the results went.
    """

    id: UUID
    kind: str
    state: JobState
    progress: int
    message: str
    inputs: dict[str, Any]
    outputs: dict[str, str] | None
    response: Response
    owner: UUID | None
    attempt: int
    failures: int
    created_at: datetime
    claimed_at: datetime | None
    started_at: datetime | None
    finished_at: datetime | None
    updated_at: datetime
    error: dict[str, Any] | None
    results: dict[str, Any] | None
    results_removed_at: datetime | None


@dataclass(frozen=True)
class JobFilter:
    """Which jobs are wanted; empty: all.

    Attributes:
        kinds: processes.
        since, until: when they were asked for.
        min_duration_s, max_duration_s: from the beginning of the first attempt to the end, or to now.
    """

    kinds: tuple[str, ...] = ()
    states: tuple[JobState, ...] = ()
    since: datetime | None = None
    until: datetime | None = None
    min_duration_s: float | None = None
    max_duration_s: float | None = None


def create(
    connection: Connection,
    kind: str,
    inputs: dict[str, Any],
    owner: UUID | None = None,
    idempotency_key: str | None = None,
    outputs: dict[str, str] | None = None,
    response: Response = "document",
) -> Job | None:
    """A new accepted job, in the queue once the transaction is committed.

    Returns:
        None when the owner has used the idempotency key before.
    """
    job = _one(
        connection,
        f"""insert into job (id, kind, state, progress, message, inputs, outputs, response, owner,
                idempotency_key)
            values (%s, %s, 'accepted', 0, 'waiting for a worker', %s, %s, %s, %s, %s)
            on conflict (owner, idempotency_key) do nothing returning {COLUMNS}""",
        (uuid4(), kind, Jsonb(inputs), None if outputs is None else Jsonb(outputs), response)
        + (owner, idempotency_key),
    )
    if job is not None:
        enqueue(connection, job.id)
    return job


def enqueue(connection: Connection, job_id: UUID, delay_s: float = 0.0) -> None:
    """Put a job into the queue; a job that is in it twice is done once."""
    queue.configure_task(
        TASK,
        queue=QUEUE,
        schedule_in={"milliseconds": int(1000 * delay_s)} if delay_s else None,
        connection=connection,
    ).defer(job_id=str(job_id))


def find(connection: Connection, job_id: UUID) -> Job | None:
    """The job of that number."""
    return _one(connection, f"select {COLUMNS} from job where id = %s", (job_id,))


def find_by_key(connection: Connection, owner: UUID | None, idempotency_key: str) -> Job | None:
    """The job an owner asked for with that key."""
    return _one(
        connection,
        f"select {COLUMNS} from job where owner is not distinct from %s and idempotency_key = %s",
        (owner, idempotency_key),
    )


def newest(
    connection: Connection,
    owner: UUID | None,
    wanted: JobFilter,
    limit: int,
    after: UUID | None = None,
) -> list[Job]:
    """The last jobs of an owner, or of everybody for None; newest first.

    Args:
        after: the page begins behind this job.
    """
    with connection.cursor(row_factory=class_row(Job)) as cursor:
        return cursor.execute(
            f"""select {COLUMNS} from job
                where (%(owner)s::uuid is null or owner = %(owner)s)
                  and (%(kinds)s::text[] is null or kind = any(%(kinds)s))
                  and (%(states)s::text[] is null or state = any(%(states)s))
                  and created_at between coalesce(%(since)s::timestamptz, '-infinity')
                                     and coalesce(%(until)s::timestamptz, 'infinity')
                  and (%(least)s::float8 is null or {DURATION_S} >= %(least)s)
                  and (%(most)s::float8 is null or {DURATION_S} <= %(most)s)
                  and (%(after)s::uuid is null
                       or (created_at, id) < (select created_at, id from job where id = %(after)s))
                order by created_at desc, id desc limit %(limit)s""",
            {
                "owner": owner,
                "kinds": list(wanted.kinds) or None,
                "states": list(wanted.states) or None,
                "since": wanted.since,
                "until": wanted.until,
                "least": wanted.min_duration_s,
                "most": wanted.max_duration_s,
                "limit": limit,
                "after": after,
            },
        ).fetchall()


def claim(connection: Connection, job_id: UUID, worker: str, lease_s: float) -> Job | None:
    """Begin the next attempt of an accepted job; None when it is not there to be taken."""
    return _one(
        connection,
        f"""update job set state = 'running', attempt = attempt + 1, worker = %s,
                lease_until = clock_timestamp() + %s, progress = 0, message = 'started',
                claimed_at = clock_timestamp(),
                started_at = coalesce(started_at, clock_timestamp()), updated_at = clock_timestamp()
            where id = %s and state = 'accepted' returning {COLUMNS}""",
        (worker, timedelta(seconds=lease_s), job_id),
    )


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


def dismiss(connection: Connection, job_id: UUID) -> bool:
    """End a job nobody wants any more; whoever works on it finds out at its next write."""
    done = connection.execute(
        """update job set state = 'dismissed', message = 'dismissed',
               lease_until = null, finished_at = clock_timestamp(), updated_at = clock_timestamp()
           where id = %s and state in ('accepted', 'running')""",
        (job_id,),
    )
    return done.rowcount == 1


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


def counting_attempts(connection: Connection, job_ids: list[UUID]) -> dict[UUID, int]:
    """The attempt of each of some jobs that is under way or succeeded, if its results are kept."""
    rows = connection.execute(
        "select id, attempt from job where id = any(%s) and results_removed_at is null"
        " and state in ('running', 'successful')",
        [job_ids],
    )
    return {row["id"]: row["attempt"] for row in rows}


def remove_old_results(connection: Connection, older_than_s: float) -> list[UUID]:
    """Give up the results of jobs that ended so long ago; their files are swept, the jobs stay."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        removed: list[UUID] = cursor.execute(
            """update job set results_removed_at = clock_timestamp()
               where state = 'successful' and results_removed_at is null and results ? 'files'
                 and finished_at < clock_timestamp() - %s returning id""",
            (timedelta(seconds=older_than_s),),
        ).fetchall()
    return removed


def may_sweep(connection: Connection) -> bool:
    """Whether nobody else sweeps; holds until the end of the transaction."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        cursor.execute("select pg_try_advisory_xact_lock(%s)", (SWEEP_LOCK,))
        return bool(cursor.fetchone())


def _one(connection: Connection, query: str, values: tuple[Any, ...]) -> Job | None:
    with connection.cursor(row_factory=class_row(Job)) as cursor:
        return cursor.execute(query.encode(), values).fetchone()


def _write(connection: Connection, job_id: UUID, attempt: int, assignments: str, **values: Any) -> None:
    """Change the row of a running job if the attempt is still the one that counts."""
    written = connection.execute(
        f"""update job set {assignments}, updated_at = clock_timestamp()
            where id = %(id)s and attempt = %(attempt)s and state = 'running'""".encode(),
        {"id": job_id, "attempt": attempt, **values},
    )
    if written.rowcount != 1:
        raise LostJob(f"attempt {attempt} of job {job_id} is over")
