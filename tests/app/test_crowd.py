"""Many more concurrent requests than threads and connections: all are answered."""

from collections.abc import AsyncIterator, MutableMapping
from contextlib import suppress
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import anyio
import httpx
import pytest
from anyio import to_thread
from fastapi import FastAPI
from starlette.requests import ClientDisconnect

from amers.app.api import deps, streams
from amers.app.api.turns import Turns
from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.features import pages as features
from amers.app.main import create_app
from amers.app.storage import Storage
from tests.app.served import serve_block
from tests.factories import make_block

POINTS = 60
TIMES_MORE = 6
FIRST_ID = 1 << 26
CONNECTIONS = 1
SOON_S = 0.2
PATIENCE_S = 60.0
ITEMS = "/collections/points/items"
SCENES = "/scenes?name=a.tif"
IMAGE = b"II*\0"


@pytest.fixture
def app(dsn: str, tmp_path: Path) -> FastAPI:
    """An application with one connection for reading and one for writing, and a block of 60 points."""
    settings = Settings(database_url=dsn, data_folder=tmp_path / "data", pool_size=CONNECTIONS)
    with engine.connect(dsn) as connection:
        made = make_block(tmp_path / "block", count=POINTS)
        serve_block(connection, Storage(settings.data_folder / "storage"), made.folder)
    return create_app(settings)


def client_of(app: FastAPI, headers: dict[str, str] | None = None) -> httpx.AsyncClient:
    """A client in the process of a started application."""
    return httpx.AsyncClient(
        transport=httpx.ASGITransport(app), base_url="http://localhost", headers=headers
    )


async def answered(app: FastAPI, requests: list[httpx.Request]) -> list[httpx.Response]:
    """The replies to requests that are all sent at once."""
    replies: list[httpx.Response] = []
    async with app.router.lifespan_context(app), anyio.create_task_group() as tasks:
        client = client_of(app)

        async def send(request: httpx.Request) -> None:
            replies.append(await client.send(request))

        for request in requests:
            tasks.start_soon(send, request)
    return replies


def test_all_of_many_more_requests_than_threads_and_connections_are_answered(
    app: FastAPI, bearer, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Pages of more pieces than are read ahead keep their connection while others wait for it.
    monkeypatch.setattr(features, "ROWS_AT_ONCE", POINTS // 6)
    kinds = [
        ("GET", f"http://localhost{ITEMS}/{FIRST_ID}", 200),
        ("GET", f"http://localhost{ITEMS}?limit=10000", 200),
        ("GET", f"http://localhost{ITEMS}/{FIRST_ID + 1}/chips", 200),
        ("GET", "http://localhost/tokens", 200),
        ("POST", "http://localhost/tokens", 201),
    ]
    headers = bearer("admin")
    body = {"scopes": ["read"]}
    many = TIMES_MORE * deps.threads_for(Settings(pool_size=CONNECTIONS))
    requests = [
        httpx.Request(
            how, url, headers=headers, json={"name": f"{k} of many", **body} if how == "POST" else None
        )
        for k, (how, url, _) in enumerate(islice(cycle(kinds), many))
    ]
    replies = anyio.run(answered, app, requests)
    assert len(replies) == many
    statuses = {(reply.request.method, str(reply.url), reply.status_code) for reply in replies}
    assert statuses == set(kinds)
    pages = [reply.json() for reply in replies if reply.url.path.endswith("/items")]
    assert {page["numberReturned"] for page in pages} == {POINTS}


@pytest.mark.parametrize("leaves", [True, False], ids=["leaves", "falls silent"])
def test_a_reader_of_a_page_in_pieces_who_is_gone_gives_the_only_connection_back(
    app: FastAPI, bearer, monkeypatch: pytest.MonkeyPatch, leaves: bool
) -> None:
    monkeypatch.setattr(features, "ROWS_AT_ONCE", POINTS // 6)
    monkeypatch.setattr(streams, "STALLED_S", SOON_S)
    token = bearer("read")
    scope = {
        **{"type": "http", "method": "GET", "scheme": "http", "path": ITEMS, "root_path": ""},
        "query_string": b"limit=10000",
        "headers": [(b"host", b"localhost"), (b"authorization", token["Authorization"].encode())],
    }

    async def read_on() -> None:
        taken = anyio.Event()

        async def receive() -> dict[str, str]:
            await taken.wait()
            await anyio.sleep(0.0 if leaves else PATIENCE_S)
            return {"type": "http.disconnect"}

        async def send(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.body":
                taken.set()
                await anyio.sleep_forever()

        async with app.router.lifespan_context(app):
            with anyio.fail_after(PATIENCE_S), suppress(ClientDisconnect):
                await app(scope, receive, send)
            assert taken.is_set()
            assert app.state.database.reader.pool.checkedin() == CONNECTIONS
            assert (await client_of(app, token).get(f"{ITEMS}/{FIRST_ID}")).status_code == 200

    anyio.run(read_on)


def test_an_upload_too_many_is_asked_to_retry_and_others_are_not_affected(app: FastAPI, bearer) -> None:
    async def crowded() -> None:
        arrived, go_on = anyio.Event(), anyio.Event()

        async def slowly() -> AsyncIterator[bytes]:
            yield IMAGE
            arrived.set()
            await go_on.wait()

        async with app.router.lifespan_context(app), anyio.create_task_group() as tasks:
            app.state.uploads = Turns("uploads", most=1, most_per_caller=2, patience_s=0.0)
            client = client_of(app, bearer("register"))

            async def send() -> None:
                assert (await client.post(SCENES, content=slowly())).status_code == 201

            tasks.start_soon(send)
            await arrived.wait()
            refused = await client.post(SCENES, content=IMAGE)
            assert refused.status_code == 503
            assert refused.headers["retry-after"]
            assert (await client.get(f"{ITEMS}/{FIRST_ID}")).status_code == 200
            go_on.set()
            while not app.state.uploads.free:
                await anyio.sleep(0.01)
            assert (await client.post(SCENES, content=IMAGE)).status_code == 201

    anyio.run(crowded)


def test_uploads_leave_threads_for_all_connections(app: FastAPI) -> None:
    async def threads() -> float:
        async with app.router.lifespan_context(app):
            return to_thread.current_default_thread_limiter().total_tokens

    assert anyio.run(threads) - deps.UPLOADS_AT_ONCE >= 2 * CONNECTIONS
