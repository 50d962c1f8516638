"""Room on the disks of an installation that is given up when a deletion meets a full disk.

A deletion needs a little room before it frees much: rows change before files go, the log of the database
grows, a file in the trash has a folder. So a file without content occupies the room while there is
enough, on the disk of the storage and on that of the private database. There is none on the disk of a
database of the operator's own.
"""

import logging
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from amers.app.config import Settings
from amers.app.outages import outage_of

NAME = "reserve"
STORAGE_BYTES = 256 << 10
"""For the marker of the storage, and for folders of the trash."""
DATABASE_BYTES = 32 << 20
"""For two segments of the log of the private database."""
FULL = 507
Result = TypeVar("Result")

log = logging.getLogger(__name__)


def keep(settings: Settings) -> None:
    """Make the reserve on each disk that has room for it twice; only where the storage is proven."""
    for path, size_bytes in _files(settings).items():
        try:
            if not path.exists() and shutil.disk_usage(path.parent).free >= 2 * size_bytes:
                _occupy(path, size_bytes)
        except OSError as error:
            log.warning("%s: no reserve for deletions can be kept: %s", path, error.strerror)


def give_up(settings: Settings) -> bool:
    """Remove the reserve; returns whether there was any."""
    return any([_remove(path) for path in _files(settings)])


def give_up_for_start(cluster: Path) -> None:
    """Remove the reserve on the disk of a private database that has no room to start in.

    Args:
        cluster: the folder of the database, in the data folder.
    """
    if shutil.disk_usage(cluster).free < DATABASE_BYTES // 2:
        for folder in (cluster, cluster.parent):
            _remove(folder / NAME)


def deleting(settings: Settings, delete: Callable[[], Result]) -> Result:
    """What a function that deletes returns; on a full disk it is called again without the reserve."""
    try:
        return delete()
    except Exception as error:
        if not is_full(error) or not give_up(settings):
            raise
    return delete()


def is_full(error: Exception) -> bool:
    """Whether an error tells of a full disk: that of the files or that of the database."""
    outage = outage_of(error)
    return outage is not None and outage.status == FULL


def _files(settings: Settings) -> dict[Path, int]:
    """The files of the reserve with their sizes in bytes, one on each disk that Amers writes to."""
    sizes: dict[Path, int] = {}
    for folder, size_bytes, is_used in (
        (settings.data_folder / "storage", STORAGE_BYTES, settings.storage_url is None),
        (settings.data_folder / "postgres", DATABASE_BYTES, settings.database_url is None),
    ):
        with suppress(OSError):
            if is_used:
                disk = folder.stat().st_dev
                is_shared = settings.data_folder.stat().st_dev == disk
                path = (settings.data_folder if is_shared else folder) / NAME
                sizes[path] = max(size_bytes, sizes.get(path, 0))
    return sizes


def _occupy(path: Path, size_bytes: int) -> None:
    """Make a file of this size, whole or not at all."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with unfinished.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, size_bytes)
        unfinished.rename(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _remove(path: Path) -> bool:
    try:
        path.unlink()
    except OSError:
        return False
    log.warning("%s: the disk is full; this reserve is given up, so that deletions go on", path)
    return True
