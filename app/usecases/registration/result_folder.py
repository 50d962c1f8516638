"""The folder of a result, which holds the older result or the new one, whole.

A result is written into a work folder beside its place, `.NAME.amers-work`, and put in its place by one
rename. Where an older result stands there, the kernel exchanges the two folders in one step
(`renameat2`, RENAME_EXCHANGE). A file system that cannot exchange folders gets two renames; a kill
between them leaves both results whole in the work folder, and the next run puts the older one back.

The manifest of a result states its files with their checksums. Only a folder that holds exactly these
files is replaced.
"""

import ctypes
import errno
import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import file_digest
from pathlib import Path
from typing import Any

from amers.app.errors import InputError, is_no_room

MANIFEST = "manifest.json"
RESULT_FORMAT = "amers-result/1"
OPENED_BY_OTHERS = (".gpkg",)
"""Suffixes of files that other programs change when they only show them: content is not compared."""

_LOCK = "lock"
_NEW, _OLD = "new", "old"
_AT_FDCWD = -100
_RENAME_EXCHANGE = 2
_CANNOT_EXCHANGE = (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP)
_MOST_LOCKS = 100
"""Times that the lock of a folder is taken anew, because another command has replaced it meanwhile."""
_CANNOT_LOCK = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@dataclass(frozen=True)
class OlderResult:
    """A result that stands in a folder.

    Attributes:
        scene: that it is of.
        written_at: when it was put there.
        verdict: on its registration.
    """

    scene: str
    written_at: datetime
    verdict: str


def older_result(folder: Path) -> OlderResult | None:
    """The result that a new one would replace; None when the folder is free.

    Raises:
        InputError: the folder cannot be written or replaced; the message says what to do.
    """
    with _working_beside(folder):
        return _replaceable(folder)


@contextmanager
def replacing(folder: Path, report: str = "report.json") -> Iterator[Path]:
    """A new empty folder, which takes the place of `folder` at the end of the context.

    Its report must state what the result is of (the scene, the block, or the catalogue of a selection)
    and the verdict. An exception leaves `folder` as it is.

    Args:
        folder: that the result takes.
        report: name of the report in it, a JSON document.

    Raises:
        InputError: the folder cannot be written or replaced.
    """
    with _working_beside(folder) as work:
        with _refusing(folder):
            _replaceable(folder)
            (work / _NEW).mkdir()
        yield work / _NEW
        with _refusing(folder):
            _write_manifest(work / _NEW, report)
            _sync_files(work / _NEW)
            # The registration took its time: somebody may have put a file into the folder.
            has_older = _replaceable(folder) is not None
            _put_in_place(work, folder.resolve(), has_older=has_older)


@contextmanager
def _working_beside(folder: Path) -> Iterator[Path]:
    """The work folder beside the place of a result, for this process alone; cleared of earlier work."""
    with _refusing(folder):
        place = folder.resolve()
        _refuse_fixed(folder, place)
        work = place.with_name(f".{place.name}.amers-work")
        lock = _locked(folder, work)
    try:
        with _refusing(folder):
            _recover(place, work)
        yield work
    finally:
        with _refusing(folder):
            _recover(place, work)
            (work / _LOCK).unlink()
            with suppress(OSError):
                work.rmdir()
            os.close(lock)


@contextmanager
def _refusing(folder: Path) -> Iterator[None]:
    """Turn errors of the file system into a refusal of the folder."""
    try:
        yield
    except OSError as error:
        if is_no_room(error):
            raise
        raise InputError(
            f"{folder}: cannot be written ({error.strerror}: {error.filename}); name a folder "
            "with -o that you may create and replace"
        ) from error


def _refuse_fixed(folder: Path, place: Path) -> None:
    """Refuse a folder that cannot be replaced by a rename, or not without surprise."""
    if place.exists() and not place.is_dir():
        raise InputError(f"{folder}: is a file, a folder expected; name another folder with -o")
    inside = folder / "registered"
    if Path.cwd().is_relative_to(place):
        raise InputError(
            f"{folder}: is the working folder or contains it, and a result replaces its whole folder; "
            f"name a folder inside it: -o {inside}"
        )
    if place.is_mount():
        raise InputError(
            f"{folder}: is the root of a volume, and a result replaces its whole folder; name a folder "
            f"inside it: -o {inside}"
        )


def _locked(folder: Path, work: Path) -> int:
    """Create and lock a work folder; returns the descriptor of its lock.

    Raises:
        InputError: another process works in it, or it was not made by Amers.
    """
    for _ in range(_MOST_LOCKS):
        work.mkdir(parents=True, exist_ok=True)
        if not (work / _LOCK).exists() and any(work.iterdir()):
            raise InputError(f"{work}: contains files that Amers did not write; move this folder away")
        try:
            lock = os.open(work / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(lock)
            raise InputError(
                f"{folder}: another command writes its result there; wait for its end, or name another "
                "folder with -o"
            ) from None
        except OSError as error:
            if error.errno not in _CANNOT_LOCK:
                os.close(lock)
                raise
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(lock), (work / _LOCK).stat()):
                return lock
        os.close(lock)
    raise InputError(
        f"{work}: its lock cannot be kept: other commands replace the folder again and again, or its "
        "file system gives a file another number each time; name a folder on another one with -o"
    )


