"""Heads of requests on real connections: their size, the header Host, and targets."""

import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import uvicorn

from amers.app.api.connections import MOST_HEAD_BYTES, server_options
from amers.app.config import Settings
from amers.app.main import create_app
from tests.service_process import free_port

pytestmark = pytest.mark.security

PATIENCE_S = 20.0
KNOWN = b"gcp.example.org"


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """The service without its database, which landing page and health check do not need."""
    settings = Settings(data_folder=Path("unused"), trusted_hosts=KNOWN.decode())
    port = free_port()
    options = server_options(settings)
    running = uvicorn.Server(
        uvicorn.Config(create_app(settings), port=port, lifespan="off", log_config=None, **options)
    )
    thread = threading.Thread(target=running.run)
    thread.start()
    try:
        while not running.started:
            time.sleep(0.01)
        yield port
    finally:
        running.should_exit = running.force_exit = True
        thread.join()


def reply_to(port: int, request: bytes, piece_bytes: int = 1 << 30) -> bytes:
    """All that the server sends until it closes the connection; the request is sent in pieces."""
    with socket.create_connection(("127.0.0.1", port)) as line:
        line.settimeout(PATIENCE_S)
        for start in range(0, len(request), piece_bytes):
            line.sendall(request[start : start + piece_bytes])
        reply = b""
        while piece := line.recv(1 << 16):
            reply += piece
        return reply


def request(target: bytes, *lines: bytes, version: bytes = b"1.1", method: bytes = b"GET") -> bytes:
    first = b"%b %b HTTP/%b" % (method, target, version)
    return b"\r\n".join((first, *lines, b"Connection: close", b"", b""))


@pytest.mark.parametrize("piece_bytes", [4096, 1 << 30], ids=["in pieces", "at once"])
@pytest.mark.parametrize("size", [60_000, 64_000, 70_000, 200_000, 1_000_000, 8_000_000])
@pytest.mark.parametrize("place", ["one field", "many fields", "the target"])
def test_a_head_has_at_most_64_kib_however_it_arrives(
    port: int, place: str, size: int, piece_bytes: int
):
    fields, target = [b"Host: localhost"], b"/healthz"
    if place == "one field":
        fields.append(b"X-A: " + b"x" * size)
    elif place == "many fields":
        fields += [b"X-%05d: %b" % (number, b"x" * 90) for number in range(size // 100)]
    else:
        target += b"?" + b"x" * size
    reply = reply_to(port, request(target, *fields), piece_bytes)
    expected = b"HTTP/1.1 200" if size < MOST_HEAD_BYTES else b"HTTP/1.1 431"
    assert reply.startswith(expected)
    assert (b"64 KiB" in reply) == (size > MOST_HEAD_BYTES)


@pytest.mark.parametrize(
    ("version", "hosts", "status"),
    [
        (b"1.1", [b"localhost"], b"200"),
        (b"1.1", [b"localhost:1"], b"200"),
        (b"1.1", [], b"400"),
        (b"1.1", [b"localhost", KNOWN], b"400"),
        (b"1.1", [b"localhost", b"localhost"], b"400"),
        (b"1.1", [b"evil.example"], b"400"),
        (b"1.1", [b"localhost, localhost"], b"400"),
        (b"1.1", [b"a@localhost"], b"400"),
        (b"1.1", [b"localhost:80:80"], b"400"),
        (b"1.1", [b"localhost/a"], b"400"),
        (b"1.1", [b""], b"400"),
        (b"1.0", [], b"200"),
        (b"1.0", [b"localhost"], b"200"),
        (b"1.0", [b"localhost", KNOWN], b"400"),
        (b"1.0", [b"evil.example"], b"400"),
    ],
)
def test_a_request_names_one_host_of_the_service(
    port: int, version: bytes, hosts: list[bytes], status: bytes
):
    for path in (b"/conformance", b"/nothing"):
        reply = reply_to(port, request(path, *(b"Host: " + host for host in hosts), version=version))
        found = b"404" if status == b"200" and path == b"/nothing" else status
        assert reply.split()[1] == found, reply
        assert found != b"400" or b"application/problem+json" in reply


@pytest.mark.parametrize(
    ("target", "host", "status"),
    [
        (b"http://gcp.example.org/", b"localhost", b"200"),
        (b"http://gcp.example.org", b"localhost", b"200"),
        (b"http://gcp.example.org?f=json", b"localhost", b"200"),
        (b"https://gcp.example.org:443/?f=json", b"evil.example", b"200"),
        (b"http://evil.example/", b"localhost", b"400"),
        (b"http://a@gcp.example.org/", b"localhost", b"400"),
    ],
)
def test_the_host_of_a_target_that_is_a_whole_address_counts(
    port: int, target: bytes, host: bytes, status: bytes
):
    reply = reply_to(port, request(target, b"Host: " + host, b"Accept: application/json"))
    assert reply.split()[1] == status, reply
    assert status == b"400" or b'"href":"http://gcp.example.org' in reply
    for hosts in ((), (b"Host: localhost", b"Host: localhost")):
        assert reply_to(port, request(target, *hosts)).split()[1] == b"400"


def test_a_head_request_gets_headers_alone(port: int):
    whole = reply_to(port, request(b"/conformance", b"Host: localhost"))
    head = reply_to(port, request(b"/conformance", b"Host: localhost", method=b"HEAD"))
    length = len(whole.partition(b"\r\n\r\n")[2])
    assert head.endswith(b"\r\n\r\n")
    assert b"content-length: %d" % length in head


def test_options_asks_about_the_whole_service(port: int):
    reply = reply_to(port, request(b"*", b"Host: localhost", method=b"OPTIONS"))
    assert reply.startswith(b"HTTP/1.1 204")
    assert b"allow: GET, HEAD, OPTIONS" in reply
    assert reply_to(port, request(b"*", b"Host: localhost")).split()[1] == b"404"
