"""Amers behind a pooler: one that gives sessions away as a whole works, any other is refused at start."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psycopg
import pytest

from app.db import engine, session
from app.db.revisions import driver_connection
from app.errors import InputError
from tests.app.conftest import fresh_database, TEMPLATE
from tests.app.poolers import pooler
from tests.app.hostile_installation import Installation
from tests.app.same_requests import all_replies, differences, installation, served_from


@pytest.fixture
def place(open_folder: Path, request: pytest.FixtureRequest) -> Path:
    """A folder that the user of the cluster can enter."""
    return open_folder / f"pooler-{abs(hash(request.node.name)):x}"


@pytest.fixture(scope="module")
def store(cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    with (
        fresh_database(cluster, TEMPLATE) as dsn,
        installation(dsn, tmp_path_factory.mktemp("store") / "own") as store,
    ):
        yield store


FORGETFUL = "server_reset_query = "
"""Sessions are handed on as they are: with the settings and prepared statements of who had them."""


@pytest.mark.parametrize("more", [(), (FORGETFUL,), ("ignore_startup_parameters = options",)])
def test_behind_a_pooler_of_sessions_all_replies_are_the_same(store, place: Path, more):
    expected = all_replies(store, store.client)
    with pooler(store.database.dsn, place, "session", *more) as address:
        for _ in range(2):
            with served_from(store, address) as client:
                assert differences(all_replies(store, client), expected) == {}
                ready = client.get("/readyz").json()["parts"]["database"]
                assert ready == {"status": "ok"}
                with ThreadPoolExecutor(8) as threads:
                    paths = [f"/collections/points/items?limit={n % 50 + 1}" for n in range(200)]
                    headers = store.headers["read"]
                    replies = list(threads.map(lambda path: client.get(path, headers=headers), paths))
                assert {reply.status_code for reply in replies} == {200}


def test_behind_a_pooler_of_sessions_reading_connections_only_read_and_not_for_long(
    store, settings, place: Path
):
    hasty = settings.model_copy(update={"read_timeout_seconds": 0.2})
    with (
        pooler(store.database.dsn, place, "session", "ignore_startup_parameters = options") as address,
        engine.pooled(address, hasty) as database,
    ):
        with database.reading() as connection:
            reader = engine.driver(connection)
            with pytest.raises(psycopg.errors.ReadOnlySqlTransaction):
                reader.execute("create temporary table t (n int)")
            with pytest.raises(psycopg.errors.QueryCanceled):
                reader.execute("select pg_sleep(3)")
            assert reader.execute("select current_user").fetchone() == (engine.READER,)


@pytest.mark.parametrize("more", [(), ("ignore_startup_parameters = options",), ("server_round_robin = 1",)])
@pytest.mark.parametrize("mode", ["transaction", "statement"])
def test_a_pooler_that_shares_sessions_is_refused_with_what_to_set(store, place, mode, more):
    with pooler(store.database.dsn, place, mode, *more) as address:
        with pytest.raises(InputError, match="set pool_mode=session"), driver_connection(address):
            pass
        with pytest.raises(InputError, match="set pool_mode=session"), served_from(store, address):
            pass


def test_a_pooler_without_a_second_connection_is_refused_soon(store, place, monkeypatch):
    monkeypatch.setattr(session, "CONNECT_SECONDS", 1)
    with pooler(store.database.dsn, place, "session", size=1) as address:
        with pytest.raises(InputError, match="pool_size"), driver_connection(address):
            pass
