"""The row of the table `installation`: its identity, and how far it has come with its storage."""

from dataclasses import dataclass
from uuid import UUID

from sqlalchemy import Select, exists, func, or_, select, update

from amers.app.db.engine import Connection
from amers.app.db.rows import columns_of, only
from amers.app.db.schema import chip_file, installation, scene


@dataclass(frozen=True)
class InstallationRow:
    """The identity of an installation.

    Attributes:
        id: named by the storage that belongs to the database.
        storage_generation: advances while the service runs; 0 before the first storage.
    """

    id: UUID
    storage_generation: int


ROW: Select[tuple[UUID, int]] = select(*columns_of(InstallationRow, installation))


def read(connection: Connection) -> InstallationRow:
    """The identity of the installation."""
    return only(InstallationRow, connection.execute(ROW))


def lock(connection: Connection) -> InstallationRow:
    """The identity of the installation, which nobody else changes until the end of the transaction."""
    return only(InstallationRow, connection.execute(ROW.with_for_update()))


def advance(connection: Connection, beyond: int = 0) -> None:
    """Advance the generation of the storage by one, and beyond a given one."""
    generation = func.greatest(installation.c.storage_generation, beyond) + 1
    connection.execute(update(installation).values(storage_generation=generation))


def names_files(connection: Connection) -> bool:
    """Whether a row names a file in the storage."""
    image = exists(scene.c.id).where(scene.c.file_key.is_not(None))
    return bool(connection.scalar(select(or_(exists(chip_file.c.id), image))))
