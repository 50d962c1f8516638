"""The storage belongs to its database: another, an older or an empty database removes nothing."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path
from uuid import uuid4

import httpx
import pytest

from amers.app.cli import store_trash
from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.cluster.embedded import Cluster
from amers.app.errors import Conflict
from amers.app.storage import MARKER, open_storage, read_marker, trash
from amers.app.storage.trash import TRASH, Moment
from amers.app.usecases import garbage_collection, storage_identity
from amers.app.worker import sweep
from amers.app.worker.sweep import Sweeper, sweep_files
from tests.app.full_storage import FAMILIES, Full, another, contents, run_service
from tests.app.running_service import running_service
from tests.app.worker_processes import wait_until
from tests.statements import run_in
from tests.unproven import unproven_storage

JOB_S = 3600.0
LEASE_S = 0.3
LONGEST_WAIT_S = 60.0


def swept(settings: Settings, monkeypatch: pytest.MonkeyPatch, until: Callable[[], bool]) -> None:
    """Let the sweeper of a worker sweep jobs and files every tick, until a condition or for seconds."""
    monkeypatch.setattr(sweep, "FIRST_FILES_S", 0.0, raising=False)
    stop = threading.Event()
    brisk = settings.model_copy(update={"lease_seconds": LEASE_S})
    with engine.opened(settings) as database:
        sweeper = Sweeper(database, open_storage(settings), brisk, stop)
        thread = threading.Thread(target=sweeper.run)
        thread.start()
        deadline = time.monotonic() + LONGEST_WAIT_S
        while time.monotonic() < deadline and not until():
            time.sleep(0.05)
        stop.set()
        thread.join()


def assert_untouched(
    full: Full, dsn: str, reason: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A worker on a database removes nothing from the full storage, and says why and what to do."""
    storage = unproven_storage(full.settings)
    before = contents(storage)
    marker = storage.open(MARKER).read() if storage.exists(MARKER) else None
    settings = full.settings.model_copy(update={"database_url": Settings(database_url=dsn).database_url})
    swept(settings, monkeypatch, lambda: "amers store adopt" in caplog.text)
    assert contents(storage) == before
    assert (storage.open(MARKER).read() if storage.exists(MARKER) else None) == marker
    assert storage.keys(TRASH) == []
    assert reason in caplog.text
    assert "amers store adopt" in caplog.text


