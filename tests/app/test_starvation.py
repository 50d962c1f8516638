"""Attacks on a running service, and a second caller throughout, who notices none of them."""

import json
import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from amers.app.db import engine
from amers.app.usecases.tokens import create_token
from tests.app.bystander import Bystander, bystander
from tests.app.running_service import Served, service_with_a_block
from tests.factories import make_block

pytestmark = [pytest.mark.security, pytest.mark.long]

POINTS = 2_100
"""More features than are built as one text, so that they are streamed."""
SMALL_WINDOW = 4096
HEAD_S, BODY_S, RATE_S, READ_S = 1.0, 1.5, 1.0, 2.0
CONNECTIONS, PER_ADDRESS = 60, 50
PATIENCE_S = 20.0
MEBIBYTE = 1 << 20
FILE_BYTES = 12 * MEBIBYTE
REPLIES = 20
POINT = f"/collections/points/items/{1 << 26}"
MEMORY_BYTES = 40 * MEBIBYTE
ENDED = (ConnectionError,)


@pytest.fixture(scope="module")
def served(cluster, tmp_path_factory) -> Iterator[Served]:
    """A service with short limits, and the token of an attacker."""
    folder = tmp_path_factory.mktemp("served")
    made = make_block(folder / "block", count=POINTS, n_images=2, gsds_m=(2.0,), dtype=np.uint8)
    with service_with_a_block(
        cluster,
        folder,
        "register",
        made,
        AMERS_HEAD_SECONDS=str(HEAD_S),
        AMERS_BODY_SECONDS=str(BODY_S),
        AMERS_RATE_SECONDS=str(RATE_S),
        AMERS_READ_TIMEOUT_SECONDS=str(READ_S),
        AMERS_CONNECTIONS=str(CONNECTIONS),
        AMERS_CONNECTIONS_PER_ADDRESS=str(PER_ADDRESS),
    ) as served:
        yield served


@pytest.fixture(scope="module")
def second_caller(served) -> dict[str, str]:
    """The header of a caller with another token."""
    with engine.connect(served.dsn) as connection:
        secret = create_token(connection, "a second caller", ["read"]).secret
    return {"Authorization": f"Bearer {secret}"}


@pytest.fixture
def unharmed(served, second_caller) -> Iterator[Bystander]:
    """A second caller, who asks until the end of the test; it fails if he noticed the attack."""
    with bystander(served.url, POINT, second_caller, pause_s=0.2) as caller:
        yield caller
    caller.check()


@contextmanager
def lines(served: Served, count: int) -> Iterator[list[socket.socket]]:
    """Connections with small receive buffers."""
    address = urlsplit(served.url)
    with ExitStack() as opened:
        made = []
        for _ in range(count):
            line = opened.enter_context(socket.socket())
            line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SMALL_WINDOW)
            line.settimeout(PATIENCE_S)
            line.connect((address.hostname, address.port))
            made.append(line)
        yield made


def head(method: str, path: str, headers: dict[str, str]) -> bytes:
    fields = "".join(f"{name}: {value}\r\n" for name, value in {"Host": "localhost", **headers}.items())
    return f"{method} {path} HTTP/1.1\r\n{fields}\r\n".encode()


def seconds_until_closed(line: socket.socket, dripping: bytes = b"") -> tuple[float, bytes]:
    """How long the service keeps a connection on which a byte arrives now and then, and its reply."""
    started, reply = time.monotonic(), b""
    line.settimeout(0.2)
    while time.monotonic() - started < PATIENCE_S:
        try:
            if dripping:
                line.sendall(dripping)
            piece = line.recv(4096)
            if not piece:
                return time.monotonic() - started, reply
            reply += piece
        except TimeoutError:
            continue
        except ENDED:
            return time.monotonic() - started, reply
    raise AssertionError(f"still open after {PATIENCE_S:g} s")


def resident_bytes(served: Served) -> int:
    fields = Path(f"/proc/{served.pid}/statm").read_text().split()
    return int(fields[1]) * 4096


