"""Damage of stored files that is met while they are used: name the file, and alarm the operator."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from amers.app.db import stored_files
from amers.app.db.engine import Database
from amers.app.errors import DamagedFile, InputError, NotFound
from amers.app.storage import Storage, StoredChips
from amers.app.storage.content import read_content

log = logging.getLogger(__name__)


def open_chips(database: Database, storage: Storage) -> StoredChips:
    """The chips of the store, checked against their recorded checksums."""

    def find_checksums(key: str) -> bytes | None:
        with database.reading() as connection:
            return stored_files.find_chip_checksums(connection, key)

    return StoredChips(storage, find_checksums)


def report_damage(database: Database, damage: DamagedFile) -> bool:
    """Record a damage and log it as an error; False if no row names the file any more.

    A file that was removed while it was being read is no damage.
    """
    with database.transaction() as connection:
        if not stored_files.read_named_files(connection, [damage.key]):
            return False
        stored_files.record_damage(connection, damage.key, damage.reason)
    log.error("damaged file %s: %s", damage.key, damage.reason)
    return True


@contextmanager
def named_by_row(key: str) -> Iterator[None]:
    """Open a file that a row names: a missing one is damage, not an error of the caller.

    Raises:
        DamagedFile: the file is missing.
    """
    try:
        yield
    except NotFound as error:
        raise DamagedFile(key, "missing from the storage") from error


@contextmanager
def suspecting_damage(database: Database, storage: Storage, keys: list[str]) -> Iterator[None]:
    """Use the content of stored files: content that cannot be used may be damage.

    The files are read and compared with their checksums only if their content cannot be used.

    Raises:
        DamagedFile: the content of a file changed since it was stored.
    """
    try:
        yield
    except InputError as error:
        with database.reading() as connection:
            named = stored_files.read_named_files(connection, keys)
        for file in named:
            if file.sha256 is not None and sha256_of(storage, file.storage_key) != file.sha256:
                reason = f"its SHA-256 is not {file.sha256}"
                raise DamagedFile(file.storage_key, reason) from error
        raise


def sha256_of(storage: Storage, key: str) -> str:
    """The SHA-256 of a file that a row names, in hexadecimal.

    Raises:
        DamagedFile: the file is missing.
    """
    with named_by_row(key), storage.open(key) as file:
        return read_content(file, lambda size_bytes: None, of_chips=False).sha256
