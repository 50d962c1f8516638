"""Archives of strangers: looked through entirely before a byte of them is written anywhere."""

import errno
import gzip
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, cast

from services.errors import FormatError

ZIP = b"PK\x03\x04"
GZIP = b"\x1f\x8b"
TAR_MAGIC = (257, b"ustar")
HEAD_BYTES = TAR_MAGIC[0] + len(TAR_MAGIC[1])
"""So many bytes of a file tell whether it is an archive."""
COPY_BYTES = 1 << 20
READABLE = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
ENCRYPTED = 1
LONGEST_ZIP_END = 65_535 + 22 + 20 + 56
"""The records at the end of a zip: the end of its index in both forms, a pointer, a comment."""
LARGEST_INDEX_BYTES = 16 << 20
"""Of a zip, which is read as a whole; and of a name in a tar."""
LONGEST_TAR_END = 16 << 20
"""Zeros that fill the last record of a tar: 10 kB as tools write them, more on old tapes."""
BROKEN = (
    zipfile.BadZipFile,
    tarfile.TarError,
    gzip.BadGzipFile,
    zlib.error,
    struct.error,
    EOFError,
    NotImplementedError,
    OverflowError,
    ValueError,
)


@dataclass(frozen=True)
class ArchiveLimits:
    """What an archive may hold.

    Attributes:
        total_bytes: of all members, unpacked.
        members: files and folders.
    """

    total_bytes: int
    members: int = 10_000


@dataclass(frozen=True)
class Member:
    """A file in an archive.

    Attributes:
        path: where it lies in the archive, checked: relative, and nowhere above.
        size_bytes: unpacked, as the archive declares it.
    """

    path: PurePosixPath
    size_bytes: int


def is_archive(head: bytes) -> bool:
    """Whether a file is a zip, a tar or a gzipped tar by its first `HEAD_BYTES` bytes."""
    start, magic = TAR_MAGIC
    return head.startswith((ZIP, GZIP)) or head[start : start + len(magic)] == magic


def check_archive(path: Path, limits: ArchiveLimits) -> tuple[Member, ...]:
    """The files of an archive, once all that it declares has been checked; nothing is written.

    Raises:
        FormatError: no archive, a broken one, or one with a member that may not be: an absolute path,
            `..`, a link, a device, an encrypted file, the same name twice; too many members, or too
            large ones.
    """
    with _opened(path) as archive:
        members = []
        total = 0
        for number, found in enumerate(archive.look(), start=1):
            if number > limits.members:
                raise FormatError(
                    f"{path.name} holds more than {limits.members} members, the most accepted"
                )
            total += found.size_bytes
            if total > limits.total_bytes:
                raise FormatError(
                    f"{path.name} unpacks to more than {limits.total_bytes} bytes, the most accepted"
                )
            members.append(found)
    names = [str(member.path).lower() for member in members]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise FormatError(f"{path.name} holds {twice[:200]} twice")
    return tuple(members)


def unpack_archive(path: Path, members: dict[PurePosixPath, Path], limits: ArchiveLimits) -> None:
    """Write some files of an archive that was checked, each to a place of the caller's choice.

    Args:
        members: path in the archive to the file to write, whose folder exists.

    Raises:
        FormatError: a file is not as declared, or not there.
    """
    with _opened(path) as archive:
        left = dict(members)
        room = limits.total_bytes
        for member, file in archive.read(set(left)):
            room = _copy(file, left.pop(member), room, path.name)
    if left:
        raise FormatError(f"{path.name}: {next(iter(left))} is not in it")


def _copy(file: IO[bytes], target: Path, room: int, name: str) -> int:
    with target.open("xb") as out:
        while chunk := file.read(COPY_BYTES):
            room -= len(chunk)
            if room < 0:
                raise FormatError(f"{name} unpacks to more than it declares")
            out.write(chunk)
    return room


def _checked(name: str, archive: str) -> PurePosixPath:
    """The path of a member that stays where it is unpacked."""
    path = PurePosixPath(name)
    if (
        not path.parts
        or path.is_absolute()
        or ".." in path.parts
        or "\\" in name
        or not name.isprintable()
        or ":" in path.parts[0]
        or len(name) > 1000
    ):
        raise FormatError(
            f"{archive} holds a member with the path {name[:200]!r}, which is not accepted"
        )
    return path


@dataclass(frozen=True)
class _Archive:
    """An open archive: looks at its files, reads some of them."""

    look: Callable[[], Iterator[Member]]
    read: Callable[[set[PurePosixPath]], Iterator[tuple[PurePosixPath, IO[bytes]]]]


