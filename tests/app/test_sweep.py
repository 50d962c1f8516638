"""Abandoned uploads are deleted after a day of running time, even if clocks jump."""

import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from uuid import UUID, uuid4

import numpy as np
import psycopg
import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import blocks, engine, scenes, uptime
from amers.app.db.engine import Database
from amers.app.db.jobs import attempts
from amers.app.db.tokens import list_tokens
from amers.app.db.uploads import LIFE_HOURS
from amers.app.storage import Marker, Storage, read_marker, trash, write_marker
from amers.app.usecases import garbage_collection, storage_identity
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.garbage_collection import (
    FILES_AT_ONCE,
    Bin,
    Family,
    moment,
    remove_all_unnamed,
)
from amers.app.worker import sweep
from amers.app.worker.sweep import MOST_BETWEEN_S, Sweeper, sweep_files, sweep_records
from tests.app.callers import Bearer
from tests.app.job_queue import requested
from tests.app.point_history import jump, let_pass
from tests.factories import make_block
from tests.statements import run_in, run_sql

JOB_S = 3600.0
A_YEAR_H = 8760
TIFF = b"II*\0" + bytes(1000)
TUS = {"Tus-Resumable": "1.0.0", "Content-Type": "application/offset+octet-stream"}
WRITER = """
import sys
from pathlib import Path
from amers.app.storage import Storage
storage = Storage(Path(sys.argv[1]))
with storage.writing("kept/a") as file, storage.scratch_folder("job-") as folder:
    (folder / "part").write_bytes(b"x")
    file.write(b"x")
    print("writing", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def database(client: TestClient) -> Database:
    opened_database: Database = client.app.state.database  # type: ignore[attr-defined]
    return opened_database


@pytest.fixture
def me(bearer: Bearer) -> dict[str, str]:
    return bearer("register") | TUS


def begun(client: TestClient, me: dict[str, str]) -> str:
    """The address of an upload with ten bytes received."""
    upload_headers = {"Upload-Length": str(len(TIFF)), "Upload-Metadata": "filename YS50aWY="}
    url: str = client.post("/uploads", headers=me | upload_headers).headers["location"]
    assert client.patch(url, content=TIFF[:10], headers=me | {"Upload-Offset": "0"}).status_code == 204
    return url


def clocks_jump(database: Database, storage: Storage, hours: int) -> None:
    """Make all recorded times and all files of the storage this much older."""
    with database.transaction() as connection:
        jump(connection, hours)
    for path in storage.folder.rglob("*"):
        status = path.stat()
        os.utime(path, (status.st_atime - 3600 * hours, status.st_mtime - 3600 * hours))


def family(given_up: int, unknown: int) -> Family:
    """A family of a thousand results, of which some are given up or unknown."""
    return Family(
        "results",
        10 * FILES_AT_ONCE,
        [f"results/given-up-{number}" for number in range(given_up)],
        [f"results/unknown-{number}" for number in range(unknown)],
    )


def test_a_sweep_removes_a_small_part_of_the_files_whatever_the_rows_say(storage: Storage):
    few, some = family(3, 2), family(FILES_AT_ONCE, 2)
    many = family(2 * FILES_AT_ONCE, FILES_AT_ONCE + 1)
    rubbish = Bin(storage)
    assert set(rubbish.remove_unnamed(few)) == {*few.given_up, *few.unknown}
    removed = rubbish.remove_unnamed(some)
    assert len(removed) == FILES_AT_ONCE
    assert set(removed) > set(some.unknown)
    assert rubbish.remove_unnamed(many) == many.given_up[:FILES_AT_ONCE]
    assert len(Bin(storage, limited=False).remove_unnamed(many)) == 3 * FILES_AT_ONCE + 1


@pytest.mark.parametrize("hours", [25, A_YEAR_H, -A_YEAR_H])
def test_an_upload_outlives_a_clock_that_jumps(
    client: TestClient, me: dict[str, str], database: Database, storage: Storage, hours: int
):
    url = begun(client, me)
    for _ in range(3):
        clocks_jump(database, storage, hours)
        sweep_files(database, storage, JOB_S)
    assert client.head(url, headers=me).headers["upload-offset"] == "10"
    last = client.patch(url, content=TIFF[10:], headers=me | {"Upload-Offset": "10"})
    assert last.status_code == 204
    assert storage.path(f"scenes/{last.headers['amers-scene']}/a.tif").read_bytes() == TIFF


@pytest.mark.thorough
def test_an_abandoned_upload_is_deleted_after_a_day_of_running_time(
    client: TestClient, me: dict[str, str], database: Database, storage: Storage
):
    idle, busy = begun(client, me), begun(client, me)
    sweeps = 0
    while client.head(idle, headers=me).status_code == 200:
        clocks_jump(database, storage, 1)
        sweep_files(database, storage, JOB_S)
        # An empty piece prolongs an upload too.
        sign = client.patch(busy, content=b"", headers=me | {"Upload-Offset": "10"})
        assert sign.status_code == 204
        sweeps += 1
        assert sweeps <= LIFE_HOURS + 2
    assert sweeps >= LIFE_HOURS
    assert [path.name for path in storage.scratch().iterdir()] == [f"upload-{busy.rsplit('/', 1)[1]}"]
    assert client.get("/scenes", headers=me).json()["scenes"][0]["state"] == "uploading"


def test_the_running_time_advances_little_at_a_jump_and_never_back(database: Database, storage: Storage):
    def elapsed_s() -> float:
        (row,) = run_in(database.transaction(), "select uptime_s() as ran")
        return float(row["ran"])

    before = elapsed_s()
    for hours, least_s, most_s in (
        (A_YEAR_H, 0.0, MOST_BETWEEN_S),
        (-A_YEAR_H, 0.0, 0.0),
        (1, 3600.0, 3700.0),
    ):
        clocks_jump(database, storage, hours)
        sweep_files(database, storage, JOB_S)
        assert least_s <= elapsed_s() - before <= most_s
        before = elapsed_s()


@contextmanager
def writing(storage: Storage) -> Iterator["subprocess.Popen[bytes]"]:
    """A process that is writing a file and a folder of files."""
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, storage.folder], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"writing\n"
        yield process


def test_files_being_written_are_not_swept_and_those_of_killed_writers_are(
    database: Database, storage: Storage
):
    with writing(storage) as writer:
        clocks_jump(database, storage, A_YEAR_H)
        sweep_files(database, storage, JOB_S)
        assert len(list(storage.scratch().iterdir())) == 2
        writer.communicate(b"")
    assert storage.path("kept/a").read_bytes() == b"x"
    assert list(storage.scratch().iterdir()) == []
    with writing(storage) as writer:
        writer.kill()
    sweep_files(database, storage, JOB_S)
    assert len(list(storage.scratch().iterdir())) == 2, "they are young yet"
    clocks_jump(database, storage, A_YEAR_H)
    sweep_files(database, storage, JOB_S)
    assert list(storage.scratch().iterdir()) == []


def test_files_under_keys_that_nobody_here_makes_do_not_concern_the_sweep(
    database: Database, storage: Storage
):
    scene = uuid4()
    for key in (f"scenes/{scene}", f"results/{scene}x/1/a", "uploads/README", f"scenes/{scene}-2/a"):
        storage.put(key, [b"of an operator"])
    before = [storage.keys(name) for name in ("scenes", "results", "uploads")]
    sweep_files(database, storage, JOB_S)
    assert [storage.keys(name) for name in ("scenes", "results", "uploads")] == before
    storage.put(f"results/{scene}/1/a", [b"of a job that nobody knows"])
    sweep_files(database, storage, JOB_S)
    assert storage.keys("results") == [f"results/{scene}x/1/a"]


def test_unfinished_files_stay_as_long_as_an_upload_and_a_job_may_take(
    database: Database, storage: Storage
):
    for hours in (24.5, 25.5):
        path = storage.scratch() / f"{hours}h"
        path.write_bytes(b"x")
        os.utime(path, (time.time() - 3600 * hours,) * 2)
    sweep_files(database, storage, JOB_S)
    assert [path.name for path in storage.scratch().iterdir()] == ["24.5h"]


def test_an_hour_or_nearly_two_between_sweeps_is_running_time_and_more_is_a_jump(
    database: Database, storage: Storage
):
    """One sweep of files may have failed: that they come every hour is no promise."""

    def counted_s(seconds: float) -> float:
        run_in(
            database.transaction(),
            "update uptime set elapsed_s = 0,"
            " advanced_at = clock_timestamp() - make_interval(secs => %s)",
            [seconds],
        )
        sweep_files(database, storage, JOB_S)
        with database.transaction() as connection:
            return uptime.today(connection)[1]

    assert counted_s(3600.0) == pytest.approx(3600.0, abs=60.0)
    assert counted_s(1.9 * 3600.0) == pytest.approx(1.9 * 3600.0, abs=60.0)
    for hours in (3.0, 1000.0):
        assert counted_s(3600.0 * hours) == pytest.approx(2.0 * 3600.0, abs=60.0)


def test_a_scene_whose_image_stopped_arriving_is_given_up_after_a_day_unless_its_upload_goes_on(
    client: TestClient, me: dict[str, str], database: Database, storage: Storage
):
    def uploading() -> set[str]:
        listed = client.get("/scenes", headers=me).json()["scenes"]
        return {one["id"] for one in listed if one["state"] == "uploading"}

    with database.transaction() as connection:
        owner = list_tokens(connection)[0].id
        lost = str(scenes.begin_upload(connection, owner, "a.tif", "a.tif", sigma_m=None))
    url = begun(client, me)
    arriving = client.head(url, headers=me).headers["amers-scene"]
    for hours, left in ((23, {lost, arriving}), (2, {arriving})):
        assert client.patch(url, content=b"", headers=me | {"Upload-Offset": "10"}).is_success
        with database.transaction() as connection:
            let_pass(connection, hours)
        sweep_files(database, storage, JOB_S)
        assert uploading() == left, hours


def test_files_of_the_attempt_that_counts_stay_however_deep_and_others_of_its_job_go(
    database: Database, storage: Storage
):
    with database.transaction() as connection:
        job = requested(connection, "register-scene", {})
        assert attempts.claim_next(connection, "w", 30.0)
    for name in ("1/report.json", "1/chips/0000.npy", "2/report.json", "11/report.json", "report.json"):
        storage.put(f"results/{job.id}/{name}", [b"{}"])
    sweep_files(database, storage, JOB_S)
    kept = [f"results/{job.id}/1/{name}" for name in ("chips/0000.npy", "report.json")]
    assert storage.keys("results") == kept


def marked(storage: Storage, installation: UUID, generation: int) -> None:
    write_marker(storage, Marker(installation, generation))


def test_a_storage_belongs_to_its_database_up_to_the_generation_of_that(
    database: Database, storage: Storage
):
    row = storage_identity.adopt(database.transaction, storage)

    def refused() -> bool:
        with database.reading() as connection:
            return storage_identity.mismatch(connection, storage) is not None

    found = []
    for installation, ahead in ((row.id, -1), (row.id, 0), (row.id, 1), (uuid4(), 0)):
        marked(storage, installation, row.storage_generation + ahead)
        found.append(refused())
    assert found == [False, False, True, True]


def test_an_adopted_storage_has_a_generation_that_its_former_database_never_had(
    database: Database, storage: Storage
):
    marked(storage, uuid4(), 1000)
    adopted = storage_identity.adopt(database.transaction, storage)
    assert adopted.storage_generation > 1000
    assert read_marker(storage) == Marker(adopted.id, adopted.storage_generation)


def test_an_empty_storage_is_not_that_of_a_database_with_an_image(
    dsn: str, settings: Settings, tmp_path: Path
):
    with engine.pooled(dsn, settings) as database:
        with database.transaction() as connection:
            scene = scenes.begin_upload(connection, None, "a.tif", "a.tif", sigma_m=None)
            scenes.finish_upload(connection, scene, f"scenes/{scene}/a.tif", 1, "0" * 64)
        reason = storage_identity.prepare(database.transaction, Storage(tmp_path / "not mounted"))
    assert reason is not None
    assert "the storage is empty" in reason


def test_no_results_are_removed_from_a_storage_of_another_installation(
    database: Database, storage: Storage, settings: Settings
):
    with database.transaction() as connection:
        job = requested(connection, "register-scene", {})
        attempts.claim_next(connection, "w", 30.0)
        key = storage.put(f"results/{job.id}/1/a", [b"x"]).key
        attempts.reserve_results(connection, job.id, 1, 1)
        attempts.succeed(connection, job.id, 1, {"files": {"a": key}})
        run_sql(connection, "update job set finished_at = finished_at - interval '1 year'")
        run_sql(connection, "update uptime set elapsed_s = elapsed_s + 86400 * 365")
    own = read_marker(storage)
    marked(storage, uuid4(), 1)
    sweep_records(database, storage, settings)
    assert storage.keys("results") == [key]
    assert own is not None
    marked(storage, own.installation, own.generation)
    sweep_records(database, storage, settings)
    assert storage.keys("results") == []


def unknown_files(storage: Storage, count: int) -> set[str]:
    """Files of scenes, results and uploads that no row knows, so many of each."""
    return {
        storage.put(f"{name}/{uuid4()}/{file}", [b"x"]).key
        for name, file in (("scenes", "a.tif"), ("results", "1/a"), ("uploads", "a.zip"))
        for _ in range(count)
    }


def in_trash(storage: Storage) -> set[str]:
    return {key for keys in trash.batches(storage).values() for key in keys}


def test_what_nobody_knows_goes_into_the_trash_from_every_folder(database: Database, storage: Storage):
    unknown = unknown_files(storage, 1)
    sweep_files(database, storage, JOB_S)
    assert in_trash(storage) == unknown
    assert storage.keys("scenes") + storage.keys("results") + storage.keys("uploads") == []


def test_the_log_names_every_file_that_a_sweep_removes(
    client: TestClient,
    me: dict[str, str],
    database: Database,
    storage: Storage,
    caplog: pytest.LogCaptureFixture,
):
    caplog.set_level(logging.INFO)
    upload = begun(client, me).rsplit("/", 1)[1]
    left = storage.scratch() / "left"
    left.write_bytes(b"by a killed process")
    os.utime(left, (time.time() - 1000 * 3600.0,) * 2)
    removed = unknown_files(storage, 1) | {storage.put(f"chips/{'0' * 64}.npy", [b"x"]).key}
    with database.transaction() as connection:
        let_pass(connection, hours=LIFE_HOURS + 1)
    caplog.clear()
    sweep_files(database, storage, JOB_S)
    lines = [line for line in caplog.messages if "which no row refers to" in line]
    names = removed | {left.name, f"upload-{upload}"}
    assert sorted(line.split()[3].rstrip(",") for line in lines) == sorted(names)
    assert in_trash(storage) == removed
    assert list(storage.scratch().iterdir()) == []


@pytest.mark.parametrize(("trash_days", "n_in_trash"), [(0.0, 0), (0.5, 3)])
def test_without_days_in_the_trash_files_are_deleted_at_once_even_by_a_sweep_that_breaks_off(
    dsn: str,
    database: Database,
    storage: Storage,
    monkeypatch: pytest.MonkeyPatch,
    trash_days: float,
    n_in_trash: int,
):
    """An ingestion keeps the sweep from the chips, and the disk may be full."""
    monkeypatch.setattr(sweep, "LONGEST_WAIT_S", 0.1)
    unknown_files(storage, 1)
    with engine.connect(dsn) as ingesting:
        blocks.lock_ingestion(ingesting)
        with pytest.raises(psycopg.errors.LockNotAvailable):
            sweep_files(database, storage, JOB_S, trash_days)
    assert len(in_trash(storage)) == n_in_trash
    assert storage.keys("scenes") + storage.keys("results") + storage.keys("uploads") == []


def test_chips_of_a_block_stay_whatever_its_state_and_others_go(
    database: Database, storage: Storage, tmp_path: Path
):
    folder = make_block(tmp_path / "block", count=3, n_images=2).folder
    with database.transaction() as connection:
        lifecycle.ingest_block(connection, storage, folder)
    kept, stray = storage.keys("chips"), f"chips/{'0' * 64}.npy"
    assert kept
    for step in (lifecycle.find_block, lifecycle.publish_block, lifecycle.withdraw_block):
        with database.transaction() as connection:
            step(connection, "calanques")
        storage.put(stray, [b"x"])
        sweep_files(database, storage, JOB_S)
        assert storage.keys("chips") == kept
    assert in_trash(storage) == {stray}


def test_chips_that_no_block_has_are_removed_with_all_that_nobody_knows(
    database: Database, storage: Storage
):
    unknown = unknown_files(storage, 1) | {storage.put(f"chips/{'0' * 64}.npy", [b"x"]).key}
    assert set(remove_all_unnamed(database, storage)) == unknown
    assert in_trash(storage) == unknown


def test_an_operator_lets_more_files_go_at_once_than_a_sweep(
    database: Database, storage: Storage, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(garbage_collection, "FILES_AT_ONCE", 2)
    unknown = unknown_files(storage, 3)
    sweep_files(database, storage, JOB_S)
    assert in_trash(storage) == set()
    assert set(remove_all_unnamed(database, storage)) == unknown
    assert in_trash(storage) == unknown


@pytest.mark.parametrize("hours", [1, 310, 5000])
def test_the_running_time_of_a_batch_is_in_whole_hours(database: Database, hours: int):
    with database.transaction() as connection:
        for elapsed_s, expected in ((3600 * hours - 1, hours - 1), (3600 * hours, hours)):
            run_sql(connection, "update uptime set elapsed_s = %s", [elapsed_s])
            assert moment(connection).uptime_h == expected


class SimulatedStop(threading.Event):
    """The event that ends a sweeper: waits pass at once on its clock, and end after some hours."""

    def __init__(self, hours: float) -> None:
        super().__init__()
        self.now_s, self.end_s = 0.0, 3600.0 * hours

    def monotonic(self) -> float:
        """Seconds by a clock that has run for long before the sweeper begins."""
        return 1e6 + self.now_s

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.now_s += timeout
        return self.now_s > self.end_s


def test_jobs_are_swept_thrice_a_lease_and_files_every_hour_after_a_quarter(
    database: Database, storage: Storage, settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    """Neither a bug nor an outage ends the sweeper."""
    stop = SimulatedStop(hours=3.0)
    swept: dict[str, list[float]] = {"jobs": [], "records": [], "files": [], "generation": []}

    def noted(what: str) -> Callable[..., None]:
        def note(*arguments: object) -> None:
            swept[what].append(stop.now_s)
            if what == "records" and len(swept[what]) == 1:
                raise RuntimeError("a bug")
            if what == "generation" and len(swept[what]) == 2:
                raise psycopg.OperationalError("an outage")

        return note

    monkeypatch.setattr(sweep, "time", stop)
    for what in ("jobs", "records", "files"):
        monkeypatch.setattr(sweep, f"sweep_{what}", noted(what))
    monkeypatch.setattr(storage_identity, "advance", noted("generation"))
    every_second = settings.model_copy(update={"lease_seconds": 3.0})
    Sweeper(database, storage, every_second, stop).run()
    assert swept["jobs"] == [1.0 * tick for tick in range(1, 10_801)]
    assert swept["records"] == [901.0, 4501.0, 8101.0]
    assert swept["files"] == [4501.0, 8101.0], "not after records that could not be swept"
    assert len(swept["generation"]) == pytest.approx(180, abs=1)
    assert max(np.diff(swept["generation"])) <= 61.0


def test_a_sweeper_keeps_to_the_settings_of_its_installation(
    database: Database, storage: Storage, settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    stop, given = SimulatedStop(hours=0.5), dict[str, tuple[object, ...]]()
    own = {"lease_seconds": 31.0, "jobs_running_per_owner": 5, "job_seconds": 7.0, "trash_days": 0.5}
    asked = settings.model_copy(update=own)
    monkeypatch.setattr(sweep, "time", stop)
    monkeypatch.setattr(storage_identity, "advance", lambda *_: None)
    for what in ("jobs", "records", "files"):
        note = partial(lambda what, *arguments: given.update({what: arguments}), what)
        monkeypatch.setattr(sweep, f"sweep_{what}", note)
    Sweeper(database, storage, asked, stop).run()
    assert given == {
        "jobs": (database, 31.0, 5),
        "records": (database, storage, asked),
        "files": (database, storage, 7.0, 0.5),
    }
