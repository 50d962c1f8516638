"""The table `audit`: changes of tokens, blocks, scenes, jobs and points, written by the database."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal
from uuid import UUID

from psycopg.rows import class_row

from app.db.engine import Connection

KINDS = ("token", "block", "scene", "job", "point", "reference_image")


@dataclass(frozen=True)
class Change:
    """One row of the record.

    Attributes:
        actor: id of the token behind it: that of the caller, else that of the owner of the job.
        actor_name: of the caller, or who ran the command.
        request_id, job_id: what it was done for, None when for neither.
        kind: table.
        subject: id of the row; ID@VERSION of a block.
        before, after: what is recorded of the row; None where it did not exist.
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


def list_changes(
    connection: Connection, limit: int, before: int | None, kind: str | None, subject: str | None
) -> list[Change]:
    """Changes, the newest first.

    Args:
        before: changes with smaller ids only.
        kind, subject: None for all.
    """
    with connection.cursor(row_factory=class_row(Change)) as cursor:
        return cursor.execute(
            """select a.id, a.at, coalesce(a.actor, j.owner) as actor, a.actor_name, a.request_id,
                   a.job_id, a.kind, a.subject, a.action, a.before, a.after
               from audit a left join job j on j.id = a.job_id
               where (%(before)s::bigint is null or a.id < %(before)s)
                   and (%(kind)s::text is null or a.kind = %(kind)s)
                   and (%(subject)s::text is null or a.subject = %(subject)s)
               order by a.id desc limit %(limit)s""",
            {"limit": limit, "before": before, "kind": kind, "subject": subject},
        ).fetchall()
