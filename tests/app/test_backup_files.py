"""The files of a backup and of its restore, whatever the database: which, in which order, continued."""

import hashlib
from collections.abc import Callable
from contextlib import nullcontext
from datetime import date
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import UUID

import pytest

from amers.app.db.stored_files import NamedFile
from amers.app.errors import Conflict, InputError
from amers.app.storage import MARKER, Marker, Storage, read_marker, trash, write_marker
from amers.app.usecases.backups import make, restore
from amers.app.usecases.backups.make import make_backup
from amers.app.usecases.backups.manifest import (
    ARCHIVE,
    MANIFEST,
    STORAGE,
    BackupFile,
    Difference,
    Manifest,
    find_problems,
    read_manifest,
    sha256_of,
    write_manifest,
)
from amers.app.usecases.backups.restore import RESTORING, restore_backup

HERE, ELSEWHERE = UUID(int=7), UUID(int=8)
FILES = {"chips/1/a.tif": b"chips", "results/2/b.json": b"results", "scenes/3/c.tif": b"scene"}


@pytest.fixture
def backup(tmp_path: Path) -> Path:
    """A backup of three files and a dump; one more was missing, and one was removed meanwhile."""
    folder = tmp_path / "backup"
    contents = {ARCHIVE: b"dump", **{f"{STORAGE}/{key}": content for key, content in FILES.items()}}
    files = []
    for name, content in contents.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        files.append(BackupFile(name, len(content), sha256_of(path)))
    damaged, outdated = [Difference("scenes/4", "missing")], [Difference("results/5", "removed")]
    write_manifest(folder, Manifest("2026-11-29T10:00:00", HERE, 17, "0015", files, damaged, outdated))
    return folder


@pytest.fixture
def storage(tmp_path: Path) -> Storage:
    return Storage(tmp_path / "storage")


class Database:
    """Stands for the database of an installation: what is done with it, beside what the storage has."""

    def __init__(self, storage: Storage, installation: UUID | None) -> None:
        self.storage, self.installation = storage, installation
        self.done: list[tuple[str, int]] = []

    def note(self, what: str) -> None:
        self.done.append((what, sum(map(self.storage.exists, FILES))))

    def restore(self, dsn: str, file: Path) -> None:
        assert file.read_bytes() == b"dump"
        self.installation = HERE
        self.note(f"restore into {dsn}")


