"""Backups into places that cannot take them, and interrupted ones: a sentence, and no half set."""

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from amers.app.usecases.backups.manifest import find_problems, read_manifest
from tests.app.full_storage import Full, contents
from tests.app.small_disk import Disk
from tests.app.test_backup_sets import KILLED_AT, amers, backed_up
from tests.unproven import unproven_storage

pytestmark = pytest.mark.thorough

IN_THE_ARCHIVE, IN_THE_FILES = 16 << 10, 2 << 20
"""Sizes of disks that are full while the database, or while a file is written."""


@pytest.fixture
def kind() -> str:
    """Files in a folder."""
    return "folder"


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    """A small disk for backups, on which no file of the storage can be linked."""
    disk = Disk(tmp_path / "disk", IN_THE_FILES)
    yield disk
    disk.remove()


def assert_one_sentence(stderr: str) -> None:
    last = stderr.strip().splitlines()[-1]
    assert last.startswith("amers: "), stderr
    assert "Traceback" not in stderr
    assert "should not happen" not in stderr


@pytest.mark.parametrize("size_bytes", [IN_THE_ARCHIVE, IN_THE_FILES])
def test_a_backup_on_a_full_disk_says_so_and_leaves_nothing(size_bytes: int, full: Full, disk: Disk):
    storage = unproven_storage(full.settings)
    (image,) = [key for key in storage.keys("scenes") if key.endswith("a.tif")]
    (storage.local(image) or Path()).write_bytes(bytes(2 * IN_THE_FILES))
    disk.grow(size_bytes)
    failed = amers(full.settings, "db", "backup", disk.folder / "monday")
    assert failed.returncode in (1, 2), failed.stderr
    assert_one_sentence(failed.stderr)
    assert "No space left" in failed.stderr
    assert list(disk.folder.iterdir()) == []
    disk.grow(16 * IN_THE_FILES)
    again = amers(full.settings, "db", "backup", disk.folder / "monday")
    assert again.returncode == 1, "the image was changed"
    manifest = read_manifest(disk.folder / "monday")
    assert find_problems(disk.folder / "monday", manifest) == []
    assert [item.key for item in manifest.damaged] == [image]


def test_a_backup_on_a_read_only_disk_says_so_and_changes_nothing(full: Full, disk: Disk):
    backed_up(full, disk.folder / "sunday")
    disk.protect()
    failed = amers(full.settings, "db", "backup", disk.folder / "monday")
    assert failed.returncode == 2
    assert_one_sentence(failed.stderr)
    assert "Read-only file system" in failed.stderr
    assert [path.name for path in disk.folder.iterdir()] == ["sunday"]
    verified = amers(full.settings, "db", "verify-backup", disk.folder / "sunday")
    assert verified.returncode == 0, verified.stderr


@pytest.mark.parametrize("stage", ["archive.dump:0", "_copy:2", "write_manifest:0", "_sync_folders:0"])
def test_an_interrupted_backup_says_so_and_leaves_nothing(
    stage: str, full: Full, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    module, _, name = stage.rpartition(".")
    place = (
        f"amers.app.usecases.backups.make:{stage}"
        if not module
        else f"amers.app.db.cluster.backup:{name}"
    )
    # Processes in the background of a shell start with interrupts ignored.
    heeding = "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)"
    interrupted = heeding + KILLED_AT.replace("os.getpid(), 9", f"os.getpid(), {int(signal.SIGINT)}")
    monkeypatch.setattr("tests.app.test_backup_sets.KILLED_AT", interrupted)
    ended = amers(full.settings, "db", "backup", tmp_path / "backups" / "monday", killed_at=place)
    assert ended.returncode == 130, ended.stderr
    assert "Traceback" not in ended.stderr
    assert list((tmp_path / "backups").iterdir()) == []
    assert contents(unproven_storage(full.settings)) == full.files
