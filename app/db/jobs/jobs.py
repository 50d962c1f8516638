"""Jobs: what was requested, and its state."""

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any
from uuid import UUID, uuid4

from sqlalchemy import ColumnElement, delete, extract, func, select, tuple_, update
from sqlalchemy.dialects.postgresql import insert

from amers.app.db.engine import Connection
from amers.app.db.jobs.queue import issue_ticket, replace_spent_ticket
from amers.app.db.rows import among, columns_of, every, first
from amers.app.db.schema import JobResponse, JobState, clock, job, registration, uptime_s

OPEN: tuple[JobState, ...] = ("accepted", "running")
"""States of jobs that have not ended."""
MOST_DELETED = 10_000
"""Largest number of jobs that one sweep deletes or measures."""
DURATION_S = extract("epoch", func.coalesce(job.c.finished_at, clock) - job.c.started_at)


@dataclass(frozen=True)
class Job:
    """One row of the table.

    Attributes:
        kind: the process.
        progress: percent.
        outputs: name of each requested output, to its form; None: all of them.
        response: whether the results are returned in a document or as they are.
        owner: the token of the request; None for the command line.
        attempt: number of the last claim.
        failures: attempts that ended without an outcome: a crash, an outage, a lost worker.
        claimed_at, started_at: when the last attempt began, and the first.
        error: problem details of a failure.
        results: what a successful job made; of a failed registration its verdict and its report.
        results_removed_at: when the files of the results were removed.
        priority: jobs of a higher one come first; 0 unless an administrator set it.
    """

    id: UUID
    kind: str
    state: JobState
    progress: int
    message: str
    inputs: dict[str, Any]
    outputs: dict[str, str] | None
    response: JobResponse
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
    priority: int


@dataclass(frozen=True)
class JobFilter:
    """Which jobs are wanted; empty: all.

    Attributes:
        kinds: processes.
        since, until: when they were created.
        min_duration_s, max_duration_s: from the start of the first attempt to the end, or to now.
    """

    kinds: tuple[str, ...] = ()
    states: tuple[JobState, ...] = ()
    since: datetime | None = None
    until: datetime | None = None
    min_duration_s: float | None = None
    max_duration_s: float | None = None


COLUMNS = columns_of(Job, job)


def create(
    connection: Connection,
    kind: str,
    inputs: dict[str, Any],
    owner: UUID | None = None,
    *,
    idempotency_key: str | None = None,
    outputs: dict[str, str] | None = None,
    response: JobResponse = "document",
    priority: int = 0,
) -> Job | None:
    """A new accepted job, in the queue once the transaction is committed.

    Returns:
        None when the owner has used the idempotency key before.
    """
    statement = (
        insert(job)
        .values(
            id=uuid4(),
            kind=kind,
            state="accepted",
            progress=0,
            message="waiting for a worker",
            inputs=inputs,
            outputs=outputs,
            response=response,
            owner=owner,
            idempotency_key=idempotency_key,
            priority=priority,
        )
        .on_conflict_do_nothing(index_elements=[job.c.owner, job.c.idempotency_key])
        .returning(*COLUMNS)
    )
    created = first(Job, connection.execute(statement))
    if created is not None:
        issue_ticket(connection)
    return created


def find(connection: Connection, job_id: UUID) -> Job | None:
    """The job with that id."""
    return first(Job, connection.execute(select(*COLUMNS).where(job.c.id == job_id)))


def find_by_key(connection: Connection, owner: UUID | None, idempotency_key: str) -> Job | None:
    """The job that an owner created with that key."""
    statement = select(*COLUMNS).where(
        job.c.owner.is_not_distinct_from(owner), job.c.idempotency_key == idempotency_key
    )
    return first(Job, connection.execute(statement))


def newest(
    connection: Connection,
    owner: UUID | None,
    wanted: JobFilter,
    limit: int,
    after: UUID | None = None,
) -> list[Job]:
    """The last jobs of an owner, or of everybody for None; newest first.

    Args:
        after: the page starts behind this job.
    """
    conditions = _conditions(wanted)
    if owner is not None:
        conditions.append(job.c.owner == owner)
    if after is not None:
        last = job.alias("last")
        key = select(last.c.created_at, last.c.id).where(last.c.id == after).scalar_subquery()
        conditions.append(tuple_(job.c.created_at, job.c.id) < key)
    statement = (
        select(*COLUMNS)
        .where(*conditions)
        .order_by(job.c.created_at.desc(), job.c.id.desc())
        .limit(limit)
    )
    return every(Job, connection.execute(statement))


