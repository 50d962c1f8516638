"""Files by key in a folder: written completely or not at all, and read by position."""

import fcntl
import os
import shutil
import time
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory, mkstemp
from typing import BinaryIO
from uuid import UUID, uuid4

from amers.app.errors import InputError, NotFound, StorageOutage
from amers.app.outages import outage_of
from amers.app.storage.files import (
    COPY_BYTES,
    UNFINISHED,
    FileReader,
    FileState,
    RangeReader,
    StoredFile,
    Writing,
    checked_key,
    chips_key,
    lock,
    locked,
)
from amers.app.storage.marker import MARKER, Marker, parse_marker
from amers.app.storage.proof import NOT_MOUNTED, Proof


@dataclass(frozen=True)
class Storage:
    """Files below one folder, under keys such as `scenes/ID/scene.tif`.

    A key consists of letters, digits, `_`, `-`, `.` and `/`; none of its parts begins with a dot. Links
    below the folder are not followed. A file appears under its key when it is complete and on the disk.

    Attributes:
        folder: of the files. Only `found` makes it.
        proof: that the folder is that of the installation, which every write needs; None for a folder
            without an installation, as tools have.
    """

    folder: Path
    proof: Proof | None = field(default=None, kw_only=True, compare=False, repr=False)

    def prove(self) -> Hashable:
        """Check that the storage is that of its installation; returns its place in its file system.

        Raises:
            StorageOutage: it is not, as when it is not mounted.
        """
        return self.look() if self.proof is None else self.proof.require(self)

    @contextmanager
    def proven(self) -> Iterator[None]:
        """Write in a context: the storage is proved at its start, at its end, and anew after an error.

        Raises:
            StorageOutage: the storage is not that of its installation.
        """
        self.prove()
        try:
            yield
        except OSError:
            if self.proof is not None:
                self.proof.forget()
                self.prove()
            raise
        self.prove()

    @contextmanager
    def found(self, installation: UUID, *, new: bool = True) -> Iterator[None]:
        """Write the first files of an installation: its marker among them.

        Args:
            installation: that the storage shall belong to.
            new: whether the folder is made if there is none: only at the first start of an installation.

        Raises:
            StorageOutage: there is no such folder, and none is made.
        """
        if new:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        elif self.look() is None:
            raise StorageOutage(f"{self.place}: there is no such folder; mount or make it first")
        with self.proof.granted(self, installation) if self.proof else nullcontext():
            yield

    def look(self) -> Hashable:
        """The folder's place in its file system; None if there is none.

        Raises:
            StorageOutage: the folder cannot be looked at.
        """
        try:
            found = os.stat(self.folder)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise self._outage(error) from error
        return found.st_dev, found.st_ino

    def look_closely(self) -> tuple[Hashable, Marker | None]:
        """The folder's place in its file system, and the marker there.

        Raises:
            InputError: the marker cannot be understood.
            StorageOutage: the folder cannot be read.
        """
        try:
            with opened_folder(self.folder) as folder:
                found = os.fstat(folder)
                place = found.st_dev, found.st_ino
                try:
                    marker = os.open(MARKER, os.O_RDONLY | os.O_CLOEXEC, dir_fd=folder)
                except FileNotFoundError:
                    return place, None
                with os.fdopen(marker, "rb") as file:
                    return place, parse_marker(file.read())
        except (FileNotFoundError, NotADirectoryError):
            return None, None
        except OSError as error:
            raise self._outage(error) from error

    def _outage(self, error: OSError) -> StorageOutage:
        outage = outage_of(error)
        reason = "the storage of files cannot be used" if outage is None else outage.reason
        return StorageOutage(f"{self.place}: {error.strerror or error}", reason)

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
        with self.proven():
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

        Files that stay in it are swept after some hours. Write into it where the storage is `proven`.

        Raises:
            StorageOutage: there is no such folder, and the storage is not that of its installation.
        """
        folder = self.folder / UNFINISHED
        if not folder.is_dir():
            self.prove()
            self._make_scratch()
        return folder

    def unfinished(self, prefix: str) -> list[Path]:
        """The unfinished files whose names begin with a text; none where there is no storage."""
        return list((self.folder / UNFINISHED).glob(f"{prefix}*"))

    def _make_scratch(self) -> None:
        """Make the folder for unfinished files in the proven folder, whatever is mounted meanwhile."""
        if self.proof is None:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        elif self.look() is None:
            raise StorageOutage(f"{self.place}: {NOT_MOUNTED}: there is no such folder", NOT_MOUNTED)
        with opened_folder(self.folder) as folder:
            found = os.fstat(folder)
            if (found.st_dev, found.st_ino) != self.prove():
                raise StorageOutage(f"{self.place}: another folder was mounted meanwhile")
            with suppress(FileExistsError):
                os.mkdir(UNFINISHED, 0o700, dir_fd=folder)

    @contextmanager
    def scratch_folder(self, prefix: str) -> Iterator[Path]:
        """A folder in `scratch` that is deleted at the end of the context, and not swept before.

        Who works in it makes missing folders of a path. After an unmount they lie in the mount point,
        which is left as empty as it was.
        """
        place = self.look()
        try:
            with (
                self.proven(),
                TemporaryDirectory(prefix=prefix, dir=self.scratch()) as folder,
                locked(Path(folder)),
            ):
                yield Path(folder)
        finally:
            with suppress(OSError, StorageOutage):
                # The folder of a storage of another installation stays: that has a marker.
                if self.look() != place and self.look_closely()[1] is None:
                    (self.folder / UNFINISHED).rmdir()

    @contextmanager
    def lasting_folder(self, name: str) -> Iterator[Path]:
        """A folder in `scratch` that stays after the context, and is not swept before its end."""
        with self.proven():
            folder = self.scratch() / name
            folder.mkdir(mode=0o700, exist_ok=True)
            with locked(folder):
                yield folder

    def forget_folder(self, name: str) -> None:
        """Delete a folder of `lasting_folder`, if there is one."""
        for folder in self.unfinished(name):
            self.prove()
            shutil.rmtree(folder, ignore_errors=True)

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
        return FileReader(os.open(self.path(key), os.O_RDONLY | os.O_CLOEXEC))

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
            StorageOutage: the whole storage is missing, or is another one.
        """
        path = self._locate(key)
        if not path.is_file():
            self.prove()
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
        with self.proven():
            path.unlink(missing_ok=True)
        with suppress(OSError):
            while (path := path.parent) != self.folder:
                path.rmdir()

    def move(self, key: str, new_key: str) -> None:
        """Give a file another key; does nothing if there is no such file."""
        path = self._locate(key)
        with self.proven():
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
        for path in self.unfinished(""):
            self.prove()
            with suppress(FileNotFoundError, BlockingIOError):
                if time.time() - path.stat().st_mtime < older_than_s or path.name.startswith(spare):
                    continue
                with locked(path, fcntl.LOCK_EX | fcntl.LOCK_NB):
                    if path.is_dir():
                        shutil.rmtree(path, ignore_errors=True)
                    else:
                        path.unlink()
                swept.append(path.name)
        return swept

    def _place(self, unfinished: Path, key: str) -> None:
        """Move a finished file to its key."""
        path = self._locate(key)
        self.prove()
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        unfinished.replace(path)
        with opened_folder(path.parent) as folder:
            os.fsync(folder)

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
        with self.proven():
            handle, name = mkstemp(dir=self.scratch())
            try:
                with os.fdopen(handle, "wb") as file:
                    lock(file.fileno(), fcntl.LOCK_SH)
                    yield Writing(file, Path(name), limit_bytes)
            finally:
                Path(name).unlink(missing_ok=True)


@contextmanager
def opened_folder(path: Path) -> Iterator[int]:
    """The descriptor of a folder, which stays the same folder whatever is mounted over its path."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield descriptor
    finally:
        os.close(descriptor)
