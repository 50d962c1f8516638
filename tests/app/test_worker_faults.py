"""Workers that die, hang, are stopped or run out of memory during a real registration."""

import os
import signal
import time
from pathlib import Path
from typing import Any

import pytest
import rasterio
from rasterio.windows import Window

from amers.app.config import Settings
from amers.app.db import engine
from tests.app.flat_world import FlatWorld, make_flat_world
from tests.app.installation import Ask, Installation
from tests.app.worker_processes import (
    alive,
    kill,
    wait_until,
)
from tests.statements import run_in

pytestmark = [pytest.mark.long, pytest.mark.thorough]

LEASE_S = 2.0
PASSES = 100
MEBIBYTE = 1 << 20


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    """A block, and a scene that takes some seconds to register on it."""
    return make_flat_world(tmp_path_factory.mktemp("world"))


@pytest.fixture
def settings(dsn: str, tmp_path: Path) -> Settings:
    """An installation with short leases, which notices a dead worker soon."""
    return Settings(database_url=dsn, data_folder=tmp_path / "data", lease_seconds=LEASE_S)


@pytest.fixture
def ask(installation: Installation, world: FlatWorld) -> Ask:
    """Requests the registration of the scene in some passes; its points are published."""
    return installation.registering(world)


def test_a_killed_worker_loses_its_job_to_another_and_there_is_one_result(
    installation: Installation, ask: Ask
):
    job = ask(PASSES)
    with installation.worker() as first:
        process = installation.process(job, first)
        kill(first.pid)
        first.wait()
        wait_until(lambda: not alive(process), "the job's process dies with its worker", 5.0)
    assert installation.me.get(job).json()["status"] == "running", "nobody has noticed yet"
    with installation.worker():
        ended_job = installation.ended(job)
    assert installation.outcome(ended_job) == ("successful", 2, 1)
    attempts = {key.split("/")[2] for key in installation.storage.keys("results")}
    assert attempts == {"2"}


@pytest.mark.endurance
def test_a_killed_job_process_is_tried_again_by_the_worker_that_lives_on(
    installation: Installation, ask: Ask
):
    job = ask(PASSES)
    with installation.worker() as worker:
        process = installation.process(job, worker)
        kill(process)
        ended_job = installation.ended(job)
        assert worker.poll() is None
    assert installation.outcome(ended_job) == ("successful", 2, 1)


def test_a_dismissed_job_stops_within_seconds_and_leaves_no_result(installation: Installation, ask: Ask):
    job = ask(PASSES)
    with installation.worker() as worker:
        process = installation.process(job, worker)
        assert installation.me.delete(job).json()["status"] == "dismissed"
        wait_until(lambda: not alive(process), "the work stops", 5.0)
        other = installation.ended(ask(1))
    assert other["status"] == "successful", "the worker lives on"
    assert installation.me.get(job).json()["status"] == "dismissed"
    assert installation.results(job) == 0


def test_a_job_that_writes_too_large_a_file_fails_at_once_and_leaves_nothing(
    installation: Installation, ask: Ask
):
    small = installation.me.get(ask(1)).json()["inputs"]
    # The image has 2.9 MB, and so has its copy.
    job = installation.me.execute(
        "register-scene", {"scene": small["scene"], "copy_image": True}
    ).headers["location"]
    with installation.worker({"AMERS_JOB_FILE_BYTES": str(MEBIBYTE)}):
        failed_job = installation.ended(job)
    assert failed_job["status"] == "failed"
    assert failed_job["error"]["title"] == "File size limit"
    assert "larger than 1 MiB" in failed_job["error"]["detail"]
    assert installation.row(job).attempt == 1
    job_id = failed_job["jobID"]
    assert installation.storage.keys(f"results/{job_id}") == []
    assert not list(installation.storage.scratch().glob(f"job-{job_id}*"))