def _recover(place: Path, work: Path) -> None:
    """Put back an older result that lost its place, and delete what work that broke off has left."""
    if (work / _OLD).exists():
        if place.exists():
            _delete_result(work / _OLD)
        else:
            (work / _OLD).rename(place)
    if (work / _NEW).exists():
        shutil.rmtree(work / _NEW)


def _put_in_place(work: Path, place: Path, *, has_older: bool) -> None:
    """Move the new result to its place, and delete the older one that stood there."""
    if not has_older:
        (work / _NEW).rename(place)
    elif _exchange(work / _NEW, place):
        (work / _NEW).rename(work / _OLD)
    else:
        place.rename(work / _OLD)
        (work / _NEW).rename(place)
    _sync(place.parent)
    if has_older:
        _delete_result(work / _OLD)


def _replaceable(folder: Path) -> OlderResult | None:
    """The result in a folder, which must hold nothing else; None when the folder is missing or empty.

    Raises:
        InputError: it holds other files, or files that were changed since.
    """
    found = {path.name: path for path in folder.iterdir()} if folder.exists() else {}
    if not found:
        return None
    manifest = _read_manifest(folder)
    if manifest is None:
        raise InputError(
            f"{folder}: contains files, but no {MANIFEST} that identifies them as a result of Amers; "
            "name an empty or new folder with -o"
        )
    files = manifest["files"]
    foreign = sorted(set(found) - set(files) - {MANIFEST})
    if foreign:
        raise InputError(
            f"{folder}: contains {_listed(foreign)} in addition to the result; these files would be "
            "lost: move them away, or name another folder with -o"
        )
    changed = [name for name in files if name in found and not _is_as_written(found[name], files[name])]
    if changed:
        raise InputError(
            f"{folder}: {_listed(changed)} changed since Amers wrote the result; move the folder away, "
            "or name another one with -o"
        )
    written_at = datetime.fromisoformat(manifest["written_at"])
    return OlderResult(manifest["scene"], written_at, manifest["verdict"])


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return ", ".join(names[:5]) + more


def _write_manifest(folder: Path, report_name: str) -> None:
    """Write the manifest of a new result: its scene, verdict and time, and its files."""
    report = json.loads((folder / report_name).read_text(encoding="utf-8"))
    document = {
        "format": RESULT_FORMAT,
        "scene": _subject(report),
        "verdict": report["verdict"],
        "written_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "files": {
            path.name: {"size_bytes": path.stat().st_size, "sha256": _sha256(path)}
            for path in sorted(folder.iterdir())
        },
    }
    (folder / MANIFEST).write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def _subject(report: dict[str, Any]) -> str:
    """What a report is on: a scene, a block or a catalogue."""
    name: str
    if "scene" in report:
        name = report["scene"]["name"]
    elif "block" in report:
        name = report["block"]["id"]
    else:
        name = report["catalogue"]
    return name


def _read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a result; None when there is none of this format."""
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        is_manifest = manifest["format"] == RESULT_FORMAT
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        return None
    return manifest if is_manifest else None


def _is_as_written(path: Path, written: dict[str, Any]) -> bool:
    if path.is_symlink() or not path.is_file():
        return False
    return path.suffix in OPENED_BY_OTHERS or (
        path.stat().st_size == written["size_bytes"] and _sha256(path) == written["sha256"]
    )


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()


def _delete_result(folder: Path) -> None:
    """Delete a replaced result: the files of its manifest, the manifest last."""
    manifest = _read_manifest(folder) or {"files": {}}
    for name in (*manifest["files"], MANIFEST):
        (folder / name).unlink(missing_ok=True)
    folder.rmdir()


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two folders in one step; returns False where the system cannot."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if rename is None:
        return False
    first, second = (ctypes.c_char_p(os.fsencode(path)) for path in (one, other))
    if rename(_AT_FDCWD, first, _AT_FDCWD, second, ctypes.c_uint(_RENAME_EXCHANGE)) == 0:
        return True
    code = ctypes.get_errno()
    if code in _CANNOT_EXCHANGE:
        return False
    raise OSError(code, os.strerror(code), str(other))


def _sync_files(folder: Path) -> None:
    """Bring the files of a folder and their names to the disk."""
    for path in folder.iterdir():
        _sync(path)
    _sync(folder)
    _sync(folder.parent)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
