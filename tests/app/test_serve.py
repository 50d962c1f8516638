"""`amers serve`: the API and a worker on the private database, and what is left after any end of it."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from uuid import uuid4

import httpx
import pytest

from app.db.embedded import Cluster

patience_s = 90.0


class Service:
    """A running `amers serve` with a data folder of its own."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.cluster = Cluster(folder / "postgres")
        environment = {
            name: value for name, value in os.environ.items() if not name.startswith("AMERS_")
        }
        self.process = subprocess.Popen(
            [sys.executable, "-m", "app.cli.main", "serve", "--port", str(self.port)],
            env={**environment, "AMERS_DATA_FOLDER": str(folder)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def is_ready(self) -> bool:
        try:
            return httpx.get(f"http://127.0.0.1:{self.port}/readyz", timeout=30).status_code == 200
        except httpx.TransportError:
            return False

    def workers(self) -> list[int]:
        """The processes that hold the cluster's lease and are not the API."""
        lease = self.cluster.folder / "lease"
        return [number for number in users_of(lease) if number != self.process.pid]


def users_of(file: Path) -> list[int]:
    found = set()
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if link.samefile(file):
                found.add(int(link.parts[2]))
        except OSError:
            continue
    return sorted(found)


def until(condition) -> bool:
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.2)
    return False


@pytest.fixture
def service(open_folder):
    service = Service(open_folder / uuid4().hex[:8])
    try:
        assert until(service.is_ready)
        assert until(service.workers)
        yield service
    finally:
        service.process.terminate()
        service.process.wait(timeout=60)
        with service.cluster.lease():
            pass


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGINT])
def test_a_service_that_is_told_to_end_takes_its_worker_and_its_database_along(service, ending):
    workers = service.workers()
    service.process.send_signal(ending)
    service.process.wait(timeout=60)
    assert not service.cluster.is_running()
    assert not any(Path(f"/proc/{worker}").exists() for worker in workers)


def test_a_worker_that_is_killed_gets_a_successor(service):
    (worker,) = service.workers()
    os.kill(worker, signal.SIGKILL)
    assert until(lambda: service.workers() not in ([], [worker]))
    assert service.is_ready()


def test_a_database_that_is_killed_is_back_without_anybodys_help(service):
    os.kill(int((service.cluster.data / "postmaster.pid").read_text().splitlines()[0]), signal.SIGKILL)
    assert until(service.is_ready)


def test_a_service_that_is_killed_leaves_no_worker_behind(service):
    service.process.kill()
    service.process.wait(timeout=60)
    assert until(lambda: users_of(service.cluster.folder / "lease") == [])
