"""Progress of jobs: their messages, how many come before, when they may end."""

from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from sqlalchemy import func, select, tuple_

from app.db.engine import Connection
from app.db.jobs.jobs import OPEN, Job
from app.db.rows import columns_of, every
from app.db.schema import job, job_message
from app.db.statements import named

PAST_JOBS = 20
"""The expected duration of a process is the median of so many last successes."""
BEATING_S = 30
"""A worker of the queue gives a sign of life every ten seconds; one silent for longer does not count."""

EXPECTED_END = named("jobs.sql", "expected_end")


@dataclass(frozen=True)
class JobMessage:
    """A message of a job.

    Attributes:
        attempt: that wrote it; 0 before the first.
        progress: percent.
    """

    at: datetime
    attempt: int
    progress: int
    message: str


MESSAGE_COLUMNS = columns_of(JobMessage, job_message, at=job_message.c.written_at)


def read_messages(connection: Connection, job_id: UUID, limit: int) -> list[JobMessage]:
    """The last messages of a job, the oldest of them first."""
    newest_first = (
        select(*MESSAGE_COLUMNS)
        .where(job_message.c.job_id == job_id)
        .order_by(job_message.c.id.desc())
        .limit(limit)
    )
    return every(JobMessage, connection.execute(newest_first))[::-1]


def position(connection: Connection, waiting: Job) -> int:
    """How many waiting jobs are as old as a job or older, itself included."""
    count = connection.scalar(
        select(func.count())
        .select_from(job)
        .where(
            job.c.state == "accepted",
            tuple_(job.c.created_at, job.c.id) <= tuple_(waiting.created_at, waiting.id),
        )
    )
    return max(int(count or 0), 1)


def expected_end(connection: Connection, open_job: Job) -> datetime | None:
    """When an open job may end: past jobs' median durations, shared by the workers that are alive.

    Returns:
        None when no job of its process has succeeded yet, or the job has ended.
    """
    if open_job.state not in OPEN:
        return None
    end: datetime | None = connection.scalar(
        EXPECTED_END,
        {
            "past": PAST_JOBS,
            "kind": open_job.kind,
            "created_at": open_job.created_at,
            "id": open_job.id,
            "beating_s": BEATING_S,
            "claimed_at": open_job.claimed_at if open_job.state == "running" else None,
        },
    )
    return end
