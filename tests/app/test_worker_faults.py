"""Workers that die, hang, are stopped or run out of memory during a real registration."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from uuid import UUID

import pytest
import rasterio
from fastapi.testclient import TestClient
from rasterio.windows import Window

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.jobs import jobs
from amers.app.main import create_app
from amers.app.storage import Storage
from tests.app.flat_world import FlatWorld, make_flat_world
from tests.app.worker_processes import (
    alive,
    attempts_of,
    ended,
    kill,
    running_worker,
    scene_to_register,
    under_way,
    wait_until,
)
from tests.statements import run_sql

pytestmark = [pytest.mark.long, pytest.mark.thorough]

LEASE_S = 2.0
PASSES = 100
MEBIBYTE = 1 << 20

Bearer = Callable[[str], dict[str, str]]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    """A block, and a scene that takes some seconds to register on it."""
    return make_flat_world(tmp_path_factory.mktemp("world"))


@pytest.fixture
def settings(dsn: str, tmp_path: Path) -> Settings:
    """An installation with short leases, which notices a dead worker soon."""
    return Settings(database_url=dsn, data_folder=tmp_path / "data", lease_seconds=LEASE_S)


@pytest.fixture
def me(bearer: Bearer) -> dict[str, str]:
    """Headers of a caller who may register."""
    return bearer("register")


@pytest.fixture
def ask(
    client: TestClient, me: dict[str, str], world: FlatWorld, storage: Storage, dsn: str
) -> Callable[..., str]:
    """Requests the registration of the scene, whose points are published; returns the URL of the job."""
    execute = scene_to_register(client, me, storage, dsn, world)
    return lambda passes=PASSES: execute(passes)


@pytest.fixture
def log(tmp_path: Path) -> Iterator[Path]:
    """The log of the workers of a test, printed when the test fails."""
    path = tmp_path / "worker.log"
    path.touch()
    yield path
    print(path.read_text())


def attempt_of(dsn: str, job_url: str) -> int:
    """The number of claims of the job."""
    with engine.connect(dsn) as connection:
        job = jobs.find(connection, UUID(job_url.rsplit("/", 1)[1]))
    assert job is not None
    return job.attempt


def results_of(dsn: str, job_url: str) -> int:
    """The number of registrations of the job."""
    with engine.connect(dsn) as connection:
        row = run_sql(
            connection,
            "select count(*) as n from registration where job_id = %s",
            [job_url.rsplit("/", 1)[1]],
        ).fetchone()
    assert row is not None
    return int(row["n"])


def test_a_killed_worker_loses_its_job_to_another_and_there_is_one_result(
    client: TestClient,
    me: dict[str, str],
    ask: Callable[..., str],
    settings: Settings,
    dsn: str,
    storage: Storage,
    log: Path,
):
    job = ask()
    with running_worker(settings, log) as first:
        under_way(client, job, me)
        (process,) = attempts_of(first)
        kill(first.pid)
        first.wait()
        wait_until(lambda: not alive(process), "the job's process dies with its worker", 5.0)
    assert client.get(job, headers=me).json()["status"] == "running", "nobody has noticed yet"
    with running_worker(settings, log):
        ended_job = ended(client, job, me)
    assert (ended_job["status"], attempt_of(dsn, job), results_of(dsn, job)) == ("successful", 2, 1)
    attempts = {key.split("/")[2] for key in storage.keys("results")}
    assert attempts == {"2"}


@pytest.mark.endurance
def test_a_killed_job_process_is_tried_again_by_the_worker_that_lives_on(
    client: TestClient,
    me: dict[str, str],
    ask: Callable[..., str],
    settings: Settings,
    dsn: str,
    log: Path,
):
    job = ask()
    with running_worker(settings, log) as worker:
        under_way(client, job, me)
        (process,) = attempts_of(worker)
        kill(process)
        ended_job = ended(client, job, me)
        assert worker.poll() is None
    assert (ended_job["status"], attempt_of(dsn, job), results_of(dsn, job)) == ("successful", 2, 1)


def test_a_dismissed_job_stops_within_seconds_and_leaves_no_result(
    client: TestClient,
    me: dict[str, str],
    ask: Callable[..., str],
    settings: Settings,
    dsn: str,
    log: Path,
):
    job = ask()
    with running_worker(settings, log) as worker:
        under_way(client, job, me)
        (process,) = attempts_of(worker)
        assert client.delete(job, headers=me).json()["status"] == "dismissed"
        wait_until(lambda: not alive(process), "the work stops", 5.0)
        other = ended(client, ask(1), me)
    assert other["status"] == "successful", "the worker lives on"
    assert client.get(job, headers=me).json()["status"] == "dismissed"
    assert results_of(dsn, job) == 0


def test_a_job_that_writes_too_large_a_file_fails_at_once_and_leaves_nothing(
    client: TestClient,
    me: dict[str, str],
    ask: Callable[..., str],
    settings: Settings,
    storage: Storage,
    dsn: str,
    log: Path,
):
    small = client.get(ask(1), headers=me).json()["inputs"]
    # The image has 2.9 MB, and so has its copy.
    body = {"inputs": {"scene": small["scene"], "copy_image": True}}
    job = client.post("/processes/register-scene/execution", json=body, headers=me).headers["location"]
    with running_worker(settings, log, AMERS_JOB_FILE_BYTES=str(MEBIBYTE)):
        failed_job = ended(client, job, me)
    assert failed_job["status"] == "failed"
    assert failed_job["error"]["title"] == "File size limit"
    assert "larger than 1 MiB" in failed_job["error"]["detail"]
    assert attempt_of(dsn, job) == 1
    job_id = failed_job["jobID"]
    assert storage.keys(f"results/{job_id}") == []
    assert not list(storage.scratch().glob(f"job-{job_id}*"))


@pytest.mark.endurance
def test_a_stopped_worker_gives_its_job_back_at_once(
    client: TestClient,
    me: dict[str, str],
    ask: Callable[..., str],
    settings: Settings,
    dsn: str,
    log: Path,
):
    patient = settings.model_copy(update={"lease_seconds": 600.0})
    job = ask()
    with running_worker(patient, log) as worker:
        under_way(client, job, me)
        (process,) = attempts_of(worker)
        started = time.monotonic()
        worker.send_signal(signal.SIGTERM)
        worker.wait(10.0)
        assert time.monotonic() - started < 10.0
        assert not alive(process)
    assert client.get(job, headers=me).json()["status"] == "accepted"
    with running_worker(patient, log):
        ended_job = ended(client, job, me)
    assert (ended_job["status"], attempt_of(dsn, job), results_of(dsn, job)) == ("successful", 2, 1)
    with engine.connect(dsn) as connection:
        stopped = jobs.find(connection, UUID(ended_job["jobID"]))
    assert stopped is not None
    assert stopped.failures == 0


def with_empty_ground(scene: Path, times: int, path: Path) -> Path:
    """A copy of a scene with empty ground around it, whose quicklook needs more memory."""
    with rasterio.open(scene) as small:
        size = {"width": times * small.width, "height": times * small.height}
        with rasterio.open(path, "w", **small.profile | size | {"compress": "deflate"}) as large:
            rpc = small.rpcs
            for name in ("line_scale", "samp_scale", "long_scale", "lat_scale", "height_scale"):
                # The polynomials are linear: a model over more ground has larger scales.
                setattr(rpc, name, times * getattr(rpc, name))
            large.rpcs = rpc
            large.write(small.read(1), 1, window=Window(0, 0, small.width, small.height))
    return path


def test_a_job_over_its_memory_limit_fails_cleanly_and_the_worker_lives_on(
    client: TestClient,
    me: dict[str, str],
    world: FlatWorld,
    settings: Settings,
    dsn: str,
    storage: Storage,
    log: Path,
    tmp_path: Path,
):
    large = with_empty_ground(world.tagged, 6, tmp_path / "large.tif")
    job = scene_to_register(client, me, storage, dsn, world, large)(1)
    narrow = settings.model_copy(update={"job_memory_bytes": 64 * MEBIBYTE})
    with running_worker(narrow, log) as worker:
        ended_job = ended(client, job, me)
        assert worker.poll() is None
    assert (ended_job["status"], attempt_of(dsn, job), results_of(dsn, job)) == ("failed", 1, 0)
    assert "64 MiB" in ended_job["message"]


def test_a_job_over_its_time_limit_fails_cleanly_and_the_worker_lives_on(
    client: TestClient,
    me: dict[str, str],
    ask: Callable[..., str],
    settings: Settings,
    dsn: str,
    log: Path,
):
    hasty = settings.model_copy(update={"job_seconds": 1.0})
    job = ask()
    with running_worker(hasty, log) as worker:
        ended_job = ended(client, job, me)
        assert worker.poll() is None
    assert (ended_job["status"], attempt_of(dsn, job), results_of(dsn, job)) == ("failed", 1, 0)
    assert "1 s" in ended_job["message"]


@pytest.mark.endurance
def test_a_worker_that_was_suspended_beyond_its_lease_ends_nothing_twice(
    client: TestClient,
    me: dict[str, str],
    ask: Callable[..., str],
    settings: Settings,
    dsn: str,
    log: Path,
):
    job = ask()
    with running_worker(settings, log) as sleeper:
        under_way(client, job, me)
        (process,) = attempts_of(sleeper)
        sleeper.send_signal(signal.SIGSTOP)
        os.kill(process, signal.SIGSTOP)
        with running_worker(settings, log):
            ended_job = ended(client, job, me)
            os.kill(process, signal.SIGCONT)
            sleeper.send_signal(signal.SIGCONT)
            wait_until(lambda: not alive(process), "the late process ends", 30.0)
    assert (ended_job["status"], attempt_of(dsn, job), results_of(dsn, job)) == ("successful", 2, 1)
    assert client.get(job, headers=me).json() == ended_job


def test_a_scene_without_points_fails_for_good_at_the_first_attempt(
    settings: Settings, bearer: Bearer, world: FlatWorld, dsn: str, log: Path
):
    me = bearer("register")
    with TestClient(create_app(settings)) as client, running_worker(settings, log):
        upload = client.post(
            "/scenes?name=scene.tif", content=world.tagged.read_bytes(), headers=me
        ).json()
        body = {"inputs": {"scene": upload["id"]}}
        reply = client.post("/processes/register-scene/execution", json=body, headers=me)
        ended_job = ended(client, reply.headers["location"], me)
    assert (ended_job["status"], ended_job["error"]["error"]) == ("failed", "CoverageError")
    assert attempt_of(dsn, reply.headers["location"]) == 1


def test_a_truncated_scene_fails_for_good_with_the_reason(
    settings: Settings, bearer: Bearer, world: FlatWorld, log: Path
):
    me = bearer("register")
    with TestClient(create_app(settings)) as client, running_worker(settings, log):
        half = world.tagged.read_bytes()[: world.tagged.stat().st_size // 2]
        upload = client.post("/scenes?name=scene.tif", content=half, headers=me).json()
        body = {"inputs": {"scene": upload["id"]}}
        reply = client.post("/processes/register-scene/execution", json=body, headers=me)
        ended_job = ended(client, reply.headers["location"], me)
    assert (ended_job["status"], ended_job["error"]["error"]) == ("failed", "FormatError")
    assert str(settings.data_folder) not in ended_job["message"], "no path of the server is told"


@pytest.mark.endurance
def test_a_worker_outlives_the_loss_of_all_its_connections(
    client: TestClient,
    me: dict[str, str],
    ask: Callable[..., str],
    settings: Settings,
    dsn: str,
    log: Path,
):
    patient = settings.model_copy(update={"lease_seconds": 15.0})
    job = ask()
    with running_worker(patient, log) as worker:
        under_way(client, job, me)
        with engine.connect(dsn) as connection:
            run_sql(
                connection,
                "select pg_terminate_backend(pid) from pg_stat_activity"
                " where datname = current_database() and usename = current_user"
                " and pid <> pg_backend_pid()",
            )
        ended_job = ended(client, job, me)
        other = ended(client, ask(1), me)
        assert worker.poll() is None
    assert (ended_job["status"], results_of(dsn, job)) == ("successful", 1)
    assert other["status"] == "successful", "the worker still hears of new jobs"
