"""Restore a backup into an empty database and an empty storage, completely or to be continued."""

from pathlib import Path

from amers.app.db import engine, installation, revisions
from amers.app.db.cluster import backup as archive
from amers.app.errors import Conflict, InputError
from amers.app.storage import MARKER, Marker, Storage, write_marker
from amers.app.storage.trash import TRASH
from amers.app.usecases import damage
from amers.app.usecases.backups.manifest import (
    ARCHIVE,
    MANIFEST,
    STORAGE,
    BackupFile,
    Manifest,
    find_problems,
    read_manifest,
    sha256_of,
)
from amers.app.usecases.garbage_collection import FOLDER_STATES
from amers.services.types import Progress, no_progress, part_of

RESTORING = "restoring.txt"
"""Key of the file in a storage into which a backup is being restored: the SHA-256 of its manifest."""
SHOWN_PROBLEMS = 10


def restore_backup(
    dsn: str, storage: Storage, folder: Path, progress: Progress = no_progress
) -> Manifest:
    """Verify a backup, then restore its files and its database; returns its manifest.

    Files come first and the database last, in one transaction. A restore that was killed is continued by
    the next one of the same backup.

    Raises:
        InputError: the folder is no backup, or not as it was written; nothing is restored.
        Conflict: database or storage are not empty.
    """
    manifest = read_manifest(folder)
    problems = find_problems(folder, manifest, part_of(progress, 0.0, 0.3))
    if problems:
        shown = "; ".join(problems[:SHOWN_PROBLEMS])
        raise InputError(
            f"{folder}: the backup differs from its manifest, so nothing was restored: {shown}"
        )
    backup = sha256_of(folder / MANIFEST)
    is_continued = _is_begun(storage, backup)
    has_database = is_continued and _is_restored(dsn, manifest)
    if not has_database:
        archive.check_restorable(dsn, folder / ARCHIVE)
    with storage.found(manifest.installation):
        storage.put(RESTORING, [backup.encode()])
        write_marker(storage, Marker(manifest.installation, manifest.generation))
    stored = [file for file in manifest.files if file.path.startswith(f"{STORAGE}/")]
    for number, file in enumerate(stored):
        progress(0.3 + 0.6 * number / len(stored), file.path)
        _restore_file(storage, folder, file)
    progress(0.9, "the database")
    if not has_database:
        archive.restore(dsn, folder / ARCHIVE)
    revisions.upgrade(dsn)
    storage.delete(RESTORING)
    return manifest


def _is_begun(storage: Storage, backup: str) -> bool:
    """Whether a restore of this backup was begun before; otherwise the storage is empty.

    Raises:
        Conflict: the storage has files that are not of this backup.
    """
    if storage.exists(RESTORING):
        with storage.open(RESTORING) as file:
            if file.read().decode(errors="replace") == backup:
                return True
        raise Conflict("another backup was partly restored into the storage: restore into an empty one")
    if storage.exists(MARKER) or any(storage.keys(top) for top in ("chips", *FOLDER_STATES, TRASH)):
        raise Conflict(
            "the storage has files already: restore into an empty one (another AMERS_DATA_FOLDER or "
            "AMERS_STORAGE_URL)"
        )
    return False


def _is_restored(dsn: str, manifest: Manifest) -> bool:
    """Whether a database is that of a backup."""
    if not archive.has_tables(dsn):
        return False
    with engine.connect(dsn) as connection:
        return installation.read(connection).id == manifest.installation


def _restore_file(storage: Storage, folder: Path, file: BackupFile) -> None:
    """Put a file of a backup into the storage, unless a restore before has done so."""
    key = file.path.removeprefix(f"{STORAGE}/")
    if storage.exists(key) and damage.sha256_of(storage, key) == file.sha256:
        return
    stored = storage.put_file(key, folder / file.path)
    if stored.sha256 != file.sha256:
        raise InputError(f"{folder / file.path} has changed while it was restored")
