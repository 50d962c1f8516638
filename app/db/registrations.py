"""The table `registration`: scenes that were registered, with their reports."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any
from uuid import UUID, uuid4

from psycopg.rows import class_row
from psycopg.types.json import Jsonb

from app.db.engine import Connection

COLUMNS = "id, job_id, scene_id, block_versions, options, report, verdict, files, created_at"


@dataclass(frozen=True)
class RegistrationRow:
    """A registered scene.

    Attributes:
        job_id: the job that did it; a job registers once.
        block_versions: id and version of every block whose points were used.
        options: of the registration.
        report: as `report.json` has it.
        files: name to key in the storage.
    """

    id: UUID
    job_id: UUID | None
    scene_id: UUID | None
    block_versions: list[dict[str, Any]]
    options: dict[str, Any]
    report: dict[str, Any]
    verdict: str
    files: dict[str, str]
    created_at: datetime


def insert_registration(
    connection: Connection,
    *,
    job_id: UUID | None,
    scene_id: UUID | None,
    block_versions: list[dict[str, Any]],
    options: dict[str, Any],
    report: dict[str, Any],
    verdict: str,
    files: dict[str, str],
) -> UUID:
    """Store what a registration found."""
    registration_id = uuid4()
    connection.execute(
        "insert into registration"
        " (id, job_id, scene_id, block_versions, options, report, verdict, files)"
        " values (%s, %s, %s, %s, %s, %s, %s, %s)",
        [
            registration_id,
            job_id,
            scene_id,
            Jsonb(block_versions),
            Jsonb(options),
            Jsonb(report),
            verdict,
            Jsonb(files),
        ],
    )
    return registration_id


def claim_scene(connection: Connection, registration_id: UUID, scene_key: str) -> bool:
    """Let a registration speak for its scene; False when an earlier one does."""
    connection.execute("select pg_advisory_xact_lock(hashtextextended(%s, 0))", [scene_key])
    done = connection.execute(
        """update registration set scene_key = %(key)s, counted = true where id = %(id)s
           and not exists (select from registration where scene_key = %(key)s and counted)""",
        {"key": scene_key, "id": registration_id},
    )
    return done.rowcount == 1


def find_by_job(connection: Connection, job_id: UUID) -> RegistrationRow | None:
    """The registration a job made."""
    with connection.cursor(row_factory=class_row(RegistrationRow)) as cursor:
        return cursor.execute(
            f"select {COLUMNS} from registration where job_id = %s", [job_id]
        ).fetchone()
