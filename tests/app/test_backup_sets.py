"""A backup is one set of database and files: whole, verified, restored completely or to be continued."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from amers.app.config import Settings
from amers.app.db import engine, installation, stored_files
from amers.app.db.cluster import backup as archive
from amers.app.db.cluster.embedded import Cluster
from amers.app.errors import Conflict
from amers.app.storage import MARKER, Marker, open_storage, read_marker, trash
from amers.app.usecases import storage_identity
from amers.app.usecases.backups import make
from amers.app.usecases.backups.make import make_backup
from amers.app.usecases.backups.manifest import (
    STORAGE,
    Manifest,
    find_problems,
    read_manifest,
)
from amers.app.usecases.backups.restore import RESTORING, restore_backup
from amers.app.usecases.installation import Installation
from amers.app.worker.sweep import sweep_files
from tests.app.conftest import EMPTY_TEMPLATE, fresh_database
from tests.app.full_storage import Full, contents
from tests.command_line import environment_of
from tests.statements import run_sql
from tests.unproven import unproven_storage

pytestmark = pytest.mark.thorough

KILLED_AT = """
import os, sys
from importlib import import_module
from amers.app.cli.main import main
module, name, calls = sys.argv.pop(1).split(":")
module = import_module(module)
original, left = getattr(module, name), [int(calls)]
def killing(*arguments, **options):
    if left[0] == 0:
        os.kill(os.getpid(), 9)
    left[0] -= 1
    return original(*arguments, **options)
