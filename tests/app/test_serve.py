"""`amers serve`: the API and a worker on the private database, and what is left after any end of it."""

import os
import signal
from pathlib import Path
from uuid import uuid4

import pytest

from tests.serving import Service, until, users_of


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
