"""Read every stored file and compare it with its checksum; replace damaged files by copies."""

import errno
import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import BinaryIO, Literal
from uuid import UUID

import numpy as np

from amers.app.config import Settings
from amers.app.db import blocks, references, stored_files
from amers.app.db.engine import Database
from amers.app.db.stored_files import NamedFile
from amers.app.errors import NotFound
from amers.app.storage import Storage, trash
from amers.app.storage.chips import damage_of_rows
from amers.app.storage.content import READ_BYTES, Content, read_content
from amers.app.usecases import garbage_collection
from amers.app.usecases.installation import Installation
from amers.services.formats.chips.checksums import CHECKSUM
from amers.services.types import Progress

POINTS_NAMED = 10
MEGABYTE = 1e6

State = Literal["rotten", "missing", "unknown"]


@dataclass(frozen=True)
class Finding:
    """A file that is not as it should be.

    Attributes:
        key: of the file in the storage; of a reference, its path below AMERS_REFERENCE_FOLDER.
        kind: chips, scene image, side file, upload archive, result or reference; none if unknown.
        state: rotten: not the bytes that were stored; missing; or unknown: no row names it.
        detail: what is wrong.
        n_points: number of points whose chips are damaged.
        first_points: ids of the first of these points.
        repaired: whether the file is whole again.
    """

    key: str
    kind: str
    state: State
    detail: str
    n_points: int = 0
    first_points: tuple[int, ...] = ()
    repaired: bool = False


@dataclass(frozen=True)
class Verification:
    """The outcome of a verification.

    Attributes:
        n_files, size_bytes: that were read.
        n_recorded: files without a recorded checksum, whose checksum was recorded.
        findings: files that no row names come last.
    """

    n_files: int
    size_bytes: int
    n_recorded: int
    findings: tuple[Finding, ...]

    @property
    def is_whole(self) -> bool:
        """Whether all files are as they should be, or were repaired."""
        return all(finding.repaired for finding in self.findings)


@dataclass
class _Pace:
    """Limits the rate of reading, and reports the progress."""

    bytes_per_s: float
    total_bytes: int
    progress: Progress
    read_bytes: int = 0
    started: float = field(default_factory=time.monotonic)

    def count(self, key: str, size_bytes: int) -> None:
        """Count bytes that were read, and wait until they are due."""
        self.read_bytes += size_bytes
        self.progress(min(self.read_bytes / max(self.total_bytes, 1), 1.0), key)
        time.sleep(max(self.started + self.read_bytes / self.bytes_per_s - time.monotonic(), 0.0))


@dataclass
class _Verifier:
    """Verifies files one after the other.

    Attributes:
        installation: whose files they are.
        copies: folder with copies of the files under their keys, to repair from; None repairs nothing.
        n_recorded: files whose checksum was recorded so far.
    """

    installation: Installation
    copies: Path | None
    n_recorded: int = 0

    @property
    def database(self) -> Database:
        """Of the installation."""
        return self.installation.database

    @property
    def storage(self) -> Storage:
        """Of the installation."""
        return self.installation.storage

    def check(self, file: NamedFile, pace: _Pace) -> Finding | None:
        """What is wrong with a file; None if nothing, or if no row names it any more."""
        finding = self._check(file, partial(pace.count, file.storage_key))
        if finding is None or file.kind == "reference":
            return finding
        with self.database.reading() as connection:
            is_named = bool(stored_files.read_named_files(connection, [file.storage_key]))
        if not is_named:
            return None
        return self._repaired(file, finding) if self.copies and not finding.repaired else finding

    def _check(self, file: NamedFile, count: Callable[[int], None]) -> Finding | None:
        try:
            with self._open(file) as opened:
                content = read_content(opened, count, of_chips=file.kind == "chips")
        except (NotFound, FileNotFoundError):
            return Finding(file.storage_key, file.kind, "missing", "not in its place")
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            return self._rotten(file, "the disk cannot read it", None)
        if file.sha256 is None:
            self._record(file, content)
            return None
        if content.sha256 != file.sha256:
            detail = f"its SHA-256 is {content.sha256}, {file.sha256} expected"
            return self._rotten(file, detail, content)
        return self._check_recorded(file, content)

    def _open(self, file: NamedFile) -> BinaryIO:
        if file.kind != "reference":
            return self.storage.open(file.storage_key)
        folder = self.installation.settings.reference_folder
        if folder is None:
            raise FileNotFoundError("AMERS_REFERENCE_FOLDER is not set")
        return (folder / file.storage_key).open("rb")

    def _rotten(self, file: NamedFile, detail: str, content: Content | None) -> Finding:
        finding = Finding(file.storage_key, file.kind, "rotten", detail)
        if file.kind != "chips":
            return finding
        with self.database.transaction() as connection:
            recorded = stored_files.find_chip_checksums(connection, file.storage_key)
            rows = _damaged_rows(recorded, content)
            points = stored_files.points_of_chips(connection, file.storage_key, rows)
        if rows is not None and recorded is not None:
            count = len(recorded) // CHECKSUM.itemsize
            detail = damage_of_rows(rows, count) if rows else "damaged outside of its chips"
        return replace(
            finding,
            detail=detail,
            n_points=len(points),
            first_points=tuple(points[:POINTS_NAMED]),
        )

    def _check_recorded(self, file: NamedFile, content: Content) -> Finding | None:
        """Record the checksums of the chips of a file that is whole, unless the same are recorded."""
        if content.chip_checksums is None:
            return None
        checksums = content.chip_checksums.tobytes()
        with self.database.transaction() as connection:
            recorded = stored_files.find_chip_checksums(connection, file.storage_key)
            if recorded == checksums:
                return None
            stored_files.record_chip_checksums(connection, file.storage_key, checksums)
        if recorded is None:
            self.n_recorded += 1
            return None
        detail = "the file is whole, but the recorded checksums of its chips were not; recorded again"
        return Finding(file.storage_key, file.kind, "rotten", detail, repaired=True)

    def _record(self, file: NamedFile, content: Content) -> None:
        """Record the checksum of a file that an earlier version stored without one."""
        key, sha256 = file.storage_key, content.sha256
        with self.database.transaction() as connection:
            if file.kind == "reference":
                references.record_checksum(connection, key, sha256)
            elif file.kind == "result":
                job_id = UUID(key.split("/")[1])
                stored_files.record_result(connection, job_id, key, content.size_bytes, sha256)
            elif file.kind == "upload archive":
                stored_files.record_upload_checksum(connection, key, sha256)
        self.n_recorded += 1

    def _repaired(self, file: NamedFile, finding: Finding) -> Finding:
        """The finding after an attempt to replace the file by its copy."""
        assert self.copies is not None
        copy = self.copies / file.storage_key
        if not copy.is_file():
            return replace(finding, detail=f"{finding.detail}; {self.copies} has no copy of it")
        if file.sha256 is None or _sha256(copy) != file.sha256:
            return replace(finding, detail=f"{finding.detail}; the copy in {self.copies} differs too")
        with self.database.transaction() as connection:
            moment = garbage_collection.moment(connection)
        with self.storage.writing(file.storage_key) as writing:
            for piece in _pieces(copy):
                writing.write(piece)
            trash.discard(self.storage, [file.storage_key], moment)
        return replace(finding, repaired=True)


