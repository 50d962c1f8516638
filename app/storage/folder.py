"""Files by key in a folder: written completely or not at all, and read by position."""

import fcntl
import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, mkstemp
from typing import BinaryIO, Protocol
from uuid import uuid4

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
class Storage:
    """Files below one folder, under keys such as `scenes/ID/scene.tif`.

    A key consists of letters, digits, `_`, `-`, `.` and `/`; none of its parts begins with a dot. Links
    below the folder are not followed. A file appears under its key when it is complete and on the disk.
    """

    folder: Path

    @contextmanager
    def writing(self, key: str, limit_bytes: int | None = None) -> Iterator[Writing]:
        """Write a file in pieces; it gets its key at the end of the context, an exception deletes it."""
        self._locate(key)
        with self._unfinished(limit_bytes) as writing:
            yield writing
            self._place(writing.finish(), key)

    def put(self, key: str, chunks: Iterable[bytes], limit_bytes: int | None = None) -> StoredFile:
        """Store a file; it replaces a file of the same key.

        Raises:
            TooLarge: the file exceeds the limit; nothing is stored.
        """
        with self.writing(key, limit_bytes) as writing:
            for chunk in chunks:
                writing.write(chunk)
        return StoredFile(key, writing.size_bytes, writing.sha256)

    def put_file(self, key: str, path: Path) -> StoredFile:
        """Store a copy of a file."""
        with path.open("rb") as file:
            return self.put(key, iter(lambda: file.read(COPY_BYTES), b""))

    def put_chips(
        self,
        path: Path,
        expected_sha256: str | None = None,
        observe: Callable[[bytes], None] | None = None,
    ) -> StoredFile:
        """Store a copy of a block's chip file under its checksum, unless the storage has it already.

        A file with another checksum than expected is not stored; the result has its actual checksum.

        Args:
            path: of the file.
            expected_sha256: in hexadecimal; None accepts any.
            observe: receives the bytes of the file in their order.
        """
        with self._unfinished(None) as writing:
            with path.open("rb") as file:
                while chunk := file.read(COPY_BYTES):
                    writing.write(chunk)
                    if observe is not None:
                        observe(chunk)
            key = chips_key(writing.sha256)
            if expected_sha256 in (None, writing.sha256) and not self.exists(key):
                self._place(writing.finish(), key)
        return StoredFile(key, writing.size_bytes, writing.sha256)

    def link(self, path: Path, key: str) -> None:
        """Store a file of `scratch` under a key too; the file stays in `scratch`.

        Both names share the bytes where the file system has hard links; elsewhere the bytes are copied.
        """
        self._locate(key)
        with path.open("rb") as file:
            os.fsync(file.fileno())
        second_name = self.scratch() / f"link-{uuid4().hex}"
        try:
            try:
                os.link(path, second_name)
            except OSError:
                shutil.copyfile(path, second_name)
                with second_name.open("rb") as file:
                    os.fsync(file.fileno())
            self._place(second_name, key)
        finally:
            # A rename between two names of one file does nothing.
            second_name.unlink(missing_ok=True)

    @property
    def place(self) -> str:
        """The folder or the address of the storage, for messages to operators."""
        return str(self.folder)

    def scratch(self) -> Path:
        """A folder for unfinished files, on the file system of the storage if it is a folder.

        Files that stay in it are swept after some hours.
        """
        folder = self.folder / UNFINISHED
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return folder

    @contextmanager
    def scratch_folder(self, prefix: str) -> Iterator[Path]:
        """A folder in `scratch` that is deleted at the end of the context, and not swept before."""
        with (
            TemporaryDirectory(prefix=prefix, dir=self.scratch()) as folder,
            _locked(Path(folder)),
        ):
            yield Path(folder)

    def fetch(self, key: str, folder: Path) -> Path:
        """The path of a file on this machine, for libraries that open files; do not change the file.

        Args:
            key: of the file.
            folder: for a copy, if the storage is a bucket.

        Raises:
            InputError: the key is malformed.
            NotFound: there is no such file.
        """
        return self.path(key)

    def reader(self, key: str) -> RangeReader:
        """Open a file to read it by position."""
        return _FileReader(os.open(self.path(key), os.O_RDONLY | os.O_CLOEXEC))

    def size(self, key: str) -> int:
        """The size of a file, bytes."""
        return self.path(key).stat().st_size

    def state(self, key: str) -> FileState:
        """The size of a file, its time, and a text that changes with its content."""
        found = self.path(key).stat()
        return FileState(found.st_size, found.st_mtime, f"{found.st_mtime_ns:x}-{found.st_size:x}")

    def local(self, key: str) -> Path | None:
        """The path of a file on this machine; None if the storage is a bucket.

        Raises:
            InputError: the key is malformed.
            NotFound: there is no such file.
        """
        return self.path(key)

    def path(self, key: str) -> Path:
        """The path of a file in the folder.

        Raises:
            InputError: the key is malformed.
            NotFound: there is no such file.
        """
        path = self._locate(key)
        if not path.is_file():
            raise NotFound(f"no file {key} in the storage")
        return path

    def open(self, key: str) -> BinaryIO:
        """Open a file to read it from its start."""
        return self.path(key).open("rb")

    def exists(self, key: str) -> bool:
        """Whether there is a file of this key."""
        return self._locate(key).is_file()

    def delete(self, key: str) -> None:
        """Delete a file, if it exists, and the folders that become empty."""
        path = self._locate(key)
        path.unlink(missing_ok=True)
        with suppress(OSError):
            while (path := path.parent) != self.folder:
                path.rmdir()

    def move(self, key: str, new_key: str) -> None:
        """Give a file another key; does nothing if there is no such file."""
        path = self._locate(key)
        # Another process may move or delete it at the same time.
        with suppress(FileNotFoundError):
            self._place(path, new_key)
        self.delete(key)

    def keys(self, prefix: str) -> list[str]:
        """The keys of all files below a folder of the storage, sorted."""
        return sorted(path.relative_to(self.folder).as_posix() for path in self._files(prefix))

    def sizes(self, prefix: str) -> dict[str, int]:
        """The keys of all files below a folder of the storage, each with its size in bytes."""
        sizes = {}
        for path in self._files(prefix):
            with suppress(FileNotFoundError):
                sizes[path.relative_to(self.folder).as_posix()] = path.stat().st_size
        return sizes

    def _files(self, prefix: str) -> Iterator[Path]:
        paths = self._locate(prefix).rglob("*")
        return (path for path in paths if path.is_file() and not path.is_symlink())

    def sweep_unfinished(self, older_than_s: float, spare: str) -> list[str]:
        """Delete the unfinished files of killed writers; returns their names.

        A writer locks its file, so a clock that jumps ahead does not delete files in use.

        Args:
            older_than_s: least age of the files.
            spare: files whose names begin with this text stay.
        """
        swept = []
        for path in (self.folder / UNFINISHED).glob("*"):
            with suppress(FileNotFoundError, BlockingIOError):
                if time.time() - path.stat().st_mtime < older_than_s or path.name.startswith(spare):
                    continue
                with _locked(path, fcntl.LOCK_EX | fcntl.LOCK_NB):
                    if path.is_dir():
                        shutil.rmtree(path, ignore_errors=True)
                    else:
                        path.unlink()
                swept.append(path.name)
        return swept

    def _place(self, unfinished: Path, key: str) -> None:
        """Move a finished file to its key."""
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
            raise InputError(
                f"the key {key!r} leads through a link; links in the storage are not followed"
            )
        return path

    @contextmanager
    def _unfinished(self, limit_bytes: int | None) -> Iterator[Writing]:
        """A temporary file on the file system of the storage, so that one rename moves it to its key."""
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
def _locked(path: Path, mode: int = fcntl.LOCK_SH) -> Iterator[None]:
    """Lock a file or folder; the kernel releases the lock of a killed process."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        _lock(descriptor, mode)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, mode: int) -> None:
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
