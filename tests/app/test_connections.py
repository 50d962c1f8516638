"""Connections of the server: their number, in all and per address, and proxies that are trusted."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
import uvicorn
from pydantic import ValidationError

from amers.app.api import connections
from amers.app.config import Settings
from tests.service_process import free_port

PATIENCE_S = 10.0
FORWARDED = b"X-Forwarded-For: 192.0.2.7\r\nX-Forwarded-Proto: https\r\n"
HEAD = b"GET %b HTTP/1.1\r\nHost: localhost\r\n" + FORWARDED + b"\r\n"
SLOW = b"/slow"
ENDS = (b" http", b" https")


@contextmanager
def server(**settings: object) -> Iterator[int]:
    """A server with the protocol of the service, whose replies name caller and scheme; its port."""
    go_on = threading.Event()

    async def app(scope, receive, send) -> None:
        if scope["path"] == SLOW.decode():
            await receive()
            while not go_on.is_set() and (await receive())["type"] != "http.disconnect":
                pass
        text = f"{scope['client'][0]} {scope['scheme']}".encode()
        length = (b"content-length", b"%d" % len(text))
        await send({"type": "http.response.start", "status": 200, "headers": [length]})
        await send({"type": "http.response.body", "body": text})

    port = free_port()
    options = connections.server_options(Settings(**settings))
    running = uvicorn.Server(
        uvicorn.Config(app, port=port, lifespan="off", log_config=None, access_log=False, **options)
    )
    thread = threading.Thread(target=running.run)
    thread.start()
    try:
        while not running.started:
            time.sleep(0.01)
        yield port
    finally:
        go_on.set()
        running.should_exit = running.force_exit = True
        thread.join()


def ask(line: socket.socket, path: bytes = b"/") -> bytes:
    """The whole reply on a connection; empty when the server has closed it.

    Head and body of a reply may come in two pieces.
    """
    try:
        line.sendall(HEAD % path)
        reply = line.recv(4096)
        while reply and not reply.endswith(ENDS):
            piece = line.recv(4096)
            assert piece, f"the reply broke off: {reply!r}"
            reply += piece
        return reply
    except ConnectionError:
        return b""


def connect(lines: ExitStack, port: int) -> socket.socket:
    line = lines.enter_context(socket.create_connection(("127.0.0.1", port)))
    line.settimeout(PATIENCE_S)
    return line


@pytest.mark.parametrize("limit", ["connections", "connections_per_address"])
def test_a_newcomer_gets_the_place_of_the_connection_that_is_idle_longest(limit: str) -> None:
    with server(**{limit: 3}) as port, ExitStack() as lines:
        first, second, third = (connect(lines, port) for _ in range(3))
        for line in (second, third, first):
            assert b"200 OK" in ask(line)
        assert b"200 OK" in ask(connect(lines, port))
        assert ask(second) == b"", "it was idle longest"
        assert b"200 OK" in ask(first)


@pytest.mark.parametrize("limit", ["connections", "connections_per_address"])
def test_a_newcomer_is_refused_when_every_connection_has_a_request(limit: str) -> None:
    with server(**{limit: 2}) as port, ExitStack() as lines:
        busy = [connect(lines, port) for _ in range(2)]
        for line in busy:
            line.sendall(HEAD % SLOW)
        time.sleep(0.2)
        refused = connect(lines, port)
        assert refused.recv(4096).startswith(b"HTTP/1.1 503")
        busy[0].close()
        time.sleep(0.2)
        assert b"200 OK" in ask(connect(lines, port))


def test_a_proxy_that_is_not_named_is_not_believed() -> None:
    with server() as port, ExitStack() as lines:
        assert ask(connect(lines, port)).endswith(b"127.0.0.1 http")


def test_a_named_proxy_states_the_caller_and_has_as_many_connections_as_it_needs() -> None:
    with (
        server(trusted_proxies="127.0.0.1", connections_per_address=1) as port,
        ExitStack() as lines,
    ):
        opened = [connect(lines, port) for _ in range(3)]
        for line in opened:
            assert ask(line).endswith(b"192.0.2.7 https")
        assert ask(opened[0]).endswith(b"192.0.2.7 https")


def test_a_proxy_is_named_by_address_or_network() -> None:
    proxies = Settings(trusted_proxies="10.0.0.5, 10.1.0.0/24,2001:db8::/32").trusted_proxies
    assert proxies == ("10.0.0.5/32", "10.1.0.0/24", "2001:db8::/32")
    with pytest.raises(ValidationError):
        Settings(trusted_proxies="proxy.example.org")


@pytest.mark.parametrize(
    ("kibibytes", "end", "status"), [(50, b"\r\n", b"200"), (50, b"", b"408"), (70, b"", b"431")]
)
def test_a_head_that_grows_is_given_up_beyond_64_kib(kibibytes: int, end: bytes, status: bytes) -> None:
    """Long before the time in which a smaller one has to be complete."""
    with server(head_seconds=0.5) as port, ExitStack() as lines:
        line = connect(lines, port)
        field = b"X-Filler: " + b"x" * 1012 + b"\r\n"
        line.sendall((HEAD % b"/")[:-2] + field * kibibytes + end)
        assert line.recv(4096).startswith(b"HTTP/1.1 " + status)


def test_many_requests_on_one_connection_do_not_end_it() -> None:
    with server(head_seconds=0.3) as port, ExitStack() as lines:
        line = connect(lines, port)
        for _ in range(5):
            assert b"200 OK" in ask(line)
            time.sleep(0.1)
        line.sendall(3 * (HEAD % b"/"))
        replies = b""
        while replies.count(b"200 OK") < 3:
            replies += line.recv(4096)
