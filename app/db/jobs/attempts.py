"""Attempts at jobs: an attempt is claimed under a lease, reports progress, and succeeds, fails or ends.

Each write of an attempt names its number. It is refused once the job has gone on without that attempt:
a worker that was believed dead changes nothing.
"""

from datetime import timedelta
from typing import Any
from uuid import UUID

from sqlalchemy import (
    ColumnElement,
    Double,
    Interval,
    Select,
    bindparam,
    case,
    cast,
    func,
    select,
    update,
)
from sqlalchemy.dialects.postgresql import insert

from amers.app.db.engine import Connection
from amers.app.db.jobs.jobs import COLUMNS, Job
from amers.app.db.jobs.queue import issue_ticket, lock_claims, replace_spent_ticket
from amers.app.db.rows import among, every
from amers.app.db.schema import clock, job, job_turn
from amers.app.db.statements import named

DAY_S = 86_400.0
LOST_WORKER = {"type": "lost-worker", "title": "The worker was lost"}


class LostJob(Exception):
    """The job went on without this attempt: it was dismissed, or another worker took it over."""


def claim_next(
    connection: Connection, worker: str, lease_s: float, running_limit: int | None = None
) -> Job | None:
    """The next job, claimed for an attempt; None when no job may be claimed.

    The next job is one of the highest priority; among these, of the owner with the fewest running jobs;
    then of the owner whose last job was claimed longest ago; then the oldest.
    Claims wait for each other.

    Args:
        running_limit: most running jobs of one owner; None: no limit.
    """
    lock_claims(connection)
    values = {"running_limit": running_limit, "by": worker, "lease": timedelta(seconds=lease_s)}
    claimed = every(Job, connection.execute(CLAIM, values))
    return claimed[0] if claimed else None


def _claim() -> Select[Any]:
    """The statement of a claim, in one: other claims wait for every word that is exchanged about it."""
    next_job = named("jobs.sql", "next_job").columns(job.c.id).cte("next_job")
    claimed = (
        update(job)
        .where(job.c.id == next_job.c.id)
        .values(
            state="running",
            attempt=job.c.attempt + 1,
            worker=bindparam("by"),
            lease_until=clock + bindparam("lease", type_=Interval),
            not_before=None,
            progress=0,
            message="started",
            results_bytes=0,
            claimed_at=clock,
            started_at=func.coalesce(job.c.started_at, clock),
            updated_at=clock,
        )
        .returning(*COLUMNS)
        .cte("claimed")
    )
    turn = insert(job_turn).from_select(
        [job_turn.c.owner, job_turn.c.claimed_at], select(claimed.c.owner, claimed.c.claimed_at)
    )
    of_owner = turn.on_conflict_do_update(
        index_elements=[job_turn.c.owner], set_={"claimed_at": turn.excluded.claimed_at}
    )
    return select(claimed).add_cte(of_owner.returning(job_turn.c.owner).cte("turn"))


CLAIM = _claim()


def count_cpu(connection: Connection, owner: UUID | None, cpu_s: float, daily_s: float) -> None:
    """Add CPU that an attempt took to that of its owner, who is given back so much of it every day."""
    connection.execute(
        update(job_turn)
        .where(job_turn.c.owner.is_not_distinct_from(owner))
        .values(cpu_s=_cpu_now(daily_s) + cpu_s, cpu_at=clock)
    )


def cpu_taken(connection: Connection, owner: UUID, daily_s: float) -> float:
    """CPU that jobs of an owner took and that has not been given back, seconds."""
    taken = connection.scalar(select(_cpu_now(daily_s)).where(job_turn.c.owner == owner))
    return float(taken or 0.0)


def _cpu_now(daily_s: float) -> ColumnElement[float]:
    """What is left of recorded CPU; a clock that went back gives nothing back, and takes nothing."""
    elapsed_s = func.greatest(func.extract("epoch", clock - job_turn.c.cpu_at), 0)
    given_back_s = cast(elapsed_s, Double) * (daily_s / DAY_S)
    return func.greatest(job_turn.c.cpu_s - given_back_s, 0.0, type_=Double())


def renew(connection: Connection, job_id: UUID, attempt: int, lease_s: float) -> None:
    """Extend the lease of an attempt: its worker lives; only its process moves `updated_at`.

    Raises:
        LostJob: the attempt is over.
    """
    until = clock + timedelta(seconds=lease_s)
    _write(connection, job_id, attempt, lease_until=until, updated_at=job.c.updated_at)


def report(connection: Connection, job_id: UUID, attempt: int, percent: int, message: str) -> None:
    """Record the progress of an attempt.

    Raises:
        LostJob: the attempt is over.
    """
    _write(connection, job_id, attempt, progress=percent, message=message)


def reserve_results(connection: Connection, job_id: UUID, attempt: int, size_bytes: int) -> None:
    """Record the size of the files that an attempt is about to store.

    Raises:
        LostJob: the attempt is over.
    """
    _write(connection, job_id, attempt, results_bytes=size_bytes)


