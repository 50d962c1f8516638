"""Files by key in a folder or a bucket: written completely or not at all, and read by position."""

from amers.app.config import Settings
from amers.app.storage.chips import StoredChips
from amers.app.storage.files import (
    KEY,
    UNFINISHED,
    FileState,
    RangeReader,
    StoredFile,
    Writing,
    chips_key,
)
from amers.app.storage.folder import Storage
from amers.app.storage.marker import MARKER, Marker, read_marker, write_marker
from amers.app.storage.proof import Proof

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

    Nothing is written into it without the marker of the installation, which use cases tell it before
    they write (`storage_identity`).

    Raises:
        InputError: `storage_url` names a bucket that cannot be used.
    """
    folder = settings.data_folder / "storage"
    if settings.storage_url is None:
        return Storage(folder, proof=Proof())
    from amers.app.storage.bucket import BucketStorage  # 0.1 s and 10 MB that a folder does not need

    return BucketStorage(folder, settings.storage_url, proof=Proof())
