"""The table `audit`: changes of tokens, blocks, scenes, jobs and points, written by the database.

The kind `audit` is the removal of its oldest rows.
"""

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal
from uuid import UUID

from sqlalchemy import select

from amers.app.db.engine import Connection
from amers.app.db.rows import columns_of, every
from amers.app.db.schema import audit
from amers.app.db.statements import named

REMOVE_OLD = named("audit.sql", "remove_old")
MOST_REMOVED = 100_000
"""Largest number of changes that one sweep removes."""
KINDS = ("token", "block", "scene", "job", "point", "reference_image", "audit")


@dataclass(frozen=True)
class Change:
    """One row of the record.

    Attributes:
        actor: id of the token of the caller, else of the owner of the job.
        actor_name: of the caller, or who ran the command.
        request_id, job_id: the request or job that made the change; None for neither.
        kind: table.
        subject: id of the row; ID@VERSION of a block.
        before, after: recorded columns of the row; None where it did not exist.
    """

    id: int
    at: datetime
    actor: UUID | None
    actor_name: str
    request_id: str | None
    job_id: UUID | None
    kind: str
    subject: str
    action: Literal["created", "changed", "deleted"]
    before: dict[str, Any] | None
    after: dict[str, Any] | None


COLUMNS = columns_of(Change, audit)


def remove_old(connection: Connection, older_than_s: float) -> int:
    """Remove the oldest changes, up to the first one that is younger; returns how many.

    The trigger `audit_removal` checks the range and leaves a row about it. Nothing is removed before the
    oldest change exceeds its age by a day, so that there is one such row a day.
    """
    removed = connection.execute(REMOVE_OLD, {"older_than_s": older_than_s, "most": MOST_REMOVED})
    return int(removed.scalar_one())


def list_changes(
    connection: Connection,
    limit: int,
    before: int | None,
    kind: str | None,
    subject: str | None,
    *,
    actor: str | None = None,
) -> list[Change]:
    """Changes, the newest first.

    Args:
        before: changes with smaller ids only.
        kind, subject, actor: None for all; an actor is a name.
    """
    statement = select(*COLUMNS).order_by(audit.c.id.desc()).limit(limit)
    if before is not None:
        statement = statement.where(audit.c.id < before)
    if kind is not None:
        statement = statement.where(audit.c.kind == kind)
    if subject is not None:
        statement = statement.where(audit.c.subject == subject)
    if actor is not None:
        statement = statement.where(audit.c.actor_name == actor)
    return every(Change, connection.execute(statement))