def at_once(count: int, work: Callable[[], None]) -> None:
    threads = [threading.Thread(target=work) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


@pytest.mark.parametrize("announced", [True, False], ids=["announced", "chunked"])
@pytest.mark.parametrize("known", [True, False], ids=["token", "anybody"])
def test_a_body_of_32_gib_is_refused_at_once(served, unharmed, known, announced) -> None:
    length = {"Content-Length": str(1 << 35)} if announced else {"Transfer-Encoding": "chunked"}
    caller = served.authorization if known else {}
    headers = {"Content-Type": "application/json", **length, **caller}
    piece = b" " * MEBIBYTE if announced else b"100000\r\n" + b" " * MEBIBYTE + b"\r\n"
    before = resident_bytes(served)
    with lines(served, 1) as [line]:
        line.sendall(head("POST", "/scenes/reference", headers))
        line.settimeout(PATIENCE_S)
        sent = 0

        def send_on() -> None:
            nonlocal sent
            try:
                while sent < 10_000:
                    line.sendall(piece)
                    sent += 1
            except OSError:
                return

        sending = threading.Thread(target=send_on)
        sending.start()
        reply = line.recv(4096)
        sending.join()
    status = b"413" if known else b"401"
    assert reply.startswith(b"HTTP/1.1 " + status), reply
    assert sent < 10_000, "the service went on reading"
    assert resident_bytes(served) - before < MEMORY_BYTES


def test_an_upload_that_claims_to_be_json_is_not_kept_in_memory(served, unharmed) -> None:
    image = b"II*\0" + bytes(2 * MEMORY_BYTES)
    headers = {"Content-Type": "application/json", **served.authorization}
    before = resident_bytes(served)
    for _ in range(6):  # one takes half a second, in which the bystander asks twice
        connection = HTTPConnection(urlsplit(served.url).netloc)
        connection.request("POST", "/scenes?name=a.tif", image, headers)
        assert connection.getresponse().status == 201
        assert resident_bytes(served) - before < MEMORY_BYTES


def test_idle_connections_give_way_to_newcomers(served, unharmed) -> None:
    with lines(served, 3 * PER_ADDRESS):
        time.sleep(0.5 * HEAD_S)


def test_a_connection_without_a_request_is_closed(served, unharmed) -> None:
    with lines(served, PER_ADDRESS // 2) as opened:
        assert all(seconds_until_closed(line)[0] < 3 * HEAD_S for line in opened)


def test_a_head_that_arrives_byte_by_byte_is_given_up(served, unharmed) -> None:
    with lines(served, 1) as [line]:
        line.sendall(b"GET / HTTP/1.1\r\nX: ")
        seconds, reply = seconds_until_closed(line, dripping=b"x")
    assert reply.startswith(b"HTTP/1.1 408")
    assert seconds < 3 * HEAD_S


@pytest.mark.parametrize("dripping", [b"\r\n", b"x"], ids=["empty lines", "body after the reply"])
def test_a_connection_cannot_be_kept_by_bytes_that_are_no_request(served, unharmed, dripping) -> None:
    body = {"Content-Length": "1000000"} if dripping == b"x" else {}
    with lines(served, 1) as [line]:
        line.sendall(head("GET", "/healthz", body))
        assert line.recv(4096).startswith(b"HTTP/1.1 200")
        assert seconds_until_closed(line, dripping)[0] < 6 * HEAD_S


@pytest.mark.parametrize("tail", [b"X-Long: ", b"X: y\r\nX-Long: "], ids=["field", "fields"])
@pytest.mark.parametrize("trailer", [True, False], ids=["trailer", "head"])
def test_a_head_without_an_end_is_refused(served, unharmed, tail, trailer) -> None:
    begin = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n"
    if trailer:
        begin += b"Transfer-Encoding: chunked\r\n\r\n0\r\n"
    sent = 0
    with lines(served, 1) as [line]:
        line.sendall(begin + tail)
        try:
            while sent < 100 * MEBIBYTE:
                line.sendall(b"x" * 100_000)
                sent += 100_000
        except OSError:
            pass
    assert sent < 20 * MEBIBYTE


@pytest.mark.parametrize("path", ["/scenes/reference", "/scenes?name=a.tif"], ids=["json", "upload"])
def test_bodies_that_arrive_byte_by_byte_are_given_up(served, unharmed, path) -> None:
    headers = {"Content-Length": "10000", "Content-Type": "application/json", **served.authorization}
    with lines(served, PER_ADDRESS - 20) as opened:
        for line in opened:
            line.sendall(head("POST", path, headers) + b"II*\0")
        statuses = set()
        for line in opened:
            seconds, reply = seconds_until_closed(line, dripping=b" ")
            statuses.add(reply[9:12])
            assert seconds < 10 * BODY_S
        assert statuses <= {b"408", b"429", b""}, statuses
        assert b"408" in statuses


@pytest.fixture(scope="module")
def file_path(served) -> str:
    """The path of an uploaded file."""
    image = b"II*\0" + bytes(FILE_BYTES)
    connection = HTTPConnection(urlsplit(served.url).netloc)
    connection.request("POST", "/scenes?name=a.tif", image, served.authorization)
    reply = connection.getresponse()
    document = json.loads(reply.read())
    assert reply.status == 201, document
    return f"/scenes/{document['id']}/files/a.tif"


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["stream", "file"])
def test_twelve_readers_who_take_nothing_are_given_up(served, unharmed, file_path, kind) -> None:
    path = file_path if kind == "file" else f"/collections/points/items?limit={POINTS}"
    with lines(served, 12) as opened:
        for line in opened:
            # More replies than the buffers of the connection have room for.
            line.sendall(REPLIES * head("GET", path, served.authorization))
        time.sleep(5 * RATE_S)
        for line in opened:
            received = b""
            with suppress(*ENDED):
                while piece := line.recv(MEBIBYTE):
                    received += piece
            assert received.count(b"HTTP/1.1 200") < REPLIES


@pytest.mark.thorough
def test_sixteen_heavy_filters_of_one_caller_leave_connections_to_others(served, unharmed) -> None:
    angle = np.linspace(0.0, 2.0 * math.pi, 3_000)
    angle[-1] = 0.0
    radius_deg = 0.5 + 0.4 * np.sin(500 * angle)
    offsets = radius_deg[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    polygon = {
        "type": "Polygon",
        "coordinates": [(served.points.lon_lat_h[:, :2].mean(axis=0) + offsets).tolist()],
    }
    touched = {"op": "s_touches", "args": [{"property": "geometry"}, polygon]}
    body = json.dumps({"filter-lang": "cql2-json", "filter": touched, "limit": 10})
    statuses = []

    def ask() -> None:
        connection = HTTPConnection(urlsplit(served.url).netloc, timeout=60)
        headers = {"Content-Type": "application/json", **served.authorization}
        connection.request("POST", "/collections/points/search", body, headers)
        reply = connection.getresponse()
        statuses.append(reply.status)

    at_once(16, ask)
    assert len(statuses) == 16
    assert set(statuses) <= {200, 429, 503}, statuses
