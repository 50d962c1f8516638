"""Files by key in a bucket of S3-compatible storage, shared by the workers of many machines."""

import io
import os
from collections.abc import Hashable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import IO, Any, BinaryIO

import obstore
from obstore.exceptions import BaseError
from obstore.store import S3Store

from amers.app.errors import InputError, NotFound, StorageOutage
from amers.app.storage.files import COPY_BYTES, UNFINISHED, FileState, RangeReader, checked_key
from amers.app.storage.folder import Storage
from amers.app.storage.marker import MARKER, Marker, parse_marker

RETRIES = 3
RETRY_TIMEOUT = timedelta(seconds=20)
"""A failing request is repeated for this time; then it raises `StorageOutage`."""
COPY_LIMIT_BYTES = 5 << 30
"""Largest file that S3 copies in one request."""


@dataclass(frozen=True)
class BucketStorage(Storage):
    """Files in a bucket, under the same keys as in a folder.

    A file is first written into `folder`, where its checksum is computed, and then sent. It appears in
    the bucket when it is complete.

    Attributes:
        folder: of this machine, for unfinished files.
        url: `s3://BUCKET/PREFIX`; the common `AWS_...` variables set address and credentials.
    """

    url: str
    store: S3Store = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        try:
            # Plain HTTP is used only if AWS_ENDPOINT_URL begins with http://.
            store = S3Store.from_url(
                self.url,
                client_options={"allow_http": True},
                retry_config={"max_retries": RETRIES, "retry_timeout": RETRY_TIMEOUT},
            )
        except Exception as error:
            raise InputError(f"AMERS_STORAGE_URL: {self.url!r} cannot be used: {error}") from error
        object.__setattr__(self, "store", store)

    @property
    def place(self) -> str:
        """The address of the bucket."""
        return self.url

    def look(self) -> Hashable:
        """The address of the bucket: nothing but its marker tells it from another one."""
        return self.url

    def look_closely(self) -> tuple[Hashable, Marker | None]:
        """The address of the bucket, and the marker there.

        Raises:
            InputError: the marker cannot be understood.
            StorageOutage: the bucket does not answer.
        """
        try:
            with _storage_errors(MARKER):
                content = bytes(obstore.get(self.store, MARKER).bytes())
        except NotFound:
            return self.url, None
        return self.url, parse_marker(content)

    def _make_scratch(self) -> None:
        """Make the folder for unfinished files of this machine."""
        (self.folder / UNFINISHED).mkdir(mode=0o700, parents=True, exist_ok=True)

    def local(self, key: str) -> Path | None:
        """None: the files of a bucket do not lie on this machine."""
        return None

    def path(self, key: str) -> Path:
        """Raise: the files of a bucket have no paths.

        Raises:
            NotFound: always.
        """
        raise NotFound(f"{checked_key(key)} lies in {self.url}, not in a folder")

    def open(self, key: str) -> BinaryIO:
        """Open a file to read it from its start, by range requests."""
        return io.BufferedReader(_RangeFile(self.reader(key), self.size(key)), COPY_BYTES)

    def fetch(self, key: str, folder: Path) -> Path:
        """Copy a file into a folder under its own name; returns the path.

        Raises:
            InputError: the key is malformed.
            NotFound: there is no such file.
        """
        path = folder / key.rsplit("/", 1)[-1]
        with path.open("wb") as file:
            self._download(key, file)
        return path

    def reader(self, key: str) -> RangeReader:
        """Open a file to read it by range requests."""
        self.size(key)
        return _BucketReader(self.store, key)

    def size(self, key: str) -> int:
        """The size of a file, bytes."""
        return self.state(key).size_bytes

    def state(self, key: str) -> FileState:
        """The size of a file, its time, and a text that changes with its content."""
        try:
            with _storage_errors(key):
                found = obstore.head(self.store, checked_key(key))
        except NotFound:
            self.prove()
            raise
        modified_s = found["last_modified"].timestamp()
        return FileState(int(found["size"]), modified_s, f"{modified_s}-{found['e_tag']}")

    def exists(self, key: str) -> bool:
        """Whether there is a file of this key."""
        try:
            with _storage_errors(key):
                obstore.head(self.store, checked_key(key))
        except NotFound:
            return False
        return True

    def delete(self, key: str) -> None:
        """Delete a file, if it exists."""
        with self.proven(), suppress(NotFound), _storage_errors(key):
            obstore.delete(self.store, checked_key(key))

    def move(self, key: str, new_key: str) -> None:
        """Give a file another key; does nothing if there is no such file.

        The storage service copies the file; one that is too large for that goes through this machine.
        """
        with self.proven(), suppress(NotFound), _storage_errors(key):
            if self.size(key) <= COPY_LIMIT_BYTES:
                obstore.copy(self.store, checked_key(key), checked_key(new_key))
            else:
                with self._unfinished(None) as writing:
                    for chunk in obstore.get(self.store, key).stream(min_chunk_size=COPY_BYTES):
                        writing.write(chunk)
                    self._place(writing.finish(), new_key)
            self.delete(key)

    def keys(self, prefix: str) -> list[str]:
        """The keys of all files below a prefix, sorted."""
        return sorted(self.sizes(prefix))

    def sizes(self, prefix: str) -> dict[str, int]:
        """The keys of all files below a prefix, each with its size in bytes."""
        with _storage_errors(prefix):
            pages = obstore.list(self.store, prefix=checked_key(prefix))
            return {entry["path"]: int(entry["size"]) for page in pages for entry in page}

    def _download(self, key: str, file: IO[bytes]) -> None:
        with _storage_errors(key):
            for chunk in obstore.get(self.store, checked_key(key)).stream(min_chunk_size=COPY_BYTES):
                file.write(chunk)

    def _place(self, unfinished: Path, key: str) -> None:
        """Send a finished file to its key; a large one goes in several parts at once."""
        self.prove()
        with _storage_errors(key):
            obstore.put(self.store, checked_key(key), unfinished)
        os.unlink(unfinished)


@dataclass(frozen=True)
class _BucketReader:
    store: S3Store
    key: str

    def read(self, start: int, length: int) -> bytes:
        if length == 0:
            return b""
        with _storage_errors(self.key):
            return bytes(obstore.get_range(self.store, self.key, start=start, length=length))

    def close(self) -> None:
        """Do nothing: no connection is kept between requests."""


class _RangeFile(io.RawIOBase):
    """A file that is read from its beginning to its end by range requests."""

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

    def readall(self) -> bytes:
        # Otherwise `read()` asks for 8 KiB at a time.
        rest = self._reader.read(self._at, self._size - self._at)
        self._at += len(rest)
        return rest


@contextmanager
def _storage_errors(key: str) -> Iterator[None]:
    """Translate errors of the storage service into ours."""
    try:
        yield
    except FileNotFoundError:
        raise NotFound(f"no file {key} in the storage") from None
    except BaseError as error:
        raise StorageOutage(f"{key}: the storage does not answer: {error}") from error
