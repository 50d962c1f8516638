"""Real worker processes on the database of a test, and the jobs as callers of the API see them."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.storage import Storage
from tests.app.flat_world import SIGMA_M, FlatWorld, publish_world
from tests.command_line import environment_of

PATIENCE_S = 240.0
ENDED = ("successful", "failed", "dismissed")


@contextmanager
def running_worker(
    settings: Settings, log: Path, *prefix: str, **more: str
) -> Iterator["subprocess.Popen[bytes]"]:
    """`amers worker` as a separate process; at the end it is killed with all it started.

    Args:
        prefix: the command that runs it, as `ip netns exec NAME`.
        more: of its environment.
    """
    environment = environment_of(settings) | {
        "AMERS_LEASE_SECONDS": str(settings.lease_seconds),
        "AMERS_JOB_SECONDS": str(settings.job_seconds),
        "AMERS_JOB_MEMORY_BYTES": str(settings.job_memory_bytes),
        **({"AMERS_INGEST_FOLDER": str(settings.ingest_folder)} if settings.ingest_folder else {}),
        **more,
    }
    with log.open("ab") as output:
        worker = subprocess.Popen(
            [*prefix, sys.executable, "-m", "amers", "worker"],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
        )
    try:
        yield worker
    finally:
        if worker.poll() is None:
            worker.kill()
        worker.wait()


def children(pid: int) -> list[int]:
    """The living child processes of a process."""
    pids = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = path.read_text().rpartition(")")[2].split()[:2]
        except OSError:
            continue
        if int(parent) == pid and state != "Z":
            pids.append(int(path.parent.name))
    return pids


def attempts_of(worker: "subprocess.Popen[bytes]") -> list[int]:
    """The processes of the attempts of a worker, which the server of its warm processes has forked."""
    return [attempt for server in children(worker.pid) for attempt in children(server)]


def alive(pid: int) -> bool:
    """Whether a process is running."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until(condition: Callable[[], Any], what: str, patience_s: float = PATIENCE_S) -> Any:
    """The first true value of a condition.

    Raises:
        AssertionError: it did not become true in time.
    """
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        value = condition()
        if value:
            return value
        time.sleep(0.05)
    raise AssertionError(f"not within {patience_s:g} s: {what}")


def ended(client: TestClient, job_url: str, headers: dict[str, str]) -> dict[str, Any]:
    """The job, once it has ended."""

    def told() -> dict[str, Any] | None:
        job: dict[str, Any] = client.get(job_url, headers=headers).json()
        return job if job["status"] in ENDED else None

    result: dict[str, Any] = wait_until(told, f"{job_url} ends")
    return result


def under_way(client: TestClient, job_url: str, headers: dict[str, str]) -> dict[str, Any]:
    """The job, once its work has started; an error if it ends before."""

    def told() -> dict[str, Any] | None:
        job: dict[str, Any] = client.get(job_url, headers=headers).json()
        assert job["status"] in ("accepted", "running"), job
        return job if job["progress"] > 0 else None

    job: dict[str, Any] = wait_until(told, "the work is under way")
    return job


def scene_to_register(
    client: TestClient,
    headers: dict[str, str],
    storage: Storage,
    dsn: str,
    world: FlatWorld,
    image: Path | None = None,
) -> Callable[[int], str]:
    """A scene in a service that has its points.

    Args:
        image: of the scene, instead of that of the world.

    Returns:
        What asks for its registration and returns the address of the job. It takes how many passes
        the work is made of: one is done in a blink, many leave time to do harm in the middle.
    """
    publish_world(dsn, storage, world)
    content = (image or world.tagged).read_bytes()
    upload = client.post(f"/scenes?name=scene.tif&sigma_m={SIGMA_M}", content=content, headers=headers)

    def ask(passes: int) -> str:
        inputs = {"scene": upload.json()["id"], "options": {"fine_stages": passes}}
        body = {"inputs": inputs}
        reply = client.post("/processes/register-scene/execution", json=body, headers=headers)
        return str(reply.headers["location"])

    return ask


def kill(pid: int) -> None:
    """Kill a process."""
    os.kill(pid, signal.SIGKILL)
