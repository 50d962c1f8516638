"""Files by key in a bucket of S3-compatible storage, shared by the workers of many machines."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import IO, Any, BinaryIO

import obstore
from obstore.exceptions import BaseError
from obstore.store import S3Store

from app.errors import InputError, NotFound, StorageOutage
from app.storage.folder import COPY_BYTES, RangeReader, Storage, checked_key

RETRIES = 3
PATIENCE = timedelta(seconds=20)
"""A request is repeated for so long; then the storage is out, and whoever asked is told."""


@dataclass(frozen=True)
class BucketStorage(Storage):
    """Files in a bucket, under the same keys as in a folder.

    A file is written into `folder` first, where its checksum is taken, and then sent: it appears in the
    bucket complete, or not at all.

    Attributes:
        folder: of this machine, for what is not finished.
        url: `s3://BUCKET/PREFIX`; where the service is and who may use it is said by the `AWS_...`
            variables that all its tools know.
    """

    url: str
    store: S3Store = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        try:
            # Plain HTTP only where AWS_ENDPOINT_URL says so itself.
            store = S3Store.from_url(
                self.url,
                client_options={"allow_http": True},
                retry_config={"max_retries": RETRIES, "retry_timeout": PATIENCE},
            )
        except Exception as error:
            raise InputError(f"AMERS_STORAGE_URL: {self.url!r} cannot be used: {error}") from error
        object.__setattr__(self, "store", store)

    def local(self, key: str) -> Path | None:
        """Nothing of a bucket lies on this machine."""
        return None

    def path(self, key: str) -> Path:
        """Nothing of a bucket lies in a folder.

        Raises:
            NotFound: always.
        """
        raise NotFound(f"{checked_key(key)} lies in {self.url}, not in a folder")

    def open(self, key: str) -> BinaryIO:
        """A file, for reading: piece by piece, as it is read."""
        return io.BufferedReader(_RangeFile(self.reader(key), self.size(key)), COPY_BYTES)

    def fetch(self, key: str, folder: Path) -> Path:
        """A copy of a file, in the folder under its own name.

        Raises:
            InputError: the key is not one.
            NotFound: there is no such file.
        """
        path = folder / key.rsplit("/", 1)[-1]
        with path.open("wb") as file:
            self._download(key, file)
        return path

    def reader(self, key: str) -> RangeReader:
        """A file, to be read by requests for ranges of it."""
        self.size(key)
        return _BucketReader(self.store, key)

    def size(self, key: str) -> int:
        """How large a file is, bytes."""
        with _answering(key):
            return int(obstore.head(self.store, checked_key(key))["size"])

    def exists(self, key: str) -> bool:
        """Whether there is a file of that key."""
        try:
            self.size(key)
        except NotFound:
            return False
        return True

    def delete(self, key: str) -> None:
        """Remove a file, if it is there."""
        with _answering(key):
            obstore.delete(self.store, checked_key(key))

    def keys(self, prefix: str) -> list[str]:
        """The keys of all files below a prefix, sorted."""
        with _answering(prefix):
            pages = obstore.list(self.store, prefix=checked_key(prefix))
            return sorted(found["path"] for page in pages for found in page)

    def _download(self, key: str, file: IO[bytes]) -> None:
        with _answering(key):
            for chunk in obstore.get(self.store, checked_key(key)).stream(min_chunk_size=COPY_BYTES):
                file.write(chunk)

    def _place(self, unfinished: Path, key: str) -> None:
        """Send a file, in several parts at once when it is large."""
        with _answering(key):
            obstore.put(self.store, checked_key(key), unfinished)
        os.unlink(unfinished)


@dataclass(frozen=True)
class _BucketReader:
    store: S3Store
    key: str

    def read(self, start: int, length: int) -> bytes:
        if length == 0:
            return b""
        with _answering(self.key):
            return bytes(obstore.get_range(self.store, self.key, start=start, length=length))

    def close(self) -> None:
        """Nothing is open between requests."""


class _RangeFile(io.RawIOBase):
    """A file read from its beginning to its end, by requests for ranges of it."""

    def __init__(self, reader: RangeReader, size: int) -> None:
        self._reader = reader
        self._size = size
        self._at = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        length = min(len(buffer), self._size - self._at)
        buffer[:length] = self._reader.read(self._at, length)
        self._at += length
        return length


@contextmanager
def _answering(key: str) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise NotFound(f"no file {key} in the storage") from None
    except BaseError as error:
        raise StorageOutage(f"{key}: the storage does not answer: {error}") from error
