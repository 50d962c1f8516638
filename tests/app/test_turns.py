"""Turns: what one caller may do at once, and in which order callers get their turns."""

import json
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any

import anyio
import httpx
import pytest
from anyio import create_task_group, wait_all_tasks_blocked
from starlette.exceptions import HTTPException

from amers.app.api import deps, streams
from amers.app.api.open_connections import network_of
from amers.app.api.turns import Turns
from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.features import pages as features
from amers.app.main import create_app
from amers.app.storage import Storage
from tests.app.served import serve_block
from tests.factories import make_block

PATIENCE_S = 30.0
SOON_S = 0.2
POINTS = 60
ITEMS = "/collections/points/items"
FIRST_ID = 1 << 26


def test_a_caller_with_many_requests_delays_the_first_one_of_another_by_one_turn() -> None:
    order: list[str] = []

    async def crowd() -> None:
        turns = Turns("requests", most=2, most_per_caller=2, patience_s=PATIENCE_S)

        async def ask(caller: str) -> None:
            await turns.take(caller)
            order.append(caller)
            await wait_all_tasks_blocked()
            turns.release(caller)

        await turns.take("many")
        await turns.take("many")
        async with create_task_group() as tasks:
            for _ in range(40):
                tasks.start_soon(ask, "many")
            await wait_all_tasks_blocked()
            tasks.start_soon(ask, "one")
            await wait_all_tasks_blocked()
            turns.release("many")
            turns.release("many")
        assert turns.free == 2

    anyio.run(crowd)
    assert len(order) == 41
    assert order.index("one") == 1


def test_a_caller_never_has_more_than_his_share_and_others_need_not_wait() -> None:
    async def crowd() -> None:
        turns = Turns("requests", most=3, most_per_caller=2, patience_s=SOON_S)
        await turns.take("a")
        await turns.take("a")
        with pytest.raises(HTTPException) as refused:
            await turns.take("a")
        assert refused.value.status_code == 429
        with anyio.fail_after(SOON_S / 2):
            await turns.take("b")
        with pytest.raises(HTTPException) as refused:
            await turns.take("c")
        assert refused.value.status_code == 503
        assert refused.value.headers["Retry-After"]
        for caller in ("a", "a", "b"):
            turns.release(caller)
        assert turns.free == 3

    anyio.run(crowd)


def test_who_leaves_while_waiting_takes_no_turn_along() -> None:
    async def leave() -> None:
        turns = Turns("requests", most=1, most_per_caller=1, patience_s=PATIENCE_S)
        await turns.take("a")
        async with create_task_group() as tasks:
            tasks.start_soon(turns.take, "b")
            await wait_all_tasks_blocked()
            tasks.cancel_scope.cancel()
        turns.release("a")
        assert turns.free == 1
        with anyio.fail_after(SOON_S):
            await turns.take("c")

        async def have_a_turn() -> None:
            await turns.take("d")
            try:
                await anyio.sleep_forever()
            finally:
                turns.release("d")

        async with create_task_group() as tasks:
            tasks.start_soon(have_a_turn)
            await wait_all_tasks_blocked()
            # The turn is granted and its task cancelled before the task runs again.
            turns.release("c")
            tasks.cancel_scope.cancel()
        assert turns.free == 1

    anyio.run(leave)


@pytest.mark.parametrize("pool_size", [1, 2, 8, 100])
def test_one_caller_leaves_connections_to_others(pool_size: int) -> None:
    turns = deps.turns_for(Settings(pool_size=pool_size))
    assert 1 <= turns.most_per_caller <= max(1, pool_size // 2)
    assert turns.most_per_caller <= turns.most <= pool_size


def test_addresses_of_one_network_count_as_one_caller() -> None:
    assert network_of("192.0.2.7") == "192.0.2.7"
    assert network_of("2001:db8:1:2:3::1") == network_of("2001:db8:1:2::ffff") == "2001:db8:1:2::"
    assert network_of("2001:db8:1:3::1") != network_of("2001:db8:1:2::1")
    assert network_of("fe80::1%eth0") == "fe80::"


def test_a_slow_reader_gives_the_only_connection_back_and_still_gets_everything(
    dsn: str, tmp_path: Path, bearer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(features, "ROWS_AT_ONCE", POINTS // 6)
    monkeypatch.setattr(streams, "READER_PATIENCE_S", SOON_S)
    settings = Settings(database_url=dsn, data_folder=tmp_path / "data", pool_size=1)
    with engine.connect(dsn) as connection:
        made = make_block(tmp_path / "block", count=POINTS)
        serve_block(connection, Storage(settings.data_folder / "storage"), made.folder)
    app = create_app(settings)
    headers = bearer("read")
    scope = {
        **{"type": "http", "method": "GET", "scheme": "http", "path": ITEMS, "root_path": ""},
        "query_string": b"limit=10000",
        "headers": [(b"host", b"localhost"), (b"authorization", headers["Authorization"].encode())],
    }
    body = b""

    async def read_slowly() -> None:
        stopped, go_on = anyio.Event(), anyio.Event()

        async def receive() -> dict[str, str]:
            return await anyio.sleep_forever()

        async def send(message: MutableMapping[str, Any]) -> None:
            nonlocal body
            if message["type"] == "http.response.body":
                if not body:
                    stopped.set()
                    await go_on.wait()
                body += message["body"]

        async with app.router.lifespan_context(app), create_task_group() as tasks:
            tasks.start_soon(app, scope, receive, send)
            await stopped.wait()
            client = httpx.AsyncClient(
                transport=httpx.ASGITransport(app), base_url="http://localhost", headers=headers
            )
            with anyio.fail_after(PATIENCE_S):
                assert (await client.get(f"{ITEMS}/{FIRST_ID}")).status_code == 200
            assert body == b"", "the reader has not gone on"
            go_on.set()
        assert app.state.turns.free == app.state.turns.most

    anyio.run(read_slowly)
    assert len(json.loads(body)["features"]) == POINTS
