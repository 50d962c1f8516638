"""Archives from untrusted users: all members are checked before any byte is written."""

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

from amers.services.errors import FormatError

ZIP = b"PK\x03\x04"
GZIP = b"\x1f\x8b"
TAR_MAGIC = (257, b"ustar")
HEAD_BYTES = TAR_MAGIC[0] + len(TAR_MAGIC[1])
"""Bytes at the start of a file that show whether it is an archive."""
COPY_BYTES = 1 << 20
READABLE = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
ENCRYPTED = 1
"""Flag bit of an encrypted member of a zip."""
LONGEST_ZIP_END = 65_535 + 22 + 20 + 56
"""Bytes of the records at the end of a zip: two end records, a locator and a comment."""
LARGEST_INDEX_BYTES = 16 << 20
"""Largest index of a zip, which is read as a whole, and largest header of a tar."""
LONGEST_TAR_END = 16 << 20
"""Zeros that may fill the last record of a tar: tools write 10 kB, old tapes have more."""
MOST_EXPANSION = 100
"""Unpacked bytes for each byte of an archive: images and text reach 10, zeros a thousand."""
ALWAYS_UNPACKED_BYTES = 256 << 20
"""What an archive may unpack to however small it is: half a second of work."""
DAMAGE_ERRORS = (
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
    """The limits that an archive must keep.

    Attributes:
        total_bytes: size of all members, unpacked.
        members: number of files and folders.
    """

    total_bytes: int
    members: int = 10_000


@dataclass(frozen=True)
class Member:
    """A file in an archive.

    Attributes:
        path: in the archive; relative and without `..`.
        size_bytes: unpacked size that the archive declares.
    """

    path: PurePosixPath
    size_bytes: int


def is_archive(head: bytes) -> bool:
    """Whether the first `HEAD_BYTES` of a file are those of a zip, a tar or a gzipped tar."""
    start, magic = TAR_MAGIC
    return head.startswith((ZIP, GZIP)) or head[start : start + len(magic)] == magic


def check_archive(path: Path, limits: ArchiveLimits) -> tuple[Member, ...]:
    """The files of an archive, after a check of all its members; nothing is written.

    Raises:
        FormatError: the file is not an archive or is damaged; it exceeds the limits; or it has a member
            with an absolute path, `..`, a link, a device, encryption, or a name that occurs twice.
    """
    expanded = max(MOST_EXPANSION * path.stat().st_size, ALWAYS_UNPACKED_BYTES)
    with _open_archive(path) as archive:
        members = []
        total = 0
        for number, member in enumerate(archive.list_members(), start=1):
            if number > limits.members:
                raise FormatError(
                    f"{path.name}: more than {limits.members} members found, which is the limit"
                )
            total += member.size_bytes
            if total > limits.total_bytes:
                raise FormatError(
                    f"{path.name}: unpacks to more than {limits.total_bytes} bytes, which is the limit"
                )
            if total > expanded:
                raise FormatError(
                    f"{path.name}: declares {total} bytes or more in {path.stat().st_size} bytes; at "
                    f"most {MOST_EXPANSION} bytes for each byte of the archive, or "
                    f"{ALWAYS_UNPACKED_BYTES} bytes in all, are accepted"
                )
            members.append(member)
    names = [str(member.path).lower() for member in members]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise FormatError(f"{path.name}: {twice[:200]} found twice, each name once expected")
    return tuple(members)


def unpack_archive(path: Path, members: dict[PurePosixPath, Path], limits: ArchiveLimits) -> None:
    """Write some files of an archive, each to a path of the caller's choice.

    Args:
        path: of an archive that `check_archive` accepted.
        members: for each path in the archive the file to write, in an existing folder.
        limits: as given to `check_archive`.

    Raises:
        FormatError: a file is missing, or larger than declared.
    """
    with _open_archive(path) as archive:
        missing = dict(members)
        budget_bytes = limits.total_bytes
        for member, file in archive.read_members(set(missing)):
            budget_bytes = _copy(file, missing.pop(member), budget_bytes, path.name)
    if missing:
        raise FormatError(f"{path.name}: {next(iter(missing))} expected, no such file in the archive")


def _copy(file: IO[bytes], target: Path, budget_bytes: int, name: str) -> int:
    """Copy a member; returns the bytes that the other members may still have."""
    with target.open("xb") as out:
        while chunk := file.read(COPY_BYTES):
            budget_bytes -= len(chunk)
            if budget_bytes < 0:
                raise FormatError(f"{name}: unpacks to more bytes than it declares")
            out.write(chunk)
    return budget_bytes


def _member_path(name: str, archive: str) -> PurePosixPath:
    """The path of a member, relative and without `..`."""
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
            f"{archive}: the path {name[:200]!r} of a member is not accepted, "
            "relative paths without .. expected"
        )
    return path


@dataclass(frozen=True)
class _Archive:
    """An open archive: a function that lists its files, and one that reads some of them."""

    list_members: Callable[[], Iterator[Member]]
    read_members: Callable[[set[PurePosixPath]], Iterator[tuple[PurePosixPath, IO[bytes]]]]