@pytest.fixture
def database(storage: Storage, monkeypatch: pytest.MonkeyPatch) -> Database:
    found = Database(storage, None)
    fakes: dict[str, Callable[..., Any]] = {
        "archive.check_restorable": lambda *_: found.note("check"),
        "archive.restore": found.restore,
        "archive.has_tables": lambda _: found.installation is not None,
        "engine.connect": nullcontext,
        "installation.read": lambda _: SimpleNamespace(id=found.installation),
        "revisions.upgrade": lambda _: found.note("upgrade"),
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(f"{restore.__name__}.{name}", fake)
    return found


def test_a_manifest_is_read_as_it_was_written_and_no_other_way(backup: Path, tmp_path: Path) -> None:
    manifest = read_manifest(backup)
    assert (manifest.installation, manifest.generation, manifest.revision) == (HERE, 17, "0015")
    assert [file.path for file in manifest.files] == [ARCHIVE, *(f"{STORAGE}/{key}" for key in FILES)]
    assert manifest.size_bytes == len(b"dump") + sum(map(len, FILES.values()))
    assert [one.key for one in (*manifest.damaged, *manifest.outdated)] == ["scenes/4", "results/5"]
    (backup / MANIFEST).write_text((backup / MANIFEST).read_text().replace("17", "18"))
    with pytest.raises(InputError, match="its checksum is another one"):
        read_manifest(backup)
    with pytest.raises(InputError, match="is no backup"):
        read_manifest(tmp_path)


def test_each_difference_from_the_manifest_is_a_problem_of_its_own(backup: Path) -> None:
    manifest = read_manifest(backup)
    heard: list[float] = []
    assert find_problems(backup, manifest, lambda share, _: heard.append(share)) == []
    size = manifest.size_bytes
    sizes = [file.size_bytes for file in sorted(manifest.files, key=lambda file: file.path)]
    assert heard == pytest.approx([sum(sizes[:k]) / size for k in range(len(sizes))])
    first, second, third = (backup / STORAGE / key for key in FILES)
    first.write_bytes(b"chipz")
    second.write_bytes(b"result")
    third.rename(third.with_name("d.tif"))
    third.symlink_to(third.with_name("d.tif"))
    (backup / "link").symlink_to(backup / STORAGE, target_is_directory=True)
    (backup / ARCHIVE).unlink()
    assert [one.partition(": ")[::2] for one in find_problems(backup, manifest)] == [
        (ARCHIVE, "missing"),
        ("link", "surplus, the manifest does not name it"),
        (f"{STORAGE}/chips/1/a.tif", f"changed: its SHA-256 is {sha256_of(first)}"),
        (f"{STORAGE}/results/2/b.json", "changed: 6 bytes found, 7 expected"),
        (f"{STORAGE}/scenes/3/c.tif", "it is no regular file"),
        (f"{STORAGE}/scenes/3/d.tif", "surplus, the manifest does not name it"),
    ]


def test_files_are_restored_before_the_database_and_the_storage_names_both(
    backup: Path, storage: Storage, database: Database
) -> None:
    heard: list[float] = []
    restore_backup("a dsn", storage, backup, lambda share, _: heard.append(share))
    assert database.done == [("check", 0), ("restore into a dsn", 3), ("upgrade", 3)]
    assert {key: storage.path(key).read_bytes() for key in FILES} == FILES
    assert read_marker(storage) == Marker(HERE, 17)
    assert not storage.exists(RESTORING)
    assert heard == sorted(heard)
    assert heard[-4:] == pytest.approx([0.3, 0.5, 0.7, 0.9])


@pytest.mark.parametrize("has_database", [False, True])
def test_a_restore_that_broke_off_goes_on_and_mends_what_is_not_as_in_the_backup(
    backup: Path, storage: Storage, database: Database, *, has_database: bool
) -> None:
    first, second, _ = FILES
    with storage.found(HERE):
        storage.put(RESTORING, [sha256_of(backup / MANIFEST).encode()])
        storage.put(first, [FILES[first]])
        storage.put(second, [b"half"])
    database.installation = HERE if has_database else None
    kept = storage.path(first).stat()
    restore_backup("a dsn", storage, backup)
    assert {key: storage.path(key).read_bytes() for key in FILES} == FILES
    assert storage.path(first).stat() == kept, "it was written again"
    asked = ["check", "restore into a dsn"] * (not has_database)
    assert [what for what, _ in database.done] == [*asked, "upgrade"]


def test_a_restore_goes_on_in_no_database_of_another_installation(
    backup: Path, storage: Storage, database: Database
) -> None:
    with storage.found(HERE):
        storage.put(RESTORING, [sha256_of(backup / MANIFEST).encode()])
    database.installation = ELSEWHERE
    restore_backup("a dsn", storage, backup)
    assert database.done[0] == ("check", 0), "it would refuse a database with tables"


@pytest.mark.parametrize("top", ["chips", "results", "scenes", "uploads", "trash"])
def test_nothing_is_restored_into_a_storage_with_files_or_of_another_backup(
    backup: Path, storage: Storage, database: Database, top: str
) -> None:
    with storage.found(ELSEWHERE):
        storage.put(f"{top}/1/a", [b"x"])
    with pytest.raises(Conflict, match="the storage has files already"):
        restore_backup("a dsn", storage, backup)
    storage.put(RESTORING, [b"another"])
    with pytest.raises(Conflict, match="another backup was partly restored"):
        restore_backup("a dsn", storage, backup)
    storage.delete(RESTORING)
    storage.delete(f"{top}/1/a")
    write_marker(storage, Marker(ELSEWHERE, 1))
    with pytest.raises(Conflict, match="the storage has files already"):
        restore_backup("a dsn", storage, backup)
    assert database.done == []


def test_a_backup_that_is_not_whole_restores_nothing(
    backup: Path, storage: Storage, database: Database
) -> None:
    (backup / ARCHIVE).write_bytes(b"dumb")
    with pytest.raises(InputError, match=r"nothing was restored: database\.dump: changed"):
        restore_backup("a dsn", storage, backup)
    assert database.done == []
    assert not storage.exists(MARKER)


def test_a_backup_has_what_rows_name_and_tells_what_is_not_as_they_have_it(
    tmp_path: Path, storage: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files that were removed or replaced since the dump are no damage; some are in the trash."""
    right, other = hashlib.sha256(b"right").hexdigest(), hashlib.sha256(b"other").hexdigest()
    in_dump = {"a": right, "b": None, "c": right, "d": right, "e": right, "f": right, "g": right}
    now = {"a": right, "b": None, "c": right, "e": right, "f": other, "g": right}
    keys = {name: f"results/1/{name}" for name in in_dump}
    with storage.found(HERE):
        for name, content in {"a": b"right", "b": b"any", "e": b"other", "f": b"other"}.items():
            storage.put(keys[name], [content])
        storage.put(keys["g"], [b"right"])
        trash.discard(storage, [keys["g"]], trash.Moment(date(2026, 11, 29), 5))
    reported: list[str] = []

    def named(_: object, only: list[str] | None = None) -> list[NamedFile]:
        rows = in_dump if only is None else now
        return [
            NamedFile(keys[name], "result", None, sha256)
            for name, sha256 in rows.items()
            if only is None or keys[name] in only
        ]

    fakes: dict[str, Callable[..., Any]] = {
        "storage_identity.prepare": lambda *_: None,
        "installation.read": lambda _: SimpleNamespace(id=HERE, storage_generation=17),
        "revisions.current": lambda _: "0015",
        "driver": lambda connection: connection,
        "export_snapshot": lambda _: "a moment",
        "stored_files.read_named_files": named,
        "archive.dump": lambda dsn, file, moment: file.write_text(f"{dsn} at {moment}"),
        "damage.report_damage": lambda _, fault: reported.append(str(fault)),
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(f"{make.__name__}.{name}", fake)
    database = SimpleNamespace(
        transaction=nullcontext, snapshot=nullcontext, reading=nullcontext, dsn="a dsn"
    )
    heard: list[float] = []
    here: Any = SimpleNamespace(database=database, storage=storage)
    manifest = make_backup(here, tmp_path / "made", lambda share, _: heard.append(share))
    assert (tmp_path / "made" / ARCHIVE).read_text() == "a dsn at a moment"
    assert manifest == read_manifest(tmp_path / "made")
    assert find_problems(tmp_path / "made", manifest) == []
    kept = [ARCHIVE, *(f"{STORAGE}/{keys[name]}" for name in "abefg")]
    assert [file.path for file in manifest.files] == kept
    assert [(one.key[-1], one.reason) for one in manifest.damaged] == [
        ("c", "missing"),
        ("e", f"its SHA-256 is not {right}"),
    ]
    assert [one.key[-1] for one in manifest.outdated] == ["d", "f"]
    assert len(reported) == 2
    assert heard == pytest.approx([0.0, *(0.1 + 0.9 * k / 7.0 for k in range(7))])
