"""The queue: its entries are tickets. A ticket calls a worker, who then claims the job that is next.

There is a ticket for each waiting job, but no ticket belongs to a job: the order of jobs is that of
`attempts.claim_next`. A ticket whose claim finds nothing is spent: all waiting jobs may belong to owners
who have as many running jobs as they may. The end of a job therefore issues a ticket if there are fewer
tickets than waiting jobs.
"""

from datetime import datetime
from functools import cache
from typing import TYPE_CHECKING

from sqlalchemy import func, select

from amers.app.db.engine import Connection, driver
from amers.app.db.statements import named

if TYPE_CHECKING:
    import procrastinate

QUEUE = "amers"
TASK = "amers:job"
SWEEP_LOCK = 0x414D4552
"""Advisory lock that keeps two workers from sweeping at once."""

CLAIM_LOCK = 0x414D4558
"""Advisory lock of claims, and of whoever counts tickets: a claim sees all jobs that ended before it."""
TICKETS_PER_SWEEP = 16
"""Most tickets that one sweep replaces: the first jobs that end replace the others."""

MANY_TICKETS = 256
"""Tickets beside which a spent one is not missed yet: more than workers that claim at once."""

FEW_TICKETS = named("jobs.sql", "few_tickets")
MISSING_TICKETS = named("jobs.sql", "missing_tickets")
PRUNE_SILENT_WORKERS = named("jobs.sql", "prune_silent_workers")
DELETE_DEAD_ENTRIES = named("jobs.sql", "delete_dead_entries")


def issue_ticket(connection: Connection, not_before: datetime | None = None) -> None:
    """Call a worker for one job, in the transaction that makes the job wait.

    Args:
        not_before: of the job, by the clock of the database; None for now.
    """
    _queue().configure_task(
        TASK, queue=QUEUE, schedule_at=not_before, connection=driver(connection)
    ).defer()


def lock_claims(connection: Connection) -> None:
    """Let other claims, and other counts of tickets, wait until the end of the transaction."""
    connection.execute(select(func.pg_advisory_xact_lock(CLAIM_LOCK)))


def replace_spent_ticket(connection: Connection) -> None:
    """Issue a ticket if there are fewer than waiting jobs; the last step of whatever ends a job.

    The owner of the job may now have another one claimed, whose ticket may have been spent. Nothing is
    counted while many tickets are left: that would take the longer, the more jobs wait, and claims wait
    for it. The ends of later jobs replace what is missing then.
    """
    if not connection.scalar(FEW_TICKETS, {"task": TASK, "many": MANY_TICKETS}):
        return
    lock_claims(connection)
    if _missing_tickets(connection, 0.0, None):
        issue_ticket(connection)


def replace_lost_tickets(connection: Connection, after_s: float, running_limit: int | None) -> int:
    """The number of tickets issued for jobs that wait without one, for instance after a restore.

    Args:
        after_s: time since the last change of the jobs to count.
        running_limit: most running jobs of one owner; None: no limit.
    """
    missing = min(_missing_tickets(connection, after_s, running_limit), TICKETS_PER_SWEEP)
    for _ in range(missing):
        issue_ticket(connection)
    return missing


def forget_dead_entries(connection: Connection, silent_s: float) -> None:
    """Delete the queue entries of dead workers; the jobs themselves are taken back."""
    connection.execute(PRUNE_SILENT_WORKERS, {"silent_s": silent_s})
    connection.execute(DELETE_DEAD_ENTRIES, {"task": TASK})


def may_sweep(connection: Connection) -> bool:
    """Whether nobody else sweeps; true until the end of the transaction."""
    return bool(connection.scalar(select(func.pg_try_advisory_xact_lock(SWEEP_LOCK))))


def _missing_tickets(connection: Connection, after_s: float, running_limit: int | None) -> int:
    values = {"after_s": after_s, "running_limit": running_limit, "task": TASK}
    return int(connection.scalar(MISSING_TICKETS, values) or 0)


@cache
def _queue() -> "procrastinate.App":
    """Writes queue entries through the connection of the caller's transaction; it is never opened."""
    # Imported by the first job: readers of the store start without it.
    import procrastinate

    return procrastinate.App(connector=procrastinate.SyncPsycopgConnector())
