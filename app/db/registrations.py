"""The table `registration`: scenes that were registered, with their reports."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any
from uuid import UUID, uuid4

from sqlalchemy import exists, func, insert, select, update

from amers.app.db.engine import Connection
from amers.app.db.rows import columns_of, every, first
from amers.app.db.schema import registration


@dataclass(frozen=True)
class RegistrationRow:
    """A registered scene.

    Attributes:
        job_id: the job that made it; a job registers one scene or several, each once.
        block_versions: id and version of every block whose points were used.
        report: the content of `report.json`.
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


COLUMNS = columns_of(RegistrationRow, registration)


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
    """Store a registration; returns its id."""
    registration_id = uuid4()
    connection.execute(
        insert(registration).values(
            id=registration_id,
            job_id=job_id,
            scene_id=scene_id,
            block_versions=block_versions,
            options=options,
            report=report,
            verdict=verdict,
            files=files,
        )
    )
    return registration_id


def claim_scene(connection: Connection, registration_id: UUID, scene_key: str) -> bool:
    """Count a registration as the one of its scene; False when an earlier one counts."""
    connection.execute(select(func.pg_advisory_xact_lock(func.hashtextextended(scene_key, 0))))
    earlier = registration.alias("earlier")
    counted = exists(earlier.c.id).where(earlier.c.scene_key == scene_key, earlier.c.counted)
    claimed = connection.execute(
        update(registration)
        .where(registration.c.id == registration_id, ~counted)
        .values(scene_key=scene_key, counted=True)
    )
    return claimed.rowcount == 1


def find_of_job(connection: Connection, job_id: UUID) -> list[RegistrationRow]:
    """The registrations that a job made, one for each scene that it registered."""
    of_job = registration.c.job_id == job_id
    statement = select(*COLUMNS).where(of_job).order_by(registration.c.scene_id)
    return every(RegistrationRow, connection.execute(statement))


def find_of_scene(connection: Connection, job_id: UUID, scene_id: UUID) -> RegistrationRow | None:
    """The registration that a job made of a scene."""
    of_both = (registration.c.job_id == job_id, registration.c.scene_id == scene_id)
    return first(RegistrationRow, connection.execute(select(*COLUMNS).where(*of_both)))


def find_counted(connection: Connection, scene_key: str) -> RegistrationRow | None:
    """The registration that counts for a scene; None when none does."""
    counts = (registration.c.scene_key == scene_key, registration.c.counted)
    return first(RegistrationRow, connection.execute(select(*COLUMNS).where(*counts)))
