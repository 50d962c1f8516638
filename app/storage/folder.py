"""Files by key in one folder: written whole or not at all, read by position."""

import fcntl
import hashlib
import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, mkstemp
from typing import BinaryIO, Protocol

from app.errors import InputError, NotFound, TooLarge

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


class RangeReader(Protocol):
    """An open file of the storage that is read by position; safe to share between threads."""

    def read(self, start: int, length: int) -> bytes:
        """So many bytes from a position; fewer at the end of the file."""

    def close(self) -> None:
        """Let go of the file."""


class Writing:
    """A file on its way into the storage; its size and checksum are taken as it passes."""

    def __init__(self, file: BinaryIO, path: Path, limit_bytes: int | None) -> None:
        self._file = file
        self._path = path
        self._limit_bytes = limit_bytes
        self._hash = hashlib.sha256()
        self.size_bytes = 0

    def write(self, chunk: bytes) -> None:
        """Append bytes.

        Raises:
            TooLarge: the file would become larger than it may.
        """
        self.size_bytes += len(chunk)
        if self._limit_bytes is not None and self.size_bytes > self._limit_bytes:
            raise TooLarge(
                f"the file is larger than {self._limit_bytes} bytes, the most that is accepted"
            )
        self._hash.update(chunk)
        self._file.write(chunk)

    @property
    def sha256(self) -> str:
        """Checksum of what was written so far, in hexadecimal."""
        return self._hash.hexdigest()

    def finish(self) -> Path:
        """The file, once all its bytes are on the disk."""
        self._file.flush()
        os.fsync(self._file.fileno())
        return self._path