@contextmanager
def _opened(path: Path) -> Iterator[_Archive]:
    """The archive; whatever is wrong inside becomes a FormatError that names it."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    try:
        if head.startswith(ZIP):
            _refuse_large_index(path)
            with zipfile.ZipFile(path) as zipped:
                yield _zip(zipped, path.name)
        elif is_archive(head):
            with _plain(path, head) as raw:
                bounded = _Bounded(raw, path.name)
                with tarfile.open(fileobj=cast(IO[bytes], bounded), mode="r:") as tarred:
                    yield _tar(tarred, bounded, path.name)
        else:
            raise FormatError(f"{path.name} is neither a zip nor a tar")
    except BROKEN as error:
        raise FormatError(f"{path.name} is a broken archive: {error}") from error
    except OSError as error:
        if error.errno == errno.EINVAL:
            # A zip whose index points before its beginning.
            raise FormatError(f"{path.name} is a broken archive: {error}") from error
        raise


@contextmanager
def _plain(path: Path, head: bytes) -> Iterator[IO[bytes]]:
    """A file, without its gzip."""
    with path.open("rb") as file:
        if head.startswith(GZIP):
            with gzip.open(file) as unpacked:
                yield cast(IO[bytes], unpacked)
        else:
            yield file


class _Bounded:
    """A file that is never read in large pieces: the headers of a tar say how much of it is read.

    Attributes:
        last: the piece read last.
    """

    def __init__(self, file: IO[bytes], name: str) -> None:
        self.seek, self.tell = file.seek, file.tell
        self.last = b""
        self._file = file
        self._name = name

    def read(self, size: int) -> bytes:
        """So many bytes."""
        if size > LARGEST_INDEX_BYTES:
            raise FormatError(f"{self._name} holds a header of {size} bytes, which is not accepted")
        self.last = self._file.read(size)
        return self.last


def _refuse_large_index(path: Path) -> None:
    """Look how large the index of a zip is before it is read: the last records of the file say so."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - LONGEST_ZIP_END, 0))
        tail = file.read()
    sizes = [
        struct.unpack_from(form, tail, at + offset)[0]
        for record, form, offset in ((b"PK\5\6", "<L", 12), (b"PK\6\6", "<Q", 40))
        if 0 <= (at := tail.rfind(record)) <= len(tail) - offset - struct.calcsize(form)
    ]
    declared = max((size for size in sizes if size != 0xFFFFFFFF), default=0)
    if declared > LARGEST_INDEX_BYTES:
        raise FormatError(f"{path.name} has an index of {declared} bytes, which is not accepted")


def _zip(archive: zipfile.ZipFile, name: str) -> _Archive:
    def look() -> Iterator[Member]:
        for info in archive.infolist():
            path = _checked(info.filename, name)
            kind = stat.S_IFMT(info.external_attr >> 16)
            if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise FormatError(f"{name}: {path} is a link or a device, which is not accepted")
            if info.flag_bits & ENCRYPTED or info.compress_type not in READABLE:
                raise FormatError(f"{name}: {path} is encrypted, or compressed other than by deflate")
            if not info.is_dir():
                yield Member(path, info.file_size)

    def read(wanted: set[PurePosixPath]) -> Iterator[tuple[PurePosixPath, IO[bytes]]]:
        for info in archive.infolist():
            path = PurePosixPath(info.filename)
            if path in wanted and not info.is_dir():
                with archive.open(info) as file:
                    yield path, file

    return _Archive(look, read)


def _refuse_open_end(file: _Bounded, name: str) -> None:
    """Look how a tar ends, where its reader found no further header.

    The reader stops alike at the end, at a header that is broken and where the file is cut; only the
    first is a block of zeros with nothing behind it but more of them.
    """
    if len(file.last) < tarfile.BLOCKSIZE or any(file.last):
        raise FormatError(f"{name} is a broken archive: it is cut, or the header of a member is broken")
    for _ in range(LONGEST_TAR_END // COPY_BYTES):
        if any(file.read(COPY_BYTES)):
            raise FormatError(f"{name} is a broken archive: something follows its end")
        if not file.last:
            return
    raise FormatError(f"{name} is followed by more than {LONGEST_TAR_END} bytes, which is not accepted")


def _tar(archive: tarfile.TarFile, opened: _Bounded, name: str) -> _Archive:
    def look() -> Iterator[Member]:
        for info in archive:
            path = _checked(info.name, name) if info.name != "." else PurePosixPath()
            if not (info.isreg() or info.isdir()) or info.issparse():
                raise FormatError(f"{name}: {path} is a link, a device or sparse, which is not accepted")
            if info.isreg():
                yield Member(path, info.size)
        _refuse_open_end(opened, name)

    def read(wanted: set[PurePosixPath]) -> Iterator[tuple[PurePosixPath, IO[bytes]]]:
        for info in archive:
            path = PurePosixPath(info.name)
            if path in wanted and info.isreg():
                file = archive.extractfile(info)
                assert file is not None
                yield path, file

    return _Archive(look, read)
