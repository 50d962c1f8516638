"""A service as a separate process, on a database of the tests."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.cluster.embedded import Cluster
from amers.app.storage import Storage
from amers.app.usecases.tokens import create_token
from amers.services.types import ControlPoints
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.served import serve_block
from tests.app.worker_processes import children, wait_until
from tests.command_line import environment_of
from tests.factories import MadeBlock, make_block
from tests.service_process import free_port, until


@dataclass(frozen=True)
class Served:
    """A running service with one published block.

    Attributes:
        points: of the block; their ids in the service begin at 2^26.
        authorization: the header of a caller.
        folder: where its log and the caller's files may lie.
        dsn: of its database.
        pid: of the process of its API.
    """

    url: str
    points: ControlPoints
    authorization: dict[str, str]
    folder: Path
    dsn: str
    pid: int


@contextmanager
def service_with_a_block(
    cluster: Cluster, folder: Path, scope: str, made: MadeBlock | None = None, **environment: str
) -> Iterator[Served]:
    """A service without a worker and a token with one scope; the service is stopped at the end.

    Args:
        made: its block; by default one of 60 points.
        environment: its settings, such as `AMERS_POOL_SIZE="2"`.
    """
    with fresh_database(cluster, TEMPLATE) as dsn:
        made = made or make_block(folder / "block", count=60)
        settings = Settings(database_url=dsn, data_folder=folder / "data")
        with engine.connect(dsn) as connection:
            serve_block(connection, Storage(settings.data_folder / "storage"), made.folder)
            secret = create_token(connection, "a client", [scope]).secret
        port = free_port()
        environment = {
            **os.environ,
            "AMERS_DATABASE_URL": dsn,
            "AMERS_DATA_FOLDER": str(settings.data_folder),
            **environment,
        }
        log = folder / "log"
        with log.open("wb") as output:
            process = subprocess.Popen(
                [sys.executable, "-m", "amers", "serve", "--no-worker", "--port", str(port)],
                env=environment,
                stdout=output,
                stderr=output,
            )
        url = f"http://127.0.0.1:{port}"
        try:
            assert until(lambda: _answers(url)), log.read_text()
            authorization = {"Authorization": f"Bearer {secret}"}
            (api,) = children(process.pid)
            yield Served(url, made.points, authorization, folder, dsn, api)
        finally:
            process.terminate()
            process.wait()


def _answers(url: str) -> bool:
    try:
        return httpx.get(f"{url}/readyz").status_code == 200
    except httpx.TransportError:
        return False


@contextmanager
def running_service(settings: Settings, log: Path, *options: str) -> Iterator[str]:
    """`amers serve` with options on the installation of a test; yields its address."""
    port = free_port()
    environment = environment_of(settings)
    command = [sys.executable, "-m", "amers", "serve", "--port", str(port), *options]
    with log.open("wb") as output:
        service = subprocess.Popen(command, env=environment, stdout=output, stderr=output)
    try:
        wait_until(lambda: "running on" in log.read_text(), "the service answers")
        yield f"http://127.0.0.1:{port}"
    finally:
        service.terminate()
        service.wait(30)
