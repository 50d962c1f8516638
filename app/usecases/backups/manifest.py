"""The manifest of a backup: every file with its size and SHA-256; the check of a backup."""

import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from uuid import UUID

from amers.app.errors import InputError
from amers.services.types import Progress, no_progress

MANIFEST = "manifest.json"
ARCHIVE = "database.dump"
STORAGE = "storage"
FORMAT = 1
READ_BYTES = 1 << 20


@dataclass(frozen=True)
class BackupFile:
    """A file of a backup.

    Attributes:
        path: below the folder of the backup, with `/` between its parts.
        sha256: in hexadecimal.
    """

    path: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class Difference:
    """A file of the storage that was not as the database of the backup has it."""

    key: str
    reason: str


@dataclass(frozen=True)
class Manifest:
    """What a backup contains.

    Attributes:
        created_at: of the state of the database, ISO 8601.
        installation: id of the installation.
        generation: of the storage, as the database of the backup has it.
        revision: of the schema of the database.
        files: all files but the manifest, by path.
        damaged: files of the storage that were damaged or missing.
        outdated: files that were removed or replaced on purpose while the backup was made.
    """

    created_at: str
    installation: UUID
    generation: int
    revision: str
    files: list[BackupFile]
    damaged: list[Difference]
    outdated: list[Difference]

    @property
    def size_bytes(self) -> int:
        """The size of all files."""
        return sum(file.size_bytes for file in self.files)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest of a backup and bring it to the disk."""
    content = {"format": FORMAT, **asdict(manifest), "installation": str(manifest.installation)}
    document = {**content, "sha256": _checksum(content)}
    with (folder / MANIFEST).open("x") as file:
        json.dump(document, file, indent=1)
        file.flush()
        os.fsync(file.fileno())


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a backup.

    Raises:
        InputError: the folder has none, or it is damaged.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise InputError(f"{folder} is no backup: it has no {MANIFEST}")
    try:
        document: dict[str, Any] = json.loads(path.read_bytes())
        if document.pop("sha256") != _checksum(document):
            raise ValueError("its checksum is another one")
        if document.pop("format") != FORMAT:
            raise ValueError(f"it has not the format {FORMAT}")
        return Manifest(
            **{
                **document,
                "installation": UUID(document["installation"]),
                "files": [BackupFile(**file) for file in document["files"]],
                "damaged": [Difference(**item) for item in document["damaged"]],
                "outdated": [Difference(**item) for item in document["outdated"]],
            }
        )
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path} is damaged: {error}") from error


def find_problems(folder: Path, manifest: Manifest, progress: Progress = no_progress) -> list[str]:
    """What is missing, surplus or changed in a backup; reads all of its files."""
    expected = {file.path: file for file in manifest.files}
    present = set(_paths(folder))
    problems = [f"{path}: surplus, the manifest does not name it" for path in present - set(expected)]
    problems += [f"{path}: missing" for path in set(expected) - present]
    read_bytes = 0
    for path in sorted(present & set(expected)):
        progress(read_bytes / max(manifest.size_bytes, 1), path)
        problem = _compare(folder / path, expected[path])
        if problem is not None:
            problems.append(f"{path}: {problem}")
        read_bytes += expected[path].size_bytes
    return sorted(problems)


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _compare(path: Path, expected: BackupFile) -> str | None:
    if path.is_symlink() or not path.is_file():
        return "it is no regular file"
    if path.stat().st_size != expected.size_bytes:
        return f"changed: {path.stat().st_size} bytes found, {expected.size_bytes} expected"
    sha256 = sha256_of(path)
    return None if sha256 == expected.sha256 else f"changed: its SHA-256 is {sha256}"


def _paths(folder: Path) -> Iterator[str]:
    """The paths of all files of a backup but the manifest; links are not followed."""
    for root, folders, files in os.walk(folder):
        links = [name for name in folders if (Path(root) / name).is_symlink()]
        for name in [*files, *links]:
            path = (Path(root) / name).relative_to(folder).as_posix()
            if path != MANIFEST:
                yield path


def _checksum(content: dict[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