def verify_store(
    installation: Installation, progress: Progress, rate_mb_s: float, copies: Path | None = None
) -> Verification:
    """Read all files that rows name, and compare each with its checksum.

    Records the checksums of files that have none, and which files are damaged, for the metrics.

    Args:
        installation: whose files are read.
        progress: receives the fraction done and the key of a file.
        rate_mb_s: limit of the rate of reading, megabytes per second.
        copies: a folder with files under the same keys, or a backup or data folder, which have them in
            `storage`. A rotten or missing file is replaced by its copy there if that has the right
            checksum; the rotten one goes to the trash.
    """
    if copies is not None and (copies / "storage").is_dir():
        copies = copies / "storage"
    database = installation.database
    with database.reading() as connection:
        named = stored_files.read_named_files(connection)
        named += references.read_reference_files(connection)
    total_bytes = sum(_size(installation.settings, file) for file in named)
    pace = _Pace(rate_mb_s * MEGABYTE, total_bytes, progress)
    verifier = _Verifier(installation, copies)
    findings = []
    for file in named:
        finding = verifier.check(file, pace)
        with database.transaction() as connection:
            if finding is None or finding.repaired:
                stored_files.forget_damage(connection, file.storage_key)
            else:
                stored_files.record_damage(connection, file.storage_key, finding.detail)
        if finding is not None:
            findings.append(finding)
    with database.transaction() as connection:
        stored_files.forget_unnamed_damage(connection, [file.storage_key for file in named])
    findings += _unknown(database, installation.storage)
    return Verification(len(named), pace.read_bytes, verifier.n_recorded, tuple(findings))


def _damaged_rows(recorded: bytes | None, content: Content | None) -> list[int] | None:
    """The rows of the chips that do not have their recorded checksums; None if that is unknown."""
    if recorded is None or content is None or content.chip_checksums is None:
        return None
    expected, computed = np.frombuffer(recorded, CHECKSUM), content.chip_checksums
    both = min(len(expected), len(computed))
    rows: list[int] = np.flatnonzero(expected[:both] != computed[:both]).tolist()
    return [*rows, *range(both, len(expected))]


def _unknown(database: Database, storage: Storage) -> list[Finding]:
    """Files without a row, except files that are being written and files that the sweep removes."""
    with database.transaction() as connection:
        blocks.lock_sweep(connection)
        families = garbage_collection.compare_files(connection, storage)
        keys = [key for family in families for key in storage.keys(family.name)]
        in_progress = stored_files.folders_in_progress(connection)
    with database.reading() as connection:
        named = {file.storage_key for file in stored_files.read_named_files(connection)}
    expected = named.union(*(family.given_up for family in families))
    return [
        Finding(key, "", "unknown", "no row names it")
        for key in keys
        if key not in expected and key.rsplit("/", 1)[0] not in in_progress
    ]


def _size(settings: Settings, file: NamedFile) -> int:
    """The size of a file in bytes; 0 if unknown."""
    if file.kind != "reference" or settings.reference_folder is None:
        return file.size_bytes or 0
    path = settings.reference_folder / file.storage_key
    return path.stat().st_size if path.is_file() else 0


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _pieces(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while piece := file.read(READ_BYTES):
            yield piece
