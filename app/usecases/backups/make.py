"""Make a backup: the database and the stored files that it names, as one set with a manifest."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from amers.app.db import installation, revisions, stored_files
from amers.app.db.cluster import backup as archive
from amers.app.db.engine import Database, driver, export_snapshot
from amers.app.db.stored_files import NamedFile
from amers.app.errors import Conflict, DamagedFile, InputError, NotFound
from amers.app.storage import Storage, trash
from amers.app.usecases import damage, storage_identity
from amers.app.usecases.backups.manifest import (
    ARCHIVE,
    READ_BYTES,
    STORAGE,
    BackupFile,
    Difference,
    Manifest,
    sha256_of,
    write_manifest,
)
from amers.app.usecases.installation import Installation
from amers.services.types import Progress, no_progress


def make_backup(here: Installation, folder: Path, progress: Progress = no_progress) -> Manifest:
    """Write a backup into a new folder, which appears when it is complete; returns its manifest.

    The database is dumped first. The files that its rows name are then linked, or copied where they
    cannot be linked, and compared with their checksums. Others continue to work meanwhile.

    Raises:
        Conflict: the folder exists, or the storage does not belong to the database.
        InputError: the folder cannot be written.
    """
    reason = storage_identity.prepare(here.database.transaction, here.storage)
    if reason is not None:
        raise Conflict(reason)
    with _new_folder(folder) as unfinished:
        progress(0.0, "the database")
        with here.database.snapshot() as connection:
            created_at = datetime.now(UTC).isoformat(timespec="seconds")
            row = installation.read(connection)
            revision = revisions.current(driver(connection)) or ""
            named = stored_files.read_named_files(connection)
            archive.dump(here.database.dsn, unfinished / ARCHIVE, export_snapshot(connection))
        # From here on the dump is behind the storage, as every older backup.
        storage_identity.prepare(here.database.transaction, here.storage)
        dump = unfinished / ARCHIVE
        files, damaged, outdated = [BackupFile(ARCHIVE, dump.stat().st_size, sha256_of(dump))], [], []
        for number, file in enumerate(named):
            progress(0.1 + 0.9 * number / len(named), file.storage_key)
            copy = _copy(here.storage, file.storage_key, unfinished)
            if copy is not None:
                files.append(copy)
            if copy is not None and file.sha256 in (None, copy.sha256):
                continue
            difference = Difference(
                file.storage_key, "missing" if copy is None else f"its SHA-256 is not {file.sha256}"
            )
            if _is_outdated(here.database, file, copy):
                outdated.append(difference)
            else:
                damage.report_damage(here.database, DamagedFile(difference.key, difference.reason))
                damaged.append(difference)
        manifest = Manifest(
            created_at, row.id, row.storage_generation, revision, files, damaged, outdated
        )
        write_manifest(unfinished, manifest)
    return manifest


def _copy(storage: Storage, key: str, folder: Path) -> BackupFile | None:
    """A file of the storage in the backup; None if the storage does not have it.

    What the sweep has removed since the dump is taken from the trash.
    """
    target = folder / STORAGE / key
    target.parent.mkdir(parents=True, exist_ok=True)
    for place in (key, trash.find(storage, key)):
        with suppress(NotFound):
            if place is not None:
                _link_or_copy(storage, place, target)
                return BackupFile(f"{STORAGE}/{key}", target.stat().st_size, sha256_of(target))
    return None


def _link_or_copy(storage: Storage, key: str, target: Path) -> None:
    """Link a stored file, which is never changed in place; copy it where no link can be made."""
    path = storage.local(key)
    if path is not None:
        with suppress(OSError):
            os.link(path, target)
            return
    with storage.open(key) as source, target.open("xb") as file:
        shutil.copyfileobj(source, file, READ_BYTES)
        file.flush()
        os.fsync(file.fileno())


def _is_outdated(database: Database, file: NamedFile, copy: BackupFile | None) -> bool:
    """Whether a file differs from its row in the dump because it was removed or replaced since."""
    with database.reading() as connection:
        present = stored_files.read_named_files(connection, [file.storage_key])
    return not present or (copy is not None and present[0].sha256 == copy.sha256)


@contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """A folder that gets its name at the end of the context, complete on the disk.

    What a killed backup has left is deleted.

    Raises:
        Conflict: the folder exists, or another backup is being written into it.
        InputError: the folder cannot be made.
    """
    if folder.exists():
        raise Conflict(f"{folder} exists already; a backup needs a new folder: choose another name")
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    try:
        unfinished.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{unfinished}: the folder cannot be made: {error.strerror}") from error
    lock = os.open(unfinished, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _clear(unfinished)
        try:
            yield unfinished
            _sync_folders(unfinished)
            unfinished.rename(folder)
        except BaseException:
            shutil.rmtree(unfinished, ignore_errors=True)
            raise
        _sync(folder.parent)
    except BlockingIOError:
        raise Conflict(f"another backup is being written into {folder}") from None
    finally:
        os.close(lock)


def _clear(folder: Path) -> None:
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _sync_folders(folder: Path) -> None:
    """Bring the names of all files to the disk."""
    for root, _, _ in os.walk(folder):
        _sync(Path(root))


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
