"""Files by key in one folder: written whole or not at all, read by position."""

import hashlib
import os
import re
import shutil
import threading
import time
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkstemp
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from app.errors import InputError, NotFound, TooLarge
from services.conventions import CHIP_SIZE
from services.errors import FormatError

UNFINISHED = "unfinished"
OPEN_CHIP_FILES = 64
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

    def place(self, path: Path) -> None:
        """Give the file its name once its bytes are on the disk."""
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._file.flush()
        os.fsync(self._file.fileno())
        self._path.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


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
        path = self._locate(key)
        with self._unfinished(limit_bytes) as writing:
            yield writing
            writing.place(path)

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

    def put_chips(self, path: Path) -> StoredFile:
        """Store a copy of a block's chip file under its checksum, unless it is there already."""
        with self._unfinished(None) as writing:
            with path.open("rb") as file:
                while chunk := file.read(COPY_BYTES):
                    writing.write(chunk)
            key = chips_key(writing.sha256)
            if not self.exists(key):
                writing.place(self._locate(key))
        return StoredFile(key, writing.size_bytes, writing.sha256)

    def path(self, key: str) -> Path:
        """Where a file is, for libraries that open files themselves.

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

    def sweep_unfinished(self, older_than_s: float) -> list[str]:
        """Remove what writers that were killed left behind; returns the names removed."""
        swept = []
        for path in (self.folder / UNFINISHED).glob("*"):
            with suppress(FileNotFoundError):
                if time.time() - path.stat().st_mtime >= older_than_s:
                    if path.is_dir():
                        shutil.rmtree(path, ignore_errors=True)
                    else:
                        path.unlink()
                    swept.append(path.name)
        return swept

    def _locate(self, key: str) -> Path:
        if not KEY.fullmatch(key) or key.split("/")[0] == UNFINISHED:
            raise InputError(f"not a key of the storage: {key!r}")
        path = self.folder / key
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
        folder = self.folder / UNFINISHED
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle, name = mkstemp(dir=folder)
        try:
            with os.fdopen(handle, "wb") as file:
                yield Writing(file, Path(name), limit_bytes)
        finally:
            Path(name).unlink(missing_ok=True)


def chips_key(sha256: str) -> str:
    """The key of a chip file: its content's checksum, so that the same file is stored once."""
    return f"chips/{sha256}.npy"


@dataclass(frozen=True)
class _ChipFile:
    descriptor: int
    first_byte: int
    dtype: np.dtype[Any]
    n_chips: int


class StoredChips:
    """The chips of the storage, as a `services.types.ChipSource`; files are named by their keys.

    Files stay open and their headers parsed; a read is one `pread`. Safe to share between threads.
    """

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._open: OrderedDict[str, _ChipFile] = OrderedDict()
        self._lock = threading.Lock()

    def read(self, file: str, row: int, count: int) -> npt.NDArray[Any]:
        """Consecutive chips of one file.

        Returns:
            (count, 101, 101) uint8 or uint16; 0 is nodata.

        Raises:
            FormatError: the file is not one of chips, or ends before the last of them.
        """
        with self._lock:
            chips = self._find(file)
            size = count * CHIP_SIZE * CHIP_SIZE * chips.dtype.itemsize
            if not 0 <= row <= row + count <= chips.n_chips:
                raise FormatError(
                    f"{file} holds {chips.n_chips} chips; {count} asked for from row {row}"
                )
            start = chips.first_byte + size // max(count, 1) * row
            raw = os.pread(chips.descriptor, size, start)
        if len(raw) != size:
            raise FormatError(f"{file} ends too early: {len(raw)} of {size} bytes from row {row}")
        return np.frombuffer(raw, chips.dtype).reshape(count, CHIP_SIZE, CHIP_SIZE)

    def close(self) -> None:
        """Close all files."""
        with self._lock:
            while self._open:
                os.close(self._open.popitem()[1].descriptor)

    def _find(self, file: str) -> _ChipFile:
        chips = self._open.pop(file, None) or _open_chips(self._storage.path(file))
        self._open[file] = chips
        if len(self._open) > OPEN_CHIP_FILES:
            os.close(self._open.popitem(last=False)[1].descriptor)
        return chips


def _open_chips(path: Path) -> _ChipFile:
    with path.open("rb") as file:
        try:
            version = npy.read_magic(file)
            read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
            shape, fortran, dtype = read_header(file)
        except (ValueError, KeyError) as error:
            raise FormatError(f"{path.name} is not a NumPy file: {error}") from error
        if (
            fortran
            or len(shape) != 3
            or shape[1:] != (CHIP_SIZE, CHIP_SIZE)
            or dtype.str not in ("|u1", "<u2")
        ):
            raise FormatError(f"{path.name} is not a file of chips: shape {shape}, {dtype.str}")
        return _ChipFile(os.open(path, os.O_RDONLY | os.O_CLOEXEC), file.tell(), dtype, shape[0])