@pytest.mark.endurance
def test_a_stopped_worker_gives_its_job_back_at_once(installation: Installation, ask: Ask):
    job = ask(PASSES)
    with installation.worker(lease_seconds=600.0) as worker:
        process = installation.process(job, worker)
        started = time.monotonic()
        worker.send_signal(signal.SIGTERM)
        worker.wait(10.0)
        assert time.monotonic() - started < 10.0
        assert not alive(process)
    assert installation.me.get(job).json()["status"] == "accepted"
    with installation.worker(lease_seconds=600.0):
        ended_job = installation.ended(job)
    assert installation.outcome(ended_job) == ("successful", 2, 1)
    assert installation.row(job).failures == 0


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
    installation: Installation, world: FlatWorld, tmp_path: Path
):
    large = with_empty_ground(world.tagged, 6, tmp_path / "large.tif")
    job = installation.registering(world, large)(1)
    with installation.worker(job_memory_bytes=64 * MEBIBYTE) as worker:
        ended_job = installation.ended(job)
        assert worker.poll() is None
    assert installation.outcome(ended_job) == ("failed", 1, 0)
    assert "64 MiB" in ended_job["message"]


def test_a_job_over_its_time_limit_fails_cleanly_and_the_worker_lives_on(
    installation: Installation, ask: Ask
):
    job = ask(PASSES)
    with installation.worker(job_seconds=1.0) as worker:
        ended_job = installation.ended(job)
        assert worker.poll() is None
    assert installation.outcome(ended_job) == ("failed", 1, 0)
    assert "1 s" in ended_job["message"]


@pytest.mark.endurance
def test_a_worker_that_was_suspended_beyond_its_lease_ends_nothing_twice(
    installation: Installation, ask: Ask
):
    job = ask(PASSES)
    with installation.worker() as sleeper:
        process = installation.process(job, sleeper)
        sleeper.send_signal(signal.SIGSTOP)
        os.kill(process, signal.SIGSTOP)
        with installation.worker():
            ended_job = installation.ended(job)
            os.kill(process, signal.SIGCONT)
            sleeper.send_signal(signal.SIGCONT)
            wait_until(lambda: not alive(process), "the late process ends", 30.0)
    assert installation.outcome(ended_job) == ("successful", 2, 1)
    assert installation.me.get(job).json() == ended_job


def register_alone(installation: Installation, image: bytes) -> dict[str, Any]:
    """The ended job of the registration of an image, where no points are."""
    scene = installation.me.scene(image)
    with installation.worker():
        reply = installation.me.execute("register-scene", {"scene": scene})
        return installation.ended(reply.headers["location"])


def test_a_scene_without_points_fails_for_good_at_the_first_attempt(
    installation: Installation, world: FlatWorld
):
    job = register_alone(installation, world.tagged.read_bytes())
    assert (job["status"], job["error"]["error"]) == ("failed", "CoverageError")
    assert installation.row(job["jobID"]).attempt == 1


def test_a_truncated_scene_fails_for_good_with_the_reason(installation: Installation, world: FlatWorld):
    job = register_alone(installation, world.tagged.read_bytes()[: world.tagged.stat().st_size // 2])
    assert (job["status"], job["error"]["error"]) == ("failed", "FormatError")
    folder = str(installation.settings.data_folder)
    assert folder not in job["message"], "no path of the server is told"


@pytest.mark.endurance
def test_a_worker_outlives_the_loss_of_all_its_connections(installation: Installation, ask: Ask):
    job = ask(PASSES)
    with installation.worker(lease_seconds=15.0) as worker:
        installation.process(job, worker)
        run_in(
            engine.connect(installation.dsn),
            "select pg_terminate_backend(pid) from pg_stat_activity"
            " where datname = current_database() and usename = current_user"
            " and pid <> pg_backend_pid()",
        )
        ended_job = installation.ended(job)
        other = installation.ended(ask(1))
        assert worker.poll() is None
    assert (ended_job["status"], installation.results(job)) == ("successful", 1)
    assert other["status"] == "successful", "the worker still hears of new jobs"
