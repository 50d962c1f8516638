"""Which files the rows of the store name, which are being written, and which are damaged."""

import fcntl
import os
from pathlib import Path
from uuid import UUID, uuid4

import numpy as np
import pytest

from amers.app.config import Settings
from amers.app.db import scenes, stored_files, uploads
from amers.app.db.engine import Connection, Database
from amers.app.db.jobs import attempts, jobs
from amers.app.db.uploads import AnnouncedFile
from amers.app.errors import Conflict, DamagedFile
from amers.app.storage import MARKER, Storage
from amers.app.usecases.backups.make import make_backup
from amers.app.usecases.backups.manifest import Manifest, write_manifest
from amers.app.usecases.backups.restore import restore_backup
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.damage import report_damage
from amers.app.usecases.installation import Installation
from amers.services.conventions import CHIP_SIZE
from tests.app.job_queue import claim, requested
from tests.factories import make_block
from tests.statements import run_sql

STATES = ("running", "dismissed", "successful", "failed", "removed")


def named(connection: Connection) -> set[str]:
    return {file.storage_key for file in stored_files.read_named_files(connection)}


def job_in(connection: Connection, state: str) -> UUID:
    """The id of a job that has come into a state with a file of results."""
    job = requested(connection, "register-scene", {})
    assert claim(connection, job.id)
    results = {"files": {"report.json": key_of(job.id)}}
    if state == "dismissed":
        jobs.dismiss(connection, job.id)
    elif state == "failed":
        attempts.fail(connection, job.id, 1, {"title": "no"}, results)
    elif state != "running":
        attempts.succeed(connection, job.id, 1, results)
    if state == "removed":
        run_sql(connection, "update job set results_removed_at = now() where id = %s", [job.id])
    return job.id


def key_of(job_id: UUID) -> str:
    return f"results/{job_id}/1/report.json"


def test_results_are_named_by_jobs_that_have_them_still(connection: Connection):
    made = {state: job_in(connection, state) for state in STATES}
    assert named(connection) == {key_of(made["successful"]), key_of(made["failed"])}


def test_files_are_being_written_for_running_attempts_and_arriving_uploads(connection: Connection):
    made = {state: job_in(connection, state) for state in STATES}
    arriving, complete = (
        scenes.begin_upload(connection, None, name, name, sigma_m=None) for name in ("a.tif", "b.tif")
    )
    scenes.finish_upload(connection, complete, f"scenes/{complete}/b.tif", 1, "0" * 64)
    announced = AnnouncedFile(None, "model", complete, "b.xml", "b.xml", 1, None, "")
    model = uploads.insert_upload(connection, announced)
    block, done = (
        uploads.insert_upload(connection, AnnouncedFile(None, "block", None, "c", "c", 1, None, ""))
        for _ in range(2)
    )
    uploads.finish(connection, done.id, "uploads/c")
    expected = {
        f"results/{made['running']}/1",
        f"scenes/{arriving}",
        f"scenes/{complete}",
        f"uploads/{model.id}",
        f"uploads/{block.id}",
    }
    assert stored_files.folders_in_progress(connection) == expected
    uploads.finish(connection, model.id)
    assert f"scenes/{complete}" not in stored_files.folders_in_progress(connection)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_file_of_chips_has_the_size_of_its_chips(
    connection: Connection, storage: Storage, tmp_path: Path, dtype: type
):
    lifecycle.ingest_block(connection, storage, make_block(tmp_path / "block", 5, dtype=dtype).folder)
    (file,) = stored_files.read_named_files(connection)
    assert file.size_bytes is not None
    head_bytes = storage.size(file.storage_key) - file.size_bytes
    assert 0 < head_bytes < CHIP_SIZE**2, "without its head"


def test_damaged_rows_of_chips_belong_to_the_points_whose_chips_they_are(
    connection: Connection, storage: Storage, tmp_path: Path
):
    """Each of the points has six chips, one behind the other."""
    lifecycle.ingest_block(connection, storage, make_block(tmp_path / "block", 5).folder)
    (key,) = named(connection)
    first = 2**26

    def points(rows: list[int] | None) -> list[int]:
        return [point - first for point in stored_files.points_of_chips(connection, key, rows)]

    assert points(None) == [0, 1, 2, 3, 4]
    for row in range(30):
        assert points([row]) == [row // 6]
    assert points([5, 6, 29]) == [0, 1, 4]
    assert points([]) == []


def damaged(connection: Connection) -> list[str]:
    rows = run_sql(connection, "select storage_key from damaged_file order by 1").fetchall()
    return [row["storage_key"] for row in rows]


def test_damage_is_forgotten_with_the_last_row_that_names_the_file(connection: Connection):
    for key in ("a", "b", "c"):
        stored_files.record_damage(connection, key, "missing")
    stored_files.forget_unnamed_damage(connection, ["a", "c"])
    assert damaged(connection) == ["a", "c"]
    stored_files.forget_damage(connection, "a")
    assert damaged(connection) == ["c"]


def test_a_file_that_was_removed_while_it_was_read_is_not_damaged(database: Database):
    with database.transaction() as connection:
        job = job_in(connection, "successful")
    assert not report_damage(database, DamagedFile(key_of(uuid4()), "missing"))
    assert report_damage(database, DamagedFile(key_of(job), "missing"))
    with database.transaction() as connection:
        assert damaged(connection) == [key_of(job)]


def test_two_backups_are_not_written_into_one_folder(
    database: Database, storage: Storage, settings: Settings, tmp_path: Path
):
    unfinished = tmp_path / ".backup.unfinished"
    unfinished.mkdir()
    (unfinished / "of the other one").touch()
    other = os.open(unfinished, os.O_RDONLY)
    try:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(Conflict, match="another backup"):
            make_backup(Installation(database, storage, settings), tmp_path / "backup")
    finally:
        os.close(other)
    assert [path.name for path in unfinished.iterdir()] == ["of the other one"]


@pytest.mark.parametrize("key", ["chips/a", "scenes/a", "results/a", "uploads/a", "trash/1/a", MARKER])
def test_nothing_is_restored_into_a_storage_with_any_file(empty_dsn: str, tmp_path: Path, key: str):
    backup = tmp_path / "backup"
    backup.mkdir()
    write_manifest(backup, Manifest("2026-11-22T10:00:00+00:00", uuid4(), 1, "0001", [], [], []))
    storage = Storage(tmp_path / "storage")
    storage.put(key, [b"x"])
    with pytest.raises(Conflict, match="has files already"):
        restore_backup(empty_dsn, storage, backup)
    assert [path.name for path in storage.folder.rglob("*") if path.is_file()] == [key.split("/")[-1]]