def release_results(connection: Connection, job_id: UUID, attempt: int) -> None:
    """Give back the room for the files of an attempt that is over without results."""
    connection.execute(
        update(job)
        .where(
            job.c.id == job_id,
            job.c.attempt == attempt,
            job.c.state != "running",
            job.c.results.is_(None),
            job.c.results_bytes > 0,
        )
        .values(results_bytes=0)
    )


def lost_reservations(connection: Connection) -> dict[UUID, int]:
    """Jobs that neither run nor have results and have room reserved, each with its last attempt."""
    statement = select(job.c.id, job.c.attempt).where(
        job.c.results_bytes > 0, job.c.state != "running", job.c.results.is_(None)
    )
    return {row.id: row.attempt for row in connection.execute(statement)}


def succeed(
    connection: Connection, job_id: UUID, attempt: int, results: dict[str, Any], message: str = "done"
) -> None:
    """End a job with its results; the last statement of the transaction that writes them.

    Raises:
        LostJob: the attempt is over; the transaction must be rolled back.
    """
    _write(
        connection,
        job_id,
        attempt,
        state="successful",
        progress=100,
        message=message,
        results=results,
        error=None,
        lease_until=None,
        finished_at=clock,
    )
    replace_spent_ticket(connection)


def fail(
    connection: Connection,
    job_id: UUID,
    attempt: int,
    error: dict[str, Any],
    results: dict[str, Any] | None = None,
) -> None:
    """End a job for good, with problem details for its owner, and what it made all the same.

    Raises:
        LostJob: the attempt is over.
    """
    _write(
        connection,
        job_id,
        attempt,
        state="failed",
        message=error.get("detail", error["title"]),
        error=error,
        results=results,
        lease_until=None,
        finished_at=clock,
    )
    replace_spent_ticket(connection)


def give_back(connection: Connection, job_id: UUID, attempt: int) -> None:
    """Return a job whose worker has to stop; this does not count as a failure.

    Raises:
        LostJob: the attempt is over.
    """
    _write(
        connection,
        job_id,
        attempt,
        state="accepted",
        message="waiting for a worker",
        lease_until=None,
        worker=None,
    )
    issue_ticket(connection)


def try_again(
    connection: Connection, job_id: UUID, attempt: int, delay_s: float, *, counts: bool = True
) -> None:
    """Return a job whose attempt ended without an outcome, for another attempt after a delay.

    Args:
        counts: whether the attempt counts as one of the failures that end a job.

    Raises:
        LostJob: the attempt is over.
    """
    _write(
        connection,
        job_id,
        attempt,
        state="accepted",
        failures=job.c.failures + int(counts),
        lease_until=None,
        not_before=clock + timedelta(seconds=delay_s),
        worker=None,
        message="broke off, waiting for the next attempt" if counts else "waiting for the storage",
    )
    issue_ticket(connection, connection.scalar(select(job.c.not_before).where(job.c.id == job_id)))
    replace_spent_ticket(connection)


def take_back(connection: Connection, attempts_allowed: int) -> list[UUID]:
    """Return jobs whose lease is over to the queue, or fail those that had too many attempts.

    A lost worker is no failure of the job. Rows that are being written are left to their writers.
    """
    over = (
        select(job.c.id)
        .where(job.c.state == "running", job.c.lease_until < clock)
        .with_for_update(skip_locked=True)
    )
    lapsed = every(
        Job,
        connection.execute(
            update(job)
            .where(job.c.id.in_(over))
            .values(
                lease_until=None,
                worker=None,
                state="accepted",
                message="the worker was lost, waiting for another",
                updated_at=clock,
            )
            .returning(*COLUMNS)
        ),
    )
    for lost in lapsed:
        if lost.attempt < attempts_allowed:
            issue_ticket(connection)
            continue
        detail = f"the worker was lost in the last of {lost.attempt} attempts at this job"
        error = {**LOST_WORKER, "detail": detail, "attempts": lost.attempt}
        connection.execute(
            update(job)
            .where(job.c.id == lost.id)
            .values(state="failed", message=detail, error=error, finished_at=clock, updated_at=clock)
        )
        replace_spent_ticket(connection)
    return [lost.id for lost in lapsed]


def counting_attempts(connection: Connection, job_ids: list[UUID]) -> dict[UUID, int | None]:
    """Of some jobs those that exist, with the attempt that runs or has results that are kept."""
    has_results = (job.c.state == "successful") | job.c.results.is_not(None)
    counts = job.c.results_removed_at.is_(None) & ((job.c.state == "running") | has_results)
    statement = select(job.c.id, case((counts, job.c.attempt)).label("attempt")).where(
        among(job.c.id, job_ids)
    )
    return {row.id: row.attempt for row in connection.execute(statement)}


def _write(connection: Connection, job_id: UUID, attempt: int, **values: Any) -> None:
    """Change the row of a running job if the attempt is still the one that counts."""
    written = connection.execute(
        update(job)
        .where(job.c.id == job_id, job.c.attempt == attempt, job.c.state == "running")
        .values(**{"updated_at": clock, **values})
    )
    if written.rowcount != 1:
        raise LostJob(f"attempt {attempt} of job {job_id} is over")