@contextmanager
def _open_archive(path: Path) -> Iterator[_Archive]:
    """Open an archive; errors while it is used become a FormatError with its name."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    try:
        if head.startswith(ZIP):
            _refuse_large_index(path)
            with zipfile.ZipFile(path) as zipped:
                yield _zip_archive(zipped, path.name)
        elif is_archive(head):
            with _decompressed(path, head) as raw:
                bounded = _BoundedReader(raw, path.name)
                with tarfile.open(fileobj=cast(IO[bytes], bounded), mode="r:") as tarred:
                    yield _tar_archive(tarred, bounded, path.name)
        else:
            raise FormatError(f"{path.name}: another kind of file found, a zip or a tar expected")
    except DAMAGE_ERRORS as error:
        raise FormatError(f"{path.name}: broken archive: {error}") from error
    except OSError as error:
        if error.errno == errno.EINVAL:
            # The index of a zip may point before its first byte.
            raise FormatError(f"{path.name}: broken archive: {error}") from error
        raise


@contextmanager
def _decompressed(path: Path, head: bytes) -> Iterator[IO[bytes]]:
    """Open a file, through gzip when it is compressed."""
    with path.open("rb") as file:
        if head.startswith(GZIP):
            with gzip.open(file) as unpacked:
                yield cast(IO[bytes], unpacked)
        else:
            yield file


class _BoundedReader:
    """A file that refuses large reads, whose sizes a tar reader takes from untrusted headers.

    Attributes:
        last: the bytes read last.
    """

    def __init__(self, file: IO[bytes], name: str) -> None:
        self.seek, self.tell = file.seek, file.tell
        self.last = b""
        self._file = file
        self._name = name

    def read(self, size: int) -> bytes:
        """Read `size` bytes."""
        if size > LARGEST_INDEX_BYTES:
            raise FormatError(
                f"{self._name}: a header of {size} bytes found, at most {LARGEST_INDEX_BYTES} accepted"
            )
        self.last = self._file.read(size)
        return self.last


def _refuse_large_index(path: Path) -> None:
    """Refuse a zip whose end records declare an index too large to be read."""
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
        raise FormatError(
            f"{path.name}: an index of {declared} bytes found, at most {LARGEST_INDEX_BYTES} accepted"
        )


def _zip_archive(archive: zipfile.ZipFile, name: str) -> _Archive:
    def list_members() -> Iterator[Member]:
        for info in archive.infolist():
            path = _member_path(info.filename, name)
            kind = stat.S_IFMT(info.external_attr >> 16)
            if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise FormatError(
                    f"{name}: {path} is a link or a device, plain files and folders expected"
                )
            if info.flag_bits & ENCRYPTED or info.compress_type not in READABLE:
                raise FormatError(
                    f"{name}: {path} is encrypted or compressed by another method than deflate; "
                    "pack it without password, by deflate"
                )
            if not info.is_dir():
                yield Member(path, info.file_size)

    def read_members(wanted: set[PurePosixPath]) -> Iterator[tuple[PurePosixPath, IO[bytes]]]:
        for info in archive.infolist():
            path = PurePosixPath(info.filename)
            if path in wanted and not info.is_dir():
                with archive.open(info) as file:
                    yield path, file

    return _Archive(list_members, read_members)


def _refuse_open_end(file: _BoundedReader, name: str) -> None:
    """Refuse a tar that does not end with zeros where its reader found no further header.

    The reader stops in the same way at the end, at a damaged header and where the file is truncated;
    only the end is a block of zeros followed by nothing but zeros.
    """
    if len(file.last) < tarfile.BLOCKSIZE or any(file.last):
        raise FormatError(f"{name}: broken archive: truncated, or the header of a member is damaged")
    for _ in range(LONGEST_TAR_END // COPY_BYTES):
        if any(file.read(COPY_BYTES)):
            raise FormatError(f"{name}: broken archive: data found after its end")
        if not file.last:
            return
    raise FormatError(
        f"{name}: more than {LONGEST_TAR_END} bytes found after its end, which is the limit"
    )


def _tar_archive(archive: tarfile.TarFile, opened: _BoundedReader, name: str) -> _Archive:
    def list_members() -> Iterator[Member]:
        for info in archive:
            path = _member_path(info.name, name) if info.name != "." else PurePosixPath()
            if not (info.isreg() or info.isdir()) or info.issparse():
                raise FormatError(
                    f"{name}: {path} is a link, a device or sparse, plain files and folders expected"
                )
            if info.isreg():
                yield Member(path, info.size)
        _refuse_open_end(opened, name)

    def read_members(wanted: set[PurePosixPath]) -> Iterator[tuple[PurePosixPath, IO[bytes]]]:
        for info in archive:
            path = PurePosixPath(info.name)
            if path in wanted and info.isreg():
                file = archive.extractfile(info)
                assert file is not None
                yield path, file

    return _Archive(list_members, read_members)