@dataclass(frozen=True)
class Storage:
    """Files below one folder, under keys such as `scenes/ID/scene.tif`.

    A key is made of letters, digits, `_`, `-`, `.` and `/`; no part of it begins with a dot, and no link
    below the folder is followed. A file appears under its key complete and on the disk, or not at all.
    """

    folder: Path

    @contextmanager
    def writing(self, key: str, limit_bytes: int | None = None) -> Iterator[Writing]:
        """Write a file piece by piece; it takes its place at the end, or vanishes by an exception."""
        self._locate(key)
        with self._unfinished(limit_bytes) as writing:
            yield writing
            self._place(writing.finish(), key)

    def put(self, key: str, chunks: Iterable[bytes], limit_bytes: int | None = None) -> StoredFile:
        """Store a file, replacing the one of that key.

        Raises:
            TooLarge: there are more bytes than the limit; nothing is stored.
        """
        with self.writing(key, limit_bytes) as writing:
            for chunk in chunks:
                writing.write(chunk)
        return StoredFile(key, writing.size_bytes, writing.sha256)

    def put_file(self, key: str, path: Path) -> StoredFile:
        """Store a copy of a file."""
        with path.open("rb") as file:
            return self.put(key, iter(lambda: file.read(COPY_BYTES), b""))

    def put_chips(self, path: Path, expected_sha256: str | None = None) -> StoredFile:
        """Store a copy of a block's chip file under its checksum, unless it is there already.

        What has another checksum than expected is not stored; the reply tells the one it has.
        """
        with self._unfinished(None) as writing:
            with path.open("rb") as file:
                while chunk := file.read(COPY_BYTES):
                    writing.write(chunk)
            key = chips_key(writing.sha256)
            if expected_sha256 in (None, writing.sha256) and not self.exists(key):
                self._place(writing.finish(), key)
        return StoredFile(key, writing.size_bytes, writing.sha256)

    def adopt(self, path: Path, key: str) -> None:
        """Make a file of `scratch` the one of that key; it is no longer where it was."""
        self._locate(key)
        with path.open("rb") as file:
            os.fsync(file.fileno())
        self._place(path, key)

    def scratch(self) -> Path:
        """A folder for what is not finished, on the file system of the storage if it has one.

        What stays in it is swept after a while.
        """
        folder = self.folder / UNFINISHED
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return folder

    @contextmanager
    def scratch_folder(self, prefix: str) -> Iterator[Path]:
        """A folder in `scratch` that is removed at the end, and not swept before."""
        with (
            TemporaryDirectory(prefix=prefix, dir=self.scratch()) as folder,
            _held(Path(folder)),
        ):
            yield Path(folder)

    def fetch(self, key: str, folder: Path) -> Path:
        """A file on this machine, for libraries that open files themselves: never to be changed.

        Args:
            folder: where a copy goes if the storage is elsewhere.

        Raises:
            InputError: the key is not one.
            NotFound: there is no such file.
        """
        return self.path(key)

    def reader(self, key: str) -> RangeReader:
        """A file, to be read by position."""
        return _FileReader(os.open(self.path(key), os.O_RDONLY | os.O_CLOEXEC))

    def size(self, key: str) -> int:
        """How large a file is, bytes."""
        return self.path(key).stat().st_size

    def local(self, key: str) -> Path | None:
        """Where a file lies on this machine; None in a storage whose files do not.

        Raises:
            InputError: the key is not one.
            NotFound: there is no such file.
        """
        return self.path(key)

    def path(self, key: str) -> Path:
        """Where a file of the folder is.

        Raises:
            InputError: the key is not one.
            NotFound: there is no such file.
        """
        path = self._locate(key)
        if not path.is_file():
            raise NotFound(f"no file {key} in the storage")
        return path

    def open(self, key: str) -> BinaryIO:
        """A file, for reading."""
        return self.path(key).open("rb")

    def exists(self, key: str) -> bool:
        """Whether there is a file of that key."""
        return self._locate(key).is_file()

    def delete(self, key: str) -> None:
        """Remove a file, if it is there, and the folders it leaves empty."""
        path = self._locate(key)
        path.unlink(missing_ok=True)
        with suppress(OSError):
            while (path := path.parent) != self.folder:
                path.rmdir()

    def keys(self, prefix: str) -> list[str]:
        """The keys of all files below a folder of the storage, sorted."""
        found = (
            path for path in self._locate(prefix).rglob("*") if path.is_file() and not path.is_symlink()
        )
        return sorted(path.relative_to(self.folder).as_posix() for path in found)

    def sweep_unfinished(self, older_than_s: float, spare: str) -> list[str]:
        """Remove what writers that were killed left behind; returns the names removed.

        Whoever still writes holds a lock: he loses nothing to a clock that jumps ahead.

        Args:
            spare: what begins like this belongs to somebody else.
        """
        swept = []
        for path in (self.folder / UNFINISHED).glob("*"):
            with suppress(FileNotFoundError, BlockingIOError):
                if time.time() - path.stat().st_mtime < older_than_s or path.name.startswith(spare):
                    continue
                with _held(path, fcntl.LOCK_EX | fcntl.LOCK_NB):
                    if path.is_dir():
                        shutil.rmtree(path, ignore_errors=True)
                    else:
                        path.unlink()
                swept.append(path.name)
        return swept

    def _place(self, unfinished: Path, key: str) -> None:
        """Give a file its name."""
        path = self._locate(key)
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        unfinished.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)

    def _locate(self, key: str) -> Path:
        path = self.folder / checked_key(key)
        if any(
            part.is_symlink()
            for part in (path, *path.parents)
            if part.is_relative_to(self.folder) and part != self.folder
        ):
            raise InputError(f"{key!r} passes through a link")
        return path

    @contextmanager
    def _unfinished(self, limit_bytes: int | None) -> Iterator[Writing]:
        """A temporary file on the same file system, so that one rename puts it in its place."""
        handle, name = mkstemp(dir=self.scratch())
        try:
            with os.fdopen(handle, "wb") as file:
                _lock(file.fileno(), fcntl.LOCK_SH)
                yield Writing(file, Path(name), limit_bytes)
        finally:
            Path(name).unlink(missing_ok=True)


@dataclass(frozen=True)
class _FileReader:
    descriptor: int

    def read(self, start: int, length: int) -> bytes:
        return os.pread(self.descriptor, length, start)

    def close(self) -> None:
        os.close(self.descriptor)


@contextmanager
def _held(path: Path, how: int = fcntl.LOCK_SH) -> Iterator[None]:
    """A lock on a file or folder; the kernel lets go of it however its holder ends."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        _lock(descriptor, how)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, how: int) -> None:
    try:
        fcntl.flock(descriptor, how)
    except BlockingIOError:
        raise
    except OSError:
        return  # a file system that knows no such locks: its files are swept by their age alone


def checked_key(key: str) -> str:
    """The key, if it is one.

    Raises:
        InputError: it is not.
    """
    if not KEY.fullmatch(key) or key.split("/")[0] == UNFINISHED:
        raise InputError(f"not a key of the storage: {key!r}")
    return key


def chips_key(sha256: str) -> str:
    """The key of a chip file: its content's checksum, so that the same file is stored once."""
    return f"chips/{sha256}.npy"
