"""Bodies of requests: nobody gets one read that is larger than its route and its sender allow."""

import re
from collections.abc import Iterator, MutableMapping
from itertools import product
from pathlib import Path
from typing import Any
from uuid import uuid4

import anyio
import pytest
from fastapi import FastAPI
from fastapi.routing import APIRoute, iter_route_contexts
from fastapi.testclient import TestClient

from amers.app.api import deps
from amers.app.api.body import ANONYMOUS_BODY_BYTES
from amers.app.api.routes import CallerRoute
from amers.app.config import Settings
from amers.app.main import create_app

pytestmark = pytest.mark.security

PIECE = b"II*\0" + bytes(16_380)
UPLOAD_LIMIT_BYTES = 400_000
BODY_LIMIT_BYTES = 200_000
JSON = (b"content-type", b"application/json")
SOON_S = 0.3
LIKE_UPLOADS = ("/scenes/reference", "/scenes/reference/", "/scenes%2Freference", "/scenes/../scenes")
"""Paths that a limit by prefix took for uploads."""


@pytest.fixture
def settings(dsn: str, tmp_path: Path) -> Settings:
    return Settings(
        database_url=dsn,
        data_folder=tmp_path / "data",
        public_points=True,
        upload_limit_bytes=UPLOAD_LIMIT_BYTES,
        body_limit_bytes=BODY_LIMIT_BYTES,
        body_seconds=SOON_S,
        rate_seconds=SOON_S,
    )


@pytest.fixture
def app(settings: Settings) -> Iterator[FastAPI]:
    """A started application."""
    app = create_app(settings)
    with TestClient(app):
        yield app


class Sender:
    """A caller who goes on sending for as long as the service reads.

    Attributes:
        read_bytes: how much of the body the service has taken.
        status: of the reply.
    """

    def __init__(self, pause_s: float = 0.0, piece: bytes = PIECE) -> None:
        self.pause_s = pause_s
        self.piece = piece
        self.read_bytes = 0
        self.status = 0

    async def receive(self) -> dict[str, Any]:
        if self.status:
            return {"type": "http.disconnect"}
        await anyio.sleep(self.pause_s)
        self.read_bytes += len(self.piece)
        assert self.read_bytes < 100 * UPLOAD_LIMIT_BYTES
        return {"type": "http.request", "body": self.piece, "more_body": True}

    async def send(self, message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]

    def request(self, app: FastAPI, method: str, path: str, *headers: tuple[bytes, bytes]) -> "Sender":
        """Send a request with an endless body."""
        scope = {
            **{"type": "http", "method": method, "scheme": "http", "root_path": ""},
            **{
                "path": path.replace("%2F", "/"),
                "raw_path": path.encode(),
                "query_string": b"name=a.tif",
            },
            **{"headers": [(b"host", b"localhost"), *headers], "client": ("127.0.0.1", 1)},
        }

        async def call() -> None:
            with anyio.fail_after(30):
                await app(scope, self.receive, self.send)

        anyio.run(call)
        return self


def operations(app: FastAPI) -> list[tuple[str, str, APIRoute]]:
    """Every method and path of the service, with identifiers that do not exist, and its route."""
    listed = []
    for context in iter_route_contexts(app.routes):
        route = context.original_route
        if isinstance(route, APIRoute):
            names = dict.fromkeys(route.param_convertors, str(uuid4()))
            template = re.sub(r":\w+}", "}", context.path)
            path = template.format(**{**names, "collection": "points", "process_id": "x"})
            listed += [(method, path, route) for method in sorted(context.methods)]
    return listed


def uploads(route: APIRoute) -> bool:
    return any(item.call is deps.takes_upload for item in route.dependant.dependencies)


def bearer_header(bearer: Any, scope: str) -> tuple[bytes, bytes]:
    return (b"authorization", bearer(scope)["Authorization"].encode())


def test_nobody_without_a_token_gets_more_than_a_small_body_read(app: FastAPI) -> None:
    for method, path, route in operations(app):
        for sent_method in {method, "HEAD", "OPTIONS", "GET", "PUT"}:
            sender = Sender().request(app, sent_method, path, JSON)
            assert sender.read_bytes <= ANONYMOUS_BODY_BYTES + len(PIECE), (sent_method, path)
        if uploads(route):
            assert Sender().request(app, method, path, (b"tus-resumable", b"1.0.0")).status == 401


def test_a_path_like_that_of_an_upload_is_none(app: FastAPI) -> None:
    for method, path in product(
        ("POST", "PUT", "PATCH", "DELETE", "GET", "HEAD", "OPTIONS"), LIKE_UPLOADS
    ):
        sender = Sender().request(app, method, path, JSON)
        assert sender.read_bytes <= ANONYMOUS_BODY_BYTES + len(PIECE), (method, path)


def test_a_body_is_not_read_before_its_sender_may_send_it(app: FastAPI, bearer) -> None:
    monitor = bearer_header(bearer, "monitor")
    refused = 0
    for method, path, route in operations(app):
        if route.body_field is None and not uploads(route):
            continue
        more = ((b"tus-resumable", b"1.0.0"), JSON)
        for headers, status in ((more, 401), ((monitor, *more), 403)):
            sender = Sender().request(app, method, path, *headers)
            public = headers is more and sender.status == 413
            assert public or (sender.status, sender.read_bytes) == (status, 0), (method, path)
            refused += not public
    assert refused >= 20


def test_a_known_caller_has_the_limit_of_the_route(app: FastAPI, bearer) -> None:
    admin = bearer_header(bearer, "admin")
    for method, path, route in operations(app):
        limit = UPLOAD_LIMIT_BYTES if uploads(route) else BODY_LIMIT_BYTES
        sender = Sender().request(app, method, path, admin, JSON)
        assert sender.read_bytes <= limit + len(PIECE), (method, path)
        if route.body_field is not None:
            assert (sender.status, sender.read_bytes > ANONYMOUS_BODY_BYTES) == (413, True), path


def test_an_announced_body_that_is_too_large_is_refused_unread(app: FastAPI, bearer) -> None:
    admin, gibibytes = bearer_header(bearer, "admin"), (b"content-length", b"34359738368")
    for path in ("/scenes/reference", "/scenes"):
        sender = Sender().request(app, "POST", path, admin, JSON, gibibytes)
        assert (sender.status, sender.read_bytes) == (413, 0)


@pytest.mark.parametrize("path", ["/scenes/reference", "/scenes"])
def test_a_body_that_arrives_byte_by_byte_is_given_up(app: FastAPI, bearer, path: str) -> None:
    slow = Sender(pause_s=0.1, piece=b"x")
    assert slow.request(app, "POST", path, bearer_header(bearer, "admin"), JSON).status == 408
    assert slow.read_bytes < 20


def test_an_upload_may_take_its_time_while_it_keeps_the_least_rate(app: FastAPI, bearer) -> None:
    steady = Sender(pause_s=0.05)
    reply = steady.request(app, "POST", "/scenes", bearer_header(bearer, "admin"))
    assert (reply.status, reply.read_bytes > UPLOAD_LIMIT_BYTES) == (413, True)


def test_every_route_with_a_body_knows_its_caller_before_it_reads_the_body(app: FastAPI) -> None:
    for _, path, route in operations(app):
        if route.body_field is not None or uploads(route):
            assert isinstance(route, CallerRoute), path
            assert uploads(route) or route.get_route_handler().__name__ == "handle_for_caller", path
