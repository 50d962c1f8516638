"""The table `audit`: changes of tokens, blocks, scenes, jobs and points, written by the database.

The kind `audit` is the removal of its oldest rows.
"""

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal
from uuid import UUID

from sqlalchemy import select

from app.db.engine import Connection
from app.db.rows import columns_of, every
from app.db.schema import audit

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


def list_changes(
    connection: Connection, limit: int, before: int | None, kind: str | None, subject: str | None
) -> list[Change]:
    """Changes, the newest first.

    Args:
        before: changes with smaller ids only.
        kind, subject: None for all.
    """
    statement = select(*COLUMNS).order_by(audit.c.id.desc()).limit(limit)
    if before is not None:
        statement = statement.where(audit.c.id < before)
    if kind is not None:
        statement = statement.where(audit.c.kind == kind)
    if subject is not None:
        statement = statement.where(audit.c.subject == subject)
    return every(Change, connection.execute(statement))