def test_an_empty_database_beside_a_full_storage_removes_nothing(
    full: Full, cluster: Cluster, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    assert {key.split("/")[0].split("-")[0] for key in full.files} == {*FAMILIES, "upload"}
    with another(cluster) as empty:
        assert_untouched(full, empty, "that of another installation", monkeypatch, caplog)


@pytest.mark.parametrize("kind", ["folder"])
def test_the_trash_of_another_installation_is_not_emptied(
    full: Full, cluster: Cluster, monkeypatch: pytest.MonkeyPatch
):
    storage = unproven_storage(full.settings)
    key = next(key for key in full.files if storage.exists(key))
    trash.discard(storage, [key], Moment(date(2026, 11, 22), 310))
    before = contents(storage)
    monkeypatch.setenv("AMERS_DATA_FOLDER", str(full.settings.data_folder))
    with another(cluster) as empty:
        monkeypatch.setenv("AMERS_DATABASE_URL", empty)
        with pytest.raises(Conflict, match="amers store adopt"):
            store_trash.empty()
    assert contents(storage) == before
    monkeypatch.setenv("AMERS_DATABASE_URL", full.dsn)
    store_trash.empty()
    assert storage.keys(TRASH) == []


@pytest.mark.parametrize("kind", ["folder"])
def test_an_empty_database_beside_a_storage_of_an_earlier_version_removes_nothing(
    full: Full, cluster: Cluster, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    unproven_storage(full.settings).delete(MARKER)
    with another(cluster) as empty:
        assert_untouched(full, empty, f"knows 0 of its {len(full.files)} files", monkeypatch, caplog)


@pytest.mark.parametrize("kind", ["folder"])
def test_a_database_of_another_installation_removes_nothing(
    full: Full,
    cluster: Cluster,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
):
    with another(cluster) as other:
        elsewhere = Settings(database_url=other, data_folder=tmp_path / "elsewhere")
        run_service(elsewhere, tmp_path, 2)
        assert_untouched(full, other, "that of another installation", monkeypatch, caplog)


@pytest.mark.thorough
def test_an_older_backup_of_the_database_removes_nothing(
    full: Full,
    cluster: Cluster,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
):
    with another(cluster, full.dsn) as backup:
        run_service(full.settings, tmp_path, 3)
        assert len(contents(unproven_storage(full.settings))) == 2 * len(full.files)
        assert_untouched(full, backup, "the database is older than the storage", monkeypatch, caplog)


@pytest.mark.thorough
def test_a_service_on_an_empty_database_beside_a_full_storage_says_so_and_removes_nothing(
    full: Full, cluster: Cluster, tmp_path: Path
):
    log = tmp_path / "service.log"
    with another(cluster) as empty:
        settings = full.settings.model_copy(
            update={"database_url": Settings(database_url=empty).database_url}
        )
        with running_service(settings, log) as url:
            reply = httpx.get(f"{url}/readyz", timeout=30)
            wait_until(lambda: log.read_text().count("amers store adopt") >= 2, "API and worker log it")
    assert reply.status_code == 503
    storage = reply.json()["parts"]["storage"]
    assert storage["status"] == "failed"
    assert "another installation" in storage["reason"]
    assert "amers store adopt" in storage["reason"]
    assert contents(unproven_storage(full.settings)) == full.files


@pytest.mark.parametrize("kind", ["folder"])
def test_a_storage_that_is_not_mounted_gets_no_files_of_its_own(
    full: Full, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    unmounted = full.settings.model_copy(update={"data_folder": tmp_path / "x", "storage_url": None})
    with engine.opened(unmounted) as database:
        assert not storage_identity.announce(database.transaction, open_storage(unmounted))
    assert "not mounted" in caplog.text
    assert not unproven_storage(unmounted).exists(MARKER)


@pytest.mark.parametrize("kind", ["folder"])
def test_a_storage_of_an_earlier_version_is_adopted_by_its_own_database(full: Full):
    storage = unproven_storage(full.settings)
    storage.delete(MARKER)
    run_in(engine.connect(full.dsn), "update installation set storage_generation = 0")
    with engine.opened(full.settings) as database:
        assert storage_identity.announce(database.transaction, storage)
        sweep_files(database, storage, JOB_S)
    assert contents(storage) == full.files


@pytest.mark.parametrize("kind", ["folder"])
def test_an_adopted_storage_is_swept_by_its_new_database_and_not_by_the_former_one(
    full: Full, cluster: Cluster
):
    storage = unproven_storage(full.settings)
    with another(cluster) as dsn, engine.pooled(dsn, full.settings) as database:
        assert storage_identity.prepare(database.transaction, storage) is not None
        storage_identity.adopt(database.transaction, storage)
        assert storage_identity.prepare(database.transaction, storage) is None
        sweep_files(database, storage, JOB_S)
    assert [key for family in FAMILIES for key in storage.keys(family)] == []
    ((batch, keys),) = trash.batches(storage).items()
    with engine.pooled(full.dsn, full.settings) as database:
        reason = storage_identity.prepare(database.transaction, storage)
        assert reason is not None
        assert "another installation" in reason
        trash.put_back(storage, batch, keys)
        storage_identity.adopt(database.transaction, storage)
        sweep_files(database, storage, JOB_S)
    before = {key: content for key, content in full.files.items() if "/" in key}
    assert contents(storage) == before, "but for the upload that was arriving"


@pytest.mark.thorough
def test_what_the_sweep_removes_lies_in_the_trash_for_days_of_calendar_and_uptime(full: Full):
    storage, key = unproven_storage(full.settings), f"scenes/{uuid4()}/left.tif"
    storage.put(key, [b"left by a killed process"])
    with engine.opened(full.settings) as database:
        sweep_files(database, storage, JOB_S)
        with database.transaction() as connection:
            now = garbage_collection.moment(connection)
        assert contents(storage) == full.files
        assert trash.batches(storage) == {now.batch: [key]}
        # A year of the calendar, as a clock that jumped shows it, without any uptime.
        storage.move(f"{TRASH}/{now.batch}/{key}", f"{TRASH}/2020-01-01_{now.uptime_h}h/{key}")
        sweep_files(database, storage, JOB_S)
        assert trash.batches(storage) == {f"2020-01-01_{now.uptime_h}h": [key]}
    for later, is_left in (
        (Moment(date(2030, 1, 1), now.uptime_h + 7 * 24 - 1), True),
        (Moment(date(2020, 1, 7), now.uptime_h + 1000), True),
        (Moment(date(2020, 1, 8), now.uptime_h + 7 * 24), False),
    ):
        trash.delete_old(storage, later, 7.0)
        assert bool(storage.keys(TRASH)) == is_left, later


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["folder"])
def test_many_unknown_files_at_once_stay_until_an_operator_lets_them_go(
    full: Full, caplog: pytest.LogCaptureFixture
):
    storage = unproven_storage(full.settings)
    stray = [f"scenes/{uuid4()}/a.tif" for _ in range(garbage_collection.FILES_AT_ONCE + 1)]
    for key in stray:
        storage.put(key, [b"x"])
    with engine.opened(full.settings) as database:
        sweep_files(database, storage, JOB_S)
        assert set(storage.keys("scenes")) >= set(stray)
        assert "amers store sweep" in caplog.text
        assert set(garbage_collection.remove_all_unnamed(database, storage)) == set(stray)
    assert contents(storage) == full.files
    assert len(storage.keys(TRASH)) == len(stray)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["folder"])
def test_nothing_is_swept_at_the_first_ticks_of_a_worker(full: Full):
    storage, stop = unproven_storage(full.settings), threading.Event()
    storage.put(f"scenes/{uuid4()}/left.tif", [b"left by a killed process"])
    before = contents(storage)
    brisk = full.settings.model_copy(update={"lease_seconds": LEASE_S})
    with engine.opened(full.settings) as database:
        thread = threading.Thread(target=Sweeper(database, storage, brisk, stop).run)
        thread.start()
        time.sleep(5 * LEASE_S)
        stop.set()
        thread.join()
    assert contents(storage) == before


def test_a_worker_advances_the_generation_of_its_storage(full: Full, monkeypatch: pytest.MonkeyPatch):
    storage = unproven_storage(full.settings)
    before = read_marker(storage)
    monkeypatch.setattr(sweep, "GENERATION_EVERY_S", 0.0)
    swept(full.settings, monkeypatch, lambda: read_marker(storage) != before)
    after = read_marker(storage)
    assert before is not None
    assert after is not None
    assert (after.installation, after.generation > before.generation) == (before.installation, True)


def test_a_file_that_two_workers_sweep_at_once_is_moved_once(full: Full):
    storage = unproven_storage(full.settings)
    storage.put("scenes/stray", [b"x"])
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: storage.move("scenes/stray", "trash/stray"), range(8)))
    assert (storage.exists("scenes/stray"), storage.open("trash/stray").read()) == (False, b"x")


@pytest.mark.parametrize("kind", ["bucket"])
def test_a_file_too_large_to_be_copied_by_the_bucket_goes_to_the_trash_in_parts(
    full: Full, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("amers.app.storage.bucket.COPY_LIMIT_BYTES", 10)
    storage, content = unproven_storage(full.settings), bytes(range(256)) * 100
    storage.put("scenes/large", [content])
    storage.move("scenes/large", "trash/large")
    assert not storage.exists("scenes/large")
    assert storage.open("trash/large").read() == content
