"""`amers serve`: the API and a worker on the private database, and all the ways it can end."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

import httpx
import numpy as np
import pytest

from amers.app.db import engine
from amers.app.storage import Storage
from amers.app.usecases.blocks.lifecycle import ingest_block, publish_block
from amers.app.usecases.tokens import create_token
from tests.factories import make_block
from tests.service_process import Service, until, users_of

pytestmark = [pytest.mark.long, pytest.mark.thorough]

POINTS = 2100
"""More features than are built as one text, so that they are streamed."""
IMAGE = b"II*\0" + bytes(400_000)
SMALL_WINDOW = 4096


@contextmanager
def running(open_folder: Path) -> Iterator[Service]:
    with Service(open_folder / uuid4().hex[:8]) as service:
        yield service
    with service.cluster.lease():
        pass


@pytest.fixture
def service(open_folder: Path) -> Iterator[Service]:
    """A running service of this test alone, which may end it."""
    with running(open_folder) as service:
        yield service


@pytest.fixture(scope="module")
def lasting(open_folder: Path) -> Iterator[Service]:
    """A running service that tests harm and leave running."""
    with running(open_folder) as service:
        yield service


@pytest.mark.parametrize(
    "ending", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.endurance)]
)
def test_a_stopped_service_stops_its_worker_and_its_database(service, ending):
    workers = service.workers()
    service.process.send_signal(ending)
    service.process.wait(timeout=60)
    assert not service.cluster.is_running()
    assert not any(Path(f"/proc/{worker}").exists() for worker in workers)


def test_a_killed_worker_is_replaced(lasting):
    (worker,) = lasting.workers()
    os.kill(worker, signal.SIGKILL)
    assert until(lambda: lasting.workers() not in ([], [worker]))
    assert lasting.is_ready()


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGSEGV])
def test_a_killed_api_is_replaced_while_its_callers_wait_and_its_worker_lives(lasting, ending):
    workers, (api,) = lasting.workers(), lasting.apis()
    os.kill(api, ending)
    assert until(lambda: not Path(f"/proc/{api}").exists())
    # A connection is not refused: it waits until the next process of the API accepts it.
    assert httpx.get(f"{lasting.url}/readyz", timeout=60).status_code == 200
    assert lasting.apis() not in ([], [api])
    assert lasting.workers() == workers
    assert f"the API ended with exit code {-ending} and is restarted" in lasting.log.read_text()


def test_a_used_port_ends_the_service_with_the_reason(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as used:
        port = used.getsockname()[1]
        run = subprocess.run(
            [sys.executable, "-m", "amers", "serve", "--port", str(port)],
            env=os.environ | {"AMERS_DATA_FOLDER": str(tmp_path)},
            capture_output=True,
            text=True,
            timeout=60,
        )
    assert run.returncode == 4
    assert run.stderr == (
        f"amers: port {port} of 127.0.0.1 is in use by another program: end that program, or choose a "
        "free port with --port or AMERS_PORT\n"
    )


def test_a_killed_database_is_restarted(lasting):
    os.kill(int((lasting.cluster.data / "postmaster.pid").read_text().splitlines()[0]), signal.SIGKILL)
    assert until(lasting.is_ready)


def test_a_service_that_is_killed_leaves_neither_api_nor_worker_behind(service):
    service.process.kill()
    service.process.wait(timeout=60)
    assert until(lambda: users_of(service.cluster.folder / "lease") == [])
    assert refuses(service.port)


def test_requests_under_way_are_answered_when_the_service_is_stopped(service, tmp_path):
    made = make_block(tmp_path / "block", count=POINTS, n_images=2, gsds_m=(2.0,), dtype=np.uint8)
    storage = Storage(service.folder / "storage")
    with service.cluster.lease() as dsn, engine.connect(dsn) as connection:
        publish_block(connection, str(ingest_block(connection, storage, made.folder).block.number))
        secret = create_token(connection, "slow", ["register"]).secret
    headers = f"Host: localhost\r\nAuthorization: Bearer {secret}\r\nConnection: close\r\n"
    with slow_line(service.port) as reading, slow_line(service.port) as sending:
        # A streamed reply with a slow reader, and an upload whose second half is missing.
        reading.sendall(
            f"GET /collections/points/items?limit={POINTS} HTTP/1.1\r\n{headers}\r\n".encode()
        )
        streamed = reading.recv(SMALL_WINDOW)
        sending.sendall(
            f"POST /scenes?name=a.tif HTTP/1.1\r\n{headers}Content-Length: {len(IMAGE)}\r\n\r\n".encode()
            + IMAGE[: len(IMAGE) // 2]
        )
        assert until(lambda: list(storage.scratch().glob("tmp*"))), "the upload has begun"
        service.process.send_signal(signal.SIGTERM)
        assert until(lambda: refuses(service.port)), "new callers are turned away"
        assert service.process.poll() is None, "those who came before are still served"
        sending.sendall(IMAGE[len(IMAGE) // 2 :])
        accepted = to_the_end(sending)
        streamed += to_the_end(reading)
    assert service.process.wait(timeout=60) == 128 + signal.SIGTERM
    head, _, body = accepted.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 201"), accepted
    assert storage.path(f"scenes/{json.loads(body)['id']}/a.tif").read_bytes() == IMAGE
    head, _, body = streamed.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200")
    text = joined(body) if b"transfer-encoding: chunked" in head.lower() else body
    assert len(json.loads(text)["features"]) == POINTS


@contextmanager
def slow_line(port: int) -> Iterator[socket.socket]:
    """A connection with a small receive buffer."""
    with socket.socket() as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SMALL_WINDOW)
        line.settimeout(60.0)
        line.connect(("127.0.0.1", port))
        yield line


def to_the_end(line: socket.socket) -> bytes:
    reply = b""
    while piece := line.recv(1 << 20):
        reply += piece
    return reply


def refuses(port: int) -> bool:
    with socket.socket() as line:
        line.settimeout(5.0)
        return line.connect_ex(("127.0.0.1", port)) != 0


def joined(chunks: bytes) -> bytes:
    """The body of a chunked reply; an error if it is incomplete."""
    text = b""
    while True:
        size, _, chunks = chunks.partition(b"\r\n")
        length = int(size, 16)
        if length == 0:
            return text
        assert len(chunks) > length, "the reply was cut off"
        text, chunks = text + chunks[:length], chunks[length + 2 :]
