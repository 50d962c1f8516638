"""Progress of jobs: their messages, how many come before, when they may end."""

from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from sqlalchemy import select

from amers.app.db.engine import Connection
from amers.app.db.rows import columns_of, every, first, only
from amers.app.db.schema import job_message
from amers.app.db.statements import named

PAST_JOBS = 20
"""The expected duration of a process is the median of so many last successes."""
BEATING_S = 30
"""A worker of the queue gives a sign of life every ten seconds; one silent for longer does not count."""

COUNT_WORKERS = named("jobs.sql", "count_workers")
MOVEMENT = named("jobs.sql", "movement")
OUTLOOK = named("jobs.sql", "outlook")


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


@dataclass(frozen=True)
class Outlook:
    """What the owner of an open job waits for.

    Attributes:
        position: of a waiting job, 1 for the next one, as if all owners had as many running jobs.
        expected_end: from the median durations of past jobs, shared by the workers that are alive; None
            when no job of this process has succeeded yet, or the job has ended.
    """

    position: int | None
    expected_end: datetime | None


@dataclass(frozen=True)
class Movement:
    """Whether running jobs and the queue go on.

    Attributes:
        workers: that are alive.
        running: number of running jobs.
        silent_job, silent_s: the running job that has reported nothing for the longest time.
        claimable: number of waiting jobs that a worker may claim.
        first_job: of these, the one that has waited for the longest time.
        still_s: for how long that job waits while no job was claimed and none ended; 0 without.
    """

    workers: int
    running: int
    silent_job: UUID | None
    silent_s: float
    claimable: int
    first_job: UUID | None
    still_s: float


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


def outlook(connection: Connection, job_id: UUID) -> Outlook:
    """The place of a job in the queue and its expected end."""
    values = {"id": job_id, "past": PAST_JOBS, "beating_s": BEATING_S, "nobody": UUID(int=0)}
    return first(Outlook, connection.execute(OUTLOOK, values)) or Outlook(None, None)


def count_workers(connection: Connection) -> int:
    """The number of workers that are alive."""
    return int(connection.scalar(COUNT_WORKERS, {"beating_s": BEATING_S}) or 0)


def movement(connection: Connection, running_limit: int | None) -> Movement:
    """Whether running jobs and the queue go on.

    Args:
        running_limit: most running jobs of one owner; None: no limit.
    """
    values = {"running_limit": running_limit, "beating_s": BEATING_S}
    return only(Movement, connection.execute(MOVEMENT, values))
