"""The table `upload`: files that arrive in pieces, into the scratch folder of the storage."""

from dataclasses import asdict, dataclass
from datetime import datetime
from uuid import UUID, uuid4

from sqlalchemy import Text, and_, cast, delete, exists, func, insert, select, update

from amers.app.db.engine import Connection
from amers.app.db.rows import among, columns_of, first, only
from amers.app.db.schema import UploadPurpose, hours, job, now, upload, uptime_s

LIFE_HOURS = 24
"""An upload is given up so long after its last piece."""
IDLE = and_(upload.c.expires_at < now, upload.c.active_at_uptime_s < uptime_s - 3600 * LIFE_HOURS)
"""Nobody continued the upload, neither by the clock nor by the time that the service has run."""


@dataclass(frozen=True)
class AnnouncedFile:
    """What the sender of an upload announces.

    Attributes:
        scene_id: the scene of an image or model; None for a block.
        name, file_name: the sender's name, and that in the storage.
        size_bytes, sha256: of the whole file; None without a checksum.
        metadata: as sent; replies repeat it.
    """

    owner: UUID | None
    purpose: UploadPurpose
    scene_id: UUID | None
    name: str
    file_name: str
    size_bytes: int
    sha256: str | None
    metadata: str


@dataclass(frozen=True)
class UploadRow(AnnouncedFile):
    """A file that arrives in pieces.

    Attributes:
        file_key: of a complete archive of a block in the storage.
        expired: nobody continued the upload for too long.
    """

    id: UUID
    file_key: str | None
    created_at: datetime
    expires_at: datetime
    finished_at: datetime | None
    expired: bool


COLUMNS = columns_of(UploadRow, upload, expired=and_(IDLE, upload.c.finished_at.is_(None)))


def insert_upload(connection: Connection, announced: AnnouncedFile) -> UploadRow:
    """A new upload of which no piece has arrived."""
    statement = (
        insert(upload)
        .values(id=uuid4(), **asdict(announced), expires_at=now + hours(LIFE_HOURS))
        .returning(*COLUMNS)
    )
    return only(UploadRow, connection.execute(statement))


def find_upload(connection: Connection, upload_id: UUID) -> UploadRow | None:
    """The upload with that id."""
    return first(UploadRow, connection.execute(select(*COLUMNS).where(upload.c.id == upload_id)))


def prolong(connection: Connection, upload_id: UUID) -> UploadRow | None:
    """The upload with a new expiry; None when it was given up."""
    statement = (
        update(upload)
        .where(upload.c.id == upload_id)
        .values(expires_at=now + hours(LIFE_HOURS), active_at_uptime_s=uptime_s)
        .returning(*COLUMNS)
    )
    return first(UploadRow, connection.execute(statement))


def finish(
    connection: Connection,
    upload_id: UUID,
    file_key: str | None = None,
    size_bytes: int | None = None,
    sha256: str | None = None,
) -> bool:
    """Record that the file is complete and in its place; False when it was given up meanwhile.

    Args:
        file_key: where a block lies.
        size_bytes, sha256: of the complete file, where they were not announced.
    """
    finished = connection.execute(
        update(upload)
        .where(upload.c.id == upload_id, upload.c.finished_at.is_(None))
        .values(
            finished_at=now,
            file_key=file_key,
            size_bytes=func.coalesce(size_bytes, upload.c.size_bytes),
            sha256=func.coalesce(sha256, upload.c.sha256),
        )
    )
    return finished.rowcount == 1


def delete_upload(connection: Connection, upload_id: UUID) -> None:
    """Delete an upload."""
    connection.execute(delete(upload).where(upload.c.id == upload_id))


def delete_expired(connection: Connection) -> list[UUID]:
    """Delete the unfinished uploads that nobody continued; returns their ids."""
    expired = delete(upload).where(upload.c.finished_at.is_(None), IDLE).returning(upload.c.id)
    return list(connection.scalars(expired))


def find_block(connection: Connection, upload_id: UUID) -> str | None:
    """The key in the storage of an uploaded block."""
    statement = select(upload.c.file_key).where(upload.c.id == upload_id, upload.c.purpose == "block")
    key: str | None = connection.scalar(statement)
    return key


def delete_unwanted_blocks(connection: Connection) -> list[str]:
    """Delete uploaded blocks that nobody ingested in time and no open job names; returns their keys."""
    named_by_job = exists(job.c.id).where(
        job.c.state.in_(("accepted", "running")),
        job.c.inputs["upload"].astext == cast(upload.c.id, Text),
    )
    unwanted = (
        delete(upload)
        .where(
            upload.c.purpose == "block",
            upload.c.finished_at.is_not(None),
            IDLE,
            ~named_by_job.correlate(upload),
        )
        .returning(upload.c.file_key)
    )
    return list(connection.scalars(unwanted))


def present(connection: Connection, upload_ids: list[UUID]) -> set[UUID]:
    """Those of some uploads that were not deleted."""
    return set(connection.scalars(select(upload.c.id).where(among(upload.c.id, upload_ids))))


def arriving(connection: Connection, upload_ids: list[UUID]) -> set[UUID]:
    """Those of some uploads that are not complete."""
    statement = select(upload.c.id).where(among(upload.c.id, upload_ids), upload.c.finished_at.is_(None))
    return set(connection.scalars(statement))
