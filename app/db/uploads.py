"""The table `upload`: files that arrive in pieces, into the scratch folder of the storage."""

from dataclasses import dataclass
from datetime import datetime
from typing import Literal
from uuid import UUID, uuid4

from psycopg.rows import class_row, scalar_row

from app.db.engine import Connection

Purpose = Literal["image", "model", "block"]

LIFE_HOURS = 24
"""An upload is given up so long after its last piece."""
IDLE = f"(expires_at < now() and active_at_uptime_s < uptime_s() - {3600 * LIFE_HOURS})"
"""Nobody went on with it, by the clock and by the time that the service has run."""
COLUMNS = f"""id, owner, purpose, scene_id, name, file_name, size_bytes, sha256, metadata, file_key,
    created_at, expires_at, finished_at, {IDLE} and finished_at is null as expired"""


@dataclass(frozen=True)
class UploadRow:
    """A file that arrives in pieces.

    Attributes:
        scene_id: whose image or model it is; None for a block.
        name, file_name: as the sender calls it, and as the storage does.
        size_bytes, sha256: of the whole, as announced; no checksum if none was.
        metadata: as sent, to be repeated.
        file_key: where it lies once it is complete and is nobody else's: a block.
    """

    id: UUID
    owner: UUID | None
    purpose: Purpose
    scene_id: UUID | None
    name: str
    file_name: str
    size_bytes: int
    sha256: str | None
    metadata: str
    file_key: str | None
    created_at: datetime
    expires_at: datetime
    finished_at: datetime | None
    expired: bool


def insert_upload(
    connection: Connection,
    *,
    owner: UUID,
    purpose: Purpose,
    scene_id: UUID | None,
    name: str,
    file_name: str,
    size_bytes: int,
    sha256: str | None,
    metadata: str,
) -> UploadRow:
    """A file that is about to arrive."""
    with connection.cursor(row_factory=class_row(UploadRow)) as cursor:
        row = cursor.execute(
            f"""insert into upload (id, owner, purpose, scene_id, name, file_name, size_bytes, sha256,
                    metadata, expires_at)
                values (%s, %s, %s, %s, %s, %s, %s, %s, %s, now() + make_interval(hours => %s))
                returning {COLUMNS}""",
            (uuid4(), owner, purpose, scene_id, name, file_name, size_bytes, sha256, metadata)
            + (LIFE_HOURS,),
        ).fetchone()
    assert row is not None
    return row


def find_upload(connection: Connection, upload_id: UUID) -> UploadRow | None:
    """The upload with that id."""
    with connection.cursor(row_factory=class_row(UploadRow)) as cursor:
        return cursor.execute(f"select {COLUMNS} from upload where id = %s", [upload_id]).fetchone()


def prolong(connection: Connection, upload_id: UUID) -> UploadRow | None:
    """The upload, whose life begins anew; None when it has been given up."""
    with connection.cursor(row_factory=class_row(UploadRow)) as cursor:
        return cursor.execute(
            f"""update upload set expires_at = now() + make_interval(hours => %s),
                    active_at_uptime_s = uptime_s()
                where id = %s returning {COLUMNS}""",
            [LIFE_HOURS, upload_id],
        ).fetchone()


def finish(
    connection: Connection,
    upload_id: UUID,
    file_key: str | None = None,
    size_bytes: int | None = None,
    sha256: str | None = None,
) -> bool:
    """Note that the file is complete and in its place; False when it was given up meanwhile.

    Args:
        file_key: where it lies when it is nobody else's.
        size_bytes, sha256: as found, where they had not been announced.
    """
    done = connection.execute(
        """update upload set finished_at = now(), file_key = %s, size_bytes = coalesce(%s, size_bytes),
               sha256 = coalesce(%s, sha256)
           where id = %s and finished_at is null""",
        [file_key, size_bytes, sha256, upload_id],
    )
    return done.rowcount == 1


def delete_upload(connection: Connection, upload_id: UUID) -> None:
    """Forget an upload."""
    connection.execute("delete from upload where id = %s", [upload_id])


def delete_expired(connection: Connection) -> list[UUID]:
    """Forget the uploads that nobody went on with."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        expired: list[UUID] = cursor.execute(
            f"delete from upload where finished_at is null and {IDLE} returning id"
        ).fetchall()
    return expired


def find_block(connection: Connection, upload_id: UUID) -> str | None:
    """Where the storage has the archive of a block that has arrived."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        found: str | None = cursor.execute(
            "select file_key from upload where id = %s and purpose = 'block'", [upload_id]
        ).fetchone()
    return found


def delete_unwanted_blocks(connection: Connection) -> list[str]:
    """Forget archives that nobody asked for in time and no open job names; returns their keys."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        keys: list[str] = cursor.execute(
            f"""delete from upload u where purpose = 'block' and finished_at is not null
                   and {IDLE}
                   and not exists (select from job where state in ('accepted', 'running')
                                   and inputs ->> 'upload' = u.id::text)
               returning file_key"""
        ).fetchall()
    return keys


def present(connection: Connection, upload_ids: list[UUID]) -> set[UUID]:
    """Those of some uploads that are not forgotten."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        return set(cursor.execute("select id from upload where id = any(%s)", [upload_ids]))


def arriving(connection: Connection, upload_ids: list[UUID]) -> set[UUID]:
    """Those of some uploads that are still to be completed."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        return set(
            cursor.execute(
                "select id from upload where id = any(%s) and finished_at is null", [upload_ids]
            )
        )
