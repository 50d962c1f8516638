"""The course of jobs: what they said on their way, how many come before, when they may end."""

from dataclasses import dataclass
from datetime import datetime
from uuid import UUID

from psycopg.rows import class_row, scalar_row

from app.db.engine import Connection
from app.db.jobs.jobs import Job

PAST_JOBS = 20
"""The last successes of a process whose median duration is expected of the next."""
BEATING_S = 30
"""A worker of the queue beats every ten seconds; one silent for longer is not counted on."""


@dataclass(frozen=True)
class JobMessage:
    """Something a job said.

    Attributes:
        attempt: that said it; 0 before the first.
        progress: percent.
    """

    at: datetime
    attempt: int
    progress: int
    message: str


def read_messages(connection: Connection, job_id: UUID, limit: int) -> list[JobMessage]:
    """The last messages of a job, the oldest of them first."""
    with connection.cursor(row_factory=class_row(JobMessage)) as cursor:
        return cursor.execute(
            """select at, attempt, progress, message
               from (select id, written_at as at, attempt, progress, message from job_message
                     where job_id = %s order by id desc limit %s) last
               order by id""",
            [job_id, limit],
        ).fetchall()


def position(connection: Connection, job: Job) -> int:
    """How many waiting jobs are as old as a job or older, itself among them."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        cursor.execute(
            "select count(*) from job where state = 'accepted' and (created_at, id) <= (%s, %s)",
            [job.created_at, job.id],
        )
        found = cursor.fetchone()
    return max(int(found or 0), 1)


def expected_end(connection: Connection, job: Job) -> datetime | None:
    """When an open job may end: past jobs' median durations, shared by the workers that beat.

    Returns:
        None when no job of its process has succeeded yet, or the job has ended.
    """
    if job.state not in ("accepted", "running"):
        return None
    with connection.cursor(row_factory=scalar_row) as cursor:
        end: datetime | None = cursor.execute(
            """with typical as (
                   select kind, (select percentile_cont(0.5) within group (order by seconds)
                                 from (select extract(epoch from finished_at - claimed_at) as seconds
                                       from job p where p.kind = k.kind and state = 'successful'
                                       order by finished_at desc limit %(past)s) past) as seconds
                   from (select distinct kind from job where state in ('accepted', 'running')) k
               ), own as (select seconds from typical where kind = %(kind)s
               ), before as (
                   select sum(case state when 'accepted' then t.seconds
                       else greatest(t.seconds - extract(epoch from clock_timestamp() - claimed_at), 0)
                       end) as seconds
                   from job join typical t using (kind)
                   where state = 'running'
                      or (state = 'accepted' and (created_at, id) < (%(created)s, %(id)s))
               ), workers as (
                   select greatest(count(*), 1) as n from procrastinate_workers
                   where last_heartbeat > clock_timestamp() - make_interval(secs => %(beating)s)
               )
               select case when %(claimed)s::timestamptz is null
                   then clock_timestamp() + make_interval(
                       secs => coalesce(before.seconds, 0) / workers.n + own.seconds)
                   else greatest(clock_timestamp(),
                                 %(claimed)s::timestamptz + make_interval(secs => own.seconds))
                   end
               from own, before, workers where own.seconds is not null""",
            {
                "past": PAST_JOBS,
                "kind": job.kind,
                "created": job.created_at,
                "id": job.id,
                "beating": BEATING_S,
                "claimed": job.claimed_at if job.state == "running" else None,
            },
        ).fetchone()
    return end
