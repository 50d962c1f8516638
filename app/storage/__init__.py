"""Files by key in a folder or a bucket: written completely or not at all, and read by position."""

from app.config import Settings
from app.storage.chips import StoredChips
from app.storage.folder import (
    KEY,
    UNFINISHED,
    FileState,
    RangeReader,
    Storage,
    StoredFile,
    Writing,
    chips_key,
)
from app.storage.marker import MARKER, Marker, read_marker, write_marker

__all__ = [
    "KEY",
    "MARKER",
    "UNFINISHED",
    "FileState",
    "Marker",
    "RangeReader",
    "Storage",
    "StoredChips",
    "StoredFile",
    "Writing",
    "chips_key",
    "open_storage",
    "read_marker",
    "write_marker",
]


def open_storage(settings: Settings) -> Storage:
    """The storage of an installation: a bucket where `storage_url` names one, else its data folder.

    Raises:
        InputError: `storage_url` names a bucket that cannot be used.
    """
    folder = settings.data_folder / "storage"
    if settings.storage_url is None:
        return Storage(folder)
    from app.storage.bucket import BucketStorage  # 0.1 s and 10 MB that a folder does not need

    return BucketStorage(folder, settings.storage_url)
