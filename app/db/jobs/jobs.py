"""Jobs: what was asked for, and where it stands."""

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Literal
from uuid import UUID, uuid4

from psycopg.rows import class_row, scalar_row
from psycopg.types.json import Jsonb

from app.db.engine import Connection
from app.db.jobs.queue import enqueue

JobState = Literal["accepted", "running", "successful", "failed", "dismissed"]
Response = Literal["document", "raw"]

DURATION_S = "extract(epoch from coalesce(finished_at, clock_timestamp()) - started_at)"
COLUMNS = """id, kind, state, progress, message, inputs, outputs, response, owner, attempt, failures,
    created_at, claimed_at, started_at, finished_at, updated_at, error, results, results_removed_at"""


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


def dismiss(connection: Connection, job_id: UUID) -> bool:
    """End a job nobody wants any more; whoever works on it finds out at its next write."""
    done = connection.execute(
        """update job set state = 'dismissed', message = 'dismissed',
               lease_until = null, finished_at = clock_timestamp(), updated_at = clock_timestamp()
           where id = %s and state in ('accepted', 'running')""",
        (job_id,),
    )
    return done.rowcount == 1


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


def _one(connection: Connection, query: str, values: tuple[Any, ...]) -> Job | None:
    with connection.cursor(row_factory=class_row(Job)) as cursor:
        return cursor.execute(query.encode(), values).fetchone()
