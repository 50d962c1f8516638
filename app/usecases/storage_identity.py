"""The storage belongs to its database: each names the other, and only then files are written or removed.

The storage names its installation in the file `installation.json`. A number in it, the generation,
advances in database and storage while the service runs. A database whose generation is behind was
restored from an older backup: it does not know the newest files.
"""

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial

import psycopg

from amers.app.config import Settings
from amers.app.db import installation, uploads
from amers.app.db.engine import Connection, Database
from amers.app.db.installation import InstallationRow
from amers.app.errors import Conflict, InputError, NotFound, StorageOutage
from amers.app.outages import outage_of
from amers.app.storage import Marker, Storage, open_storage, read_marker, write_marker
from amers.app.usecases import garbage_collection
from amers.app.usecases.uploads import arriving_files

log = logging.getLogger(__name__)

Begin = Callable[[], AbstractContextManager[Connection]]
"""Begins a transaction."""
UNNAMED = (
    "the storage names no installation: it is not mounted, it is another one, or the database does not "
    "know its files"
)
RETRY_S = 10.0
"""Time between two tries of a service to prepare its storage."""
PROBE = "probe.txt"
"""Key of the tiny file that tries a storage; top-level keys belong to no block, scene or job."""
KNOWN_SHARE = 0.95
"""A storage of an earlier version is adopted if rows of the database name this share of its files."""
ADVICE = (
    "Nothing is removed from the storage, and workers do no jobs. Check AMERS_DATABASE_URL, "
    "AMERS_DATA_FOLDER and AMERS_STORAGE_URL; if this database and this storage belong together, run "
    "`amers store adopt`"
)


def mismatch(connection: Connection, storage: Storage) -> str | None:
    """Why the storage does not belong to the database, with what to do; None if it belongs to it.

    A storage that names no installation belongs to none; `prepare` looks whether to adopt it.
    """
    return _compare(storage, expect(connection, storage), lambda: UNNAMED)


def require_match(database: Database, storage: Storage) -> None:
    """Check that the storage belongs to the database.

    Raises:
        Conflict: it does not.
    """
    with database.reading() as connection:
        reason = mismatch(connection, storage)
    if reason is not None:
        raise Conflict(reason)


def expect(connection: Connection, storage: Storage) -> InstallationRow:
    """Bind a storage to its installation, which each write checks; returns its identity."""
    row = installation.read(connection)
    if storage.proof is not None:
        storage.proof.bind(row.id)
    return row


def opened(database: Database, settings: Settings) -> Storage:
    """The storage of an installation, for a process that does one thing with it.

    The first process of a new installation prepares its storage.

    Raises:
        InputError: `storage_url` names a bucket that cannot be used.
    """
    storage = open_storage(settings)
    with database.reading() as connection:
        row = expect(connection, storage)
    if row.storage_generation == 0:
        announce(database.transaction, storage)
    return storage


def require_writable(storage: Storage) -> None:
    """Check that a storage takes files: a tiny one is written and read.

    Raises:
        StorageOutage: it does not; the reason is for callers.
    """
    try:
        storage.put(PROBE, [PROBE.encode()])
        with storage.open(PROBE) as file:
            file.read()
    except (OSError, NotFound) as error:
        outage = outage_of(error)
        reason = "no file can be written into the storage" if outage is None else outage.reason
        raise StorageOutage(f"{storage.place}: no file can be written: {error}", reason) from error


def prepare(begin: Begin, storage: Storage) -> str | None:
    """Bind a new storage to its database, and advance the generation of both.

    Returns:
        Why the storage does not belong to the database, with what to do; None if it belongs to it.
    """
    with begin() as connection:
        row = installation.lock(connection)
        reason = _compare(storage, row, partial(_without_marker, connection, storage, row))
        if reason is not None:
            return reason
        expect(connection, storage)
        if row.storage_generation == 0:
            with storage.found(row.id):
                write_marker(storage, Marker(row.id, 0))
        installation.advance(connection)
    _write_marker(begin, storage)
    return None


def advance(begin: Begin, storage: Storage) -> None:
    """Advance the generation of a storage and its database, if they belong together."""
    with begin() as connection:
        expect(connection, storage)
        if _compare(storage, installation.lock(connection), lambda: UNNAMED) is not None:
            return
        installation.advance(connection)
    _write_marker(begin, storage)


def announce(begin: Begin, storage: Storage) -> bool:
    """Prepare the storage and log what stands against it; returns whether it belongs to the database."""
    try:
        with begin() as connection:
            expect(connection, storage)
        reason = prepare(begin, storage)
    except (StorageOutage, OSError) as error:
        reason = f"the storage could not be checked: {error}"
    except psycopg.Error as error:
        if (outage := outage_of(error)) is None:
            raise
        reason = f"the storage could not be checked: {outage.reason}"
    if reason is not None:
        log.error("%s: %s", storage.place, reason)
    return reason is None


def adopt(begin: Begin, storage: Storage) -> InstallationRow:
    """Bind a storage to the database, whatever it belonged to; returns their identity.

    Raises:
        StorageOutage: there is no such folder; none is made.
    """
    with begin() as connection:
        row = installation.lock(connection)
        try:
            marker = read_marker(storage)
        except InputError:
            marker = None
        with storage.found(row.id, new=row.storage_generation == 0):
            write_marker(storage, Marker(row.id, 0))
        installation.advance(connection, beyond=marker.generation if marker else 0)
    return _write_marker(begin, storage)


def _write_marker(begin: Begin, storage: Storage) -> InstallationRow:
    """Write what is committed: a crash leaves the storage a generation behind, never ahead."""
    with begin() as connection:
        row = installation.lock(connection)
        write_marker(storage, Marker(row.id, row.storage_generation))
    return row


def _compare(
    storage: Storage, row: InstallationRow, without_marker: Callable[[], str | None]
) -> str | None:
    """Why a storage does not belong to a database; `without_marker` answers where there is none."""
    try:
        marker = read_marker(storage)
    except InputError as error:
        return f"{error}. {ADVICE}"
    if marker is None:
        reason = without_marker()
    elif marker.installation != row.id:
        reason = (
            f"the storage belongs to installation {marker.installation}, the database to {row.id}: "
            "it is empty, or that of another installation"
        )
    elif marker.generation > row.storage_generation:
        reason = (
            f"the database is older than the storage (generation {row.storage_generation}, the storage "
            f"has {marker.generation}): it is an older backup and does not know the newest files"
        )
    else:
        return None
    return None if reason is None else f"{reason}. {ADVICE}"


def _without_marker(connection: Connection, storage: Storage, row: InstallationRow) -> str | None:
    """Why a storage that names no installation does not belong to the database."""
    if row.storage_generation > 0:
        return (
            "the storage names no installation, but the database was used with a storage before: "
            "the folder is not mounted, or the bucket is another one"
        )
    families = garbage_collection.compare_files(connection, storage)
    arriving = arriving_files(storage)
    n_files = sum(family.n_files for family in families) + len(arriving)
    n_unknown = sum(len(family.unknown) for family in families)
    n_known = n_files - n_unknown - len(arriving.keys() - uploads.present(connection, list(arriving)))
    if n_files == 0 and installation.names_files(connection):
        return "the storage is empty, but the database names files: the folder is not mounted"
    if n_known < KNOWN_SHARE * n_files:
        return (
            f"the storage names no installation, and the database knows {n_known} of its {n_files} "
            "files: the database is empty, an older one, or that of another installation"
        )
    return None
