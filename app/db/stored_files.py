"""Files of the storage as rows name them: their checksums, and which of them are damaged."""

from dataclasses import dataclass
from uuid import UUID

import numpy as np
from sqlalchemy import delete, select, update
from sqlalchemy.dialects.postgresql import insert

from amers.app.db.blocks import ID_BITS
from amers.app.db.engine import Connection
from amers.app.db.rows import every
from amers.app.db.schema import chip_file, clock, damaged_file, result_file, upload
from amers.app.db.statements import named

NAMED_FILES = named("stored_files.sql", "named_files")
FOLDERS_IN_PROGRESS = named("stored_files.sql", "folders_in_progress")
POINTS_OF_CHIPS = named("stored_files.sql", "points_of_chips")


@dataclass(frozen=True)
class NamedFile:
    """A file that a row names.

    Attributes:
        storage_key: of the file; of a reference, its path below AMERS_REFERENCE_FOLDER.
        kind: chips, scene image, side file, upload archive, result or reference.
        size_bytes: None if unknown; of a file of chips without its header.
        sha256: in hexadecimal; None if unknown.
    """

    storage_key: str
    kind: str
    size_bytes: int | None
    sha256: str | None


def read_named_files(connection: Connection, keys: list[str] | None = None) -> list[NamedFile]:
    """The files that rows refer to, by key; with `keys`, only files among these."""
    return every(NamedFile, connection.execute(NAMED_FILES, {"keys": keys}))


def folders_in_progress(connection: Connection) -> set[str]:
    """The folders of the storage that files are being written into."""
    return set(connection.scalars(FOLDERS_IN_PROGRESS))


def find_chip_checksums(connection: Connection, storage_key: str) -> bytes | None:
    """The checksums of the chips of a file; None if they are not recorded."""
    statement = select(chip_file.c.chip_checksums).where(
        chip_file.c.storage_key == storage_key, chip_file.c.chip_checksums.is_not(None)
    )
    checksums: bytes | None = connection.scalar(statement.limit(1))
    return checksums


def record_chip_checksums(connection: Connection, storage_key: str, checksums: bytes) -> None:
    """Record the checksums of the chips of a file."""
    of_file = chip_file.c.storage_key == storage_key
    connection.execute(update(chip_file).where(of_file).values(chip_checksums=checksums))


def record_upload_checksum(connection: Connection, storage_key: str, sha256: str) -> None:
    """Record the checksum of an uploaded archive."""
    of_file = upload.c.file_key == storage_key
    connection.execute(update(upload).where(of_file).values(sha256=sha256))


def record_result(
    connection: Connection, job_id: UUID, storage_key: str, size_bytes: int, sha256: str
) -> None:
    """Record size and checksum of a file of the results of a job."""
    values = {"size_bytes": size_bytes, "sha256": sha256}
    statement = insert(result_file).values(storage_key=storage_key, job_id=job_id, **values)
    connection.execute(
        statement.on_conflict_do_update(index_elements=[result_file.c.storage_key], set_=values)
    )


def points_of_chips(connection: Connection, storage_key: str, rows: list[int] | None) -> list[int]:
    """Ids of the points with chips in some rows, in ascending order, of a file; None means all rows."""
    found = connection.execute(POINTS_OF_CHIPS, {"storage_key": storage_key, "id_bits": ID_BITS}).all()
    points = np.array([tuple(point) for point in found], dtype=np.int64).reshape(-1, 3)
    if rows is None:
        return [int(point) for point in points[:, 0]]
    n_before, n_until = np.searchsorted(rows, [points[:, 1], points[:, 1] + points[:, 2]])
    return [int(point) for point in points[n_until > n_before, 0]]


def record_damage(connection: Connection, storage_key: str, reason: str) -> None:
    """Record that a file was found damaged or missing."""
    statement = insert(damaged_file).values(storage_key=storage_key, reason=reason)
    connection.execute(
        statement.on_conflict_do_update(
            index_elements=[damaged_file.c.storage_key],
            set_={"reason": reason, "last_found_at": clock},
        )
    )


def forget_damage(connection: Connection, storage_key: str) -> None:
    """Forget the damage of a file that is whole again."""
    connection.execute(delete(damaged_file).where(damaged_file.c.storage_key == storage_key))


def forget_unnamed_damage(connection: Connection, named_keys: list[str]) -> None:
    """Forget the damage of files that no row names any more."""
    connection.execute(delete(damaged_file).where(damaged_file.c.storage_key.not_in(named_keys)))