setattr(module, name, killing)
main()
"""
KILLED = -9


def amers(
    settings: Settings, *words: str | Path, killed_at: str = ""
) -> "subprocess.CompletedProcess[str]":
    """Run a command on an installation; with `killed_at` it kills itself at a call of a function."""
    program = ["-c", KILLED_AT, killed_at] if killed_at else ["-m", "amers"]
    environment = environment_of(settings)
    if settings.storage_url is None:
        environment.pop("AMERS_STORAGE_URL", None)
    return subprocess.run(
        [sys.executable, *program, *map(str, words)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def placed(full: Full) -> dict[str, bytes]:
    """The files of an installation but those that are still arriving."""
    return {key: content for key, content in full.files.items() if "/" in key}


def backed_up(full: Full, folder: Path) -> Manifest:
    with engine.opened(full.settings) as database:
        return make_backup(Installation(database, open_storage(full.settings), full.settings), folder)


def empty(full: Full, dsn: str, folder: Path) -> Settings:
    """Settings of an empty installation, with the same kind of storage."""
    url = full.settings.storage_url
    return Settings(
        database_url=dsn, data_folder=folder, storage_url=None if url is None else f"{url}/restored"
    )


def assert_whole(settings: Settings, files: dict[str, bytes]) -> None:
    """The restored installation has all files, a database that names them, and sweeps none of them."""
    storage = unproven_storage(settings)
    assert contents(storage) == files
    assert not storage.exists(RESTORING)
    with engine.opened(settings) as database:
        sweep_files(database, storage, 3600.0)
        assert contents(storage) == files
        with database.reading() as connection:
            named = {file.storage_key for file in stored_files.read_named_files(connection)}
            assert named == set(files)
            assert storage_identity.mismatch(connection, storage) is None


def test_a_backup_restores_database_and_files_of_an_installation(
    full: Full, cluster: Cluster, tmp_path: Path
):
    made = amers(full.settings, "db", "backup", tmp_path / "backup", "--json")
    assert made.returncode == 0, made.stderr
    record = json.loads(made.stdout)
    assert (record["files"], record["damaged"], record["outdated"]) == (len(placed(full)) + 1, [], [])
    checked = amers(full.settings, "db", "verify-backup", tmp_path / "backup", "--json")
    assert (checked.returncode, json.loads(checked.stdout)["problems"]) == (0, []), checked.stderr
    with fresh_database(cluster, EMPTY_TEMPLATE) as dsn:
        settings = empty(full, dsn, tmp_path / "restored")
        # As AMERS_STORAGE_URL of the command.
        restore_backup(dsn, open_storage(settings), tmp_path / "backup")
        assert_whole(settings, placed(full))
    with engine.opened(full.settings) as database:
        sweep_files(database, open_storage(full.settings), 3600.0)
    assert contents(unproven_storage(full.settings)) == full.files, "the original continues"


def test_a_backup_names_every_kind_of_stored_file_that_is_damaged(full: Full, tmp_path: Path):
    storage, keys = unproven_storage(full.settings), sorted(placed(full))
    assert {key.split("/")[0] for key in keys} == {"chips", "results", "scenes", "uploads"}
    assert len(keys) == 5, "image and side file are two"
    for key in keys:
        content = bytearray(placed(full)[key])
        content[len(content) // 2] ^= 1
        storage.put(key, [bytes(content)])
    made = amers(full.settings, "db", "backup", tmp_path / "backup", "--json")
    assert made.returncode == 1
    assert sorted(json.loads(made.stdout)["damaged"]) == keys
    assert all(key in made.stderr for key in keys)
    with engine.connect(full.dsn) as connection:
        known = run_sql(connection, "select storage_key from damaged_file").fetchall()
    assert sorted(row["storage_key"] for row in known) == keys
    assert find_problems(tmp_path / "backup", read_manifest(tmp_path / "backup")) == []


BACKUP_STAGES = ("_copy:0", "_copy:3", "write_manifest:0", "_sync_folders:0")
RESTORE_STAGES = (
    "amers.app.usecases.backups.restore:_restore_file:3",
    "amers.app.db.cluster.backup:restore:0",
    "amers.app.db.revisions:upgrade:0",
)


@pytest.mark.parametrize("kind", ["folder"])
def test_a_kill_during_a_backup_leaves_nothing_that_looks_like_one(full: Full, tmp_path: Path):
    folder = tmp_path / "backups" / "monday"
    for stage in BACKUP_STAGES:
        place = f"amers.app.usecases.backups.make:{stage}"
        assert amers(full.settings, "db", "backup", folder, killed_at=place).returncode == KILLED
        assert not folder.exists()
        assert [path.name for path in folder.parent.iterdir()] == [".monday.unfinished"]
    backed_up(full, folder)
    assert find_problems(folder, read_manifest(folder)) == []
    assert list(folder.parent.iterdir()) == [folder]
    assert contents(unproven_storage(full.settings)) == full.files


@pytest.mark.parametrize("kind", ["folder"])
def test_a_killed_restore_is_continued_by_the_next_one(full: Full, cluster: Cluster, tmp_path: Path):
    backup = tmp_path / "backup"
    backed_up(full, backup)
    for number, stage in enumerate(RESTORE_STAGES):
        with fresh_database(cluster, EMPTY_TEMPLATE) as dsn:
            settings = empty(full, dsn, tmp_path / f"restored-{number}")
            assert amers(settings, "db", "restore", backup, killed_at=stage).returncode == KILLED
            restore_backup(dsn, open_storage(settings), backup)
            assert_whole(settings, placed(full))
            with pytest.raises(Conflict, match="files already"):
                restore_backup(dsn, open_storage(settings), backup)


@pytest.mark.parametrize("kind", ["folder"])
def test_a_restored_storage_names_the_installation_and_the_generation_of_its_backup(
    full: Full, cluster: Cluster, tmp_path: Path
):
    """Before any service has looked at it: by then a later backup would not fit it any more."""
    manifest = backed_up(full, tmp_path / "backup")
    with fresh_database(cluster, EMPTY_TEMPLATE) as dsn:
        storage = unproven_storage(empty(full, dsn, tmp_path / "restored"))
        restore_backup(dsn, storage, tmp_path / "backup")
        with engine.connect(dsn) as connection:
            row = installation.read(connection)
    marker = read_marker(storage)
    assert marker == Marker(manifest.installation, manifest.generation)
    assert (row.id, row.storage_generation) == (manifest.installation, manifest.generation)
    assert manifest.generation > 0


@pytest.mark.parametrize("kind", ["folder"])
def test_the_database_of_a_backup_is_older_than_the_storage_that_goes_on(full: Full, tmp_path: Path):
    manifest = backed_up(full, tmp_path / "backup")
    marker = read_marker(unproven_storage(full.settings))
    assert marker is not None
    assert marker.generation > manifest.generation


@pytest.mark.parametrize("kind", ["folder"])
def test_a_backup_survives_what_others_do_meanwhile(
    full: Full, cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    storage = unproven_storage(full.settings)
    image, side_file = sorted(storage.keys("scenes"))
    (result,) = storage.keys("results")
    dump = archive.dump

    def dump_and_work(dsn: str, file: Path, snapshot: str | None = None) -> None:
        """Meanwhile a side file is replaced, and a job's results are removed and swept."""
        dump(dsn, file, snapshot)
        stored = storage.put(side_file, [b"LINE_OFF: 2"])
        with engine.connect(full.dsn) as connection:
            run_sql(
                connection,
                "update scene set models = jsonb_build_object('a_RPC.TXT',"
                " jsonb_build_object('size_bytes', 11, 'sha256', %s::text))",
                [stored.sha256],
            )
            run_sql(connection, "update job set results_removed_at = now()")
        with engine.pooled(full.dsn, full.settings) as database:
            sweep_files(database, storage, 3600.0)
        assert trash.find(storage, result) is not None
        storage.delete(image)
        with engine.connect(full.dsn) as connection:
            run_sql(connection, "update scene set file_key = null, state = 'removed', models = '{}'")

    monkeypatch.setattr(make.archive, "dump", dump_and_work)
    manifest = backed_up(full, tmp_path / "backup")
    assert manifest.damaged == []
    assert {item.key for item in manifest.outdated} == {image, side_file}
    assert f"{STORAGE}/{result}" in {file.path for file in manifest.files}, "it was in the trash"
    assert find_problems(tmp_path / "backup", manifest) == []


@pytest.mark.parametrize("kind", ["folder"])
def test_a_backup_needs_its_own_storage_and_a_new_folder(full: Full, tmp_path: Path):
    backed_up(full, tmp_path / "backup")
    with pytest.raises(Conflict, match="exists"):
        backed_up(full, tmp_path / "backup")
    unproven_storage(full.settings).delete(MARKER)
    with pytest.raises(Conflict, match="amers store adopt"):
        backed_up(full, tmp_path / "other")
    assert not (tmp_path / "other").exists()