def dismiss(connection: Connection, job_id: UUID) -> bool:
    """End a job that nobody wants any more; its worker notices at its next write."""
    dismissed = connection.execute(
        update(job)
        .where(job.c.id == job_id, job.c.state.in_(OPEN))
        .values(
            state="dismissed",
            message="dismissed",
            lease_until=None,
            finished_at=clock,
            updated_at=clock,
        )
    )
    if dismissed.rowcount == 1:
        replace_spent_ticket(connection)
    return dismissed.rowcount == 1


def delete_ended(connection: Connection, job_ids: list[UUID]) -> list[UUID]:
    """Delete those of some jobs that have ended, with their messages; returns their ids.

    A registration stays without its job and without files, because points have its measures in their
    histories.
    """
    _forget_files(connection, job_ids)
    deleted = delete(job).where(among(job.c.id, job_ids), job.c.state.not_in(OPEN)).returning(job.c.id)
    return list(connection.scalars(deleted))


def remove_old_results(connection: Connection, older_than_s: float) -> list[UUID]:
    """Give up the results of jobs that ended so long ago; returns the ids of these jobs."""
    removed = connection.scalars(
        update(job)
        .where(
            # Each part has an index of its own.
            (job.c.state == "successful") | ((job.c.state == "failed") & (job.c.results_bytes > 0)),
            job.c.results_removed_at.is_(None),
            job.c.results.has_key("files"),
            *_older_than(older_than_s),
        )
        .values(results_removed_at=clock, results_bytes=0)
        .returning(job.c.id)
    )
    job_ids = list(removed)
    _forget_files(connection, job_ids)
    return job_ids


def delete_old(connection: Connection, older_than_s: float) -> int:
    """Delete jobs without files that ended so long ago, the oldest first; returns how many."""
    old = (
        select(job.c.id)
        .where(job.c.state.not_in(OPEN), job.c.results_bytes == 0, *_older_than(older_than_s))
        .order_by(job.c.finished_at)
        .limit(MOST_DELETED)
    )
    return len(delete_ended(connection, list(connection.scalars(old))))


def unmeasured(connection: Connection) -> list[UUID]:
    """Some of the jobs whose results were stored before sizes were recorded."""
    statement = select(job.c.id).where(job.c.results_bytes.is_(None)).limit(MOST_DELETED)
    return list(connection.scalars(statement))


def set_measured(connection: Connection, job_id: UUID, size_bytes: int) -> None:
    """Record the size of the results of a job that has none recorded."""
    connection.execute(
        update(job)
        .where(job.c.id == job_id, job.c.results_bytes.is_(None))
        .values(results_bytes=size_bytes)
    )


def _older_than(older_than_s: float) -> tuple[ColumnElement[bool], ...]:
    """Conditions: the job ended so long ago, and the service has run for as long since it was created.

    A clock that jumps ahead thus makes no job old.
    """
    return (
        job.c.finished_at < clock - timedelta(seconds=older_than_s),
        job.c.created_at_uptime_s < uptime_s - older_than_s,
    )


def _forget_files(connection: Connection, job_ids: list[UUID]) -> None:
    """Empty the lists of files of the registrations of some jobs."""
    connection.execute(
        update(registration).where(among(registration.c.job_id, job_ids)).values(files={})
    )


def _conditions(wanted: JobFilter) -> list[ColumnElement[bool]]:
    conditions: list[ColumnElement[bool]] = []
    if wanted.kinds:
        conditions.append(job.c.kind.in_(wanted.kinds))
    if wanted.states:
        conditions.append(job.c.state.in_(wanted.states))
    if wanted.since is not None:
        conditions.append(job.c.created_at >= wanted.since)
    if wanted.until is not None:
        conditions.append(job.c.created_at <= wanted.until)
    if wanted.min_duration_s is not None:
        conditions.append(wanted.min_duration_s <= DURATION_S)
    if wanted.max_duration_s is not None:
        conditions.append(wanted.max_duration_s >= DURATION_S)
    return conditions
