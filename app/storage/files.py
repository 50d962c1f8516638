"""Files of a storage: their keys, one that is written or read, and locks of unfinished ones."""

import fcntl
import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

from amers.app.errors import InputError, TooLarge

UNFINISHED = "unfinished"
COPY_BYTES = 1 << 20
KEY = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]*(/[A-Za-z0-9_][A-Za-z0-9_.\-]*)*")


@dataclass(frozen=True)
class StoredFile:
    """A file in the storage.

    Attributes:
        sha256: in hexadecimal.
    """

    key: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class FileState:
    """What identifies the content of a file without reading it.

    Attributes:
        modified_s: when it was stored, seconds since 1970.
        version: a text that changes with the content.
    """

    size_bytes: int
    modified_s: float
    version: str


class RangeReader(Protocol):
    """An open file of the storage that is read by position; threads may share it."""

    def read(self, start: int, length: int) -> bytes:
        """`length` bytes from position `start`; fewer at the end of the file."""

    def close(self) -> None:
        """Close the file."""


class Writing:
    """A file that is being written into the storage; computes its size and checksum on the way."""

    def __init__(self, file: BinaryIO, path: Path, limit_bytes: int | None) -> None:
        self._file = file
        self._path = path
        self._limit_bytes = limit_bytes
        self._hash = hashlib.sha256()
        self.size_bytes = 0

    def write(self, chunk: bytes) -> None:
        """Append bytes.

        Raises:
            TooLarge: the file exceeds its limit.
        """
        self.size_bytes += len(chunk)
        if self._limit_bytes is not None and self.size_bytes > self._limit_bytes:
            raise TooLarge(f"the file exceeds the accepted size of {self._limit_bytes} bytes")
        self._hash.update(chunk)
        self._file.write(chunk)

    @property
    def sha256(self) -> str:
        """Checksum of the bytes written so far, in hexadecimal."""
        return self._hash.hexdigest()

    def finish(self) -> Path:
        """Write all bytes through to the disk; returns the path of the file."""
        self._file.flush()
        os.fsync(self._file.fileno())
        return self._path


@dataclass(frozen=True)
class FileReader:
    """A file of a folder that is read by position."""

    descriptor: int

    def read(self, start: int, length: int) -> bytes:
        """`length` bytes from position `start`; fewer at the end of the file."""
        return os.pread(self.descriptor, length, start)

    def close(self) -> None:
        """Close the file."""
        os.close(self.descriptor)


@contextmanager
def locked(path: Path, mode: int = fcntl.LOCK_SH) -> Iterator[None]:
    """Lock a file or folder; the kernel releases the lock of a killed process."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        lock(descriptor, mode)
        yield
    finally:
        os.close(descriptor)


def lock(descriptor: int, mode: int) -> None:
    """Lock an open file; does nothing where the file system has no such locks.

    Raises:
        BlockingIOError: somebody else has locked it.
    """
    try:
        fcntl.flock(descriptor, mode)
    except BlockingIOError:
        raise
    except OSError:
        return  # The file system has no such locks: its files are swept by their age alone.


def checked_key(key: str) -> str:
    """The key, after a check of its form.

    Raises:
        InputError: the key is malformed.
    """
    if not KEY.fullmatch(key) or key.split("/")[0] == UNFINISHED:
        raise InputError(
            f"{key!r} is not a key of the storage: expected names of letters, digits, . _ -"
        )
    return key


def chips_key(sha256: str) -> str:
    """The key of a chip file: the checksum of its content, so that equal files are stored once."""
    return f"chips/{sha256}.npy"
