"""The sessions of the database are ours: whatever is set elsewhere, and whatever lies between."""

import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from uuid import uuid4

import psycopg
import pytest
from psycopg import sql
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from amers.app.config import Settings
from amers.app.db import engine, session
from amers.app.db.cluster.embedded import ROLE, SUPERUSER, Cluster
from amers.app.db.revisions import driver_connection
from amers.app.errors import InputError
from amers.app.usecases import readiness
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.flat_world import SIGMA_M
from tests.app.hostile_installation import Installation
from tests.app.poolers import pooler
from tests.app.same_requests import Reply, all_replies, differences, installation, served_from
from tests.app.standby import Server, standby

FOREIGN: dict[str, dict[str, str]] = {
    "a zone of Europe": {"TimeZone": "Europe/Paris"},
    "a zone of odd minutes": {"TimeZone": "Asia/Kathmandu"},
    "days first": {"DateStyle": "SQL, DMY"},
    "days first, with dots": {"DateStyle": "German"},
    "other intervals": {"IntervalStyle": "sql_standard"},
    "few digits": {"extra_float_digits": "-15"},
    "many digits": {"extra_float_digits": "3"},
    "escaped bytes": {"bytea_output": "escape"},
    "another encoding": {"client_encoding": "LATIN1"},
    "no path": {"search_path": "nowhere"},
    "other plans": {"join_collapse_limit": "1", "enable_indexscan": "off", "jit": "on"},
    "no time": {"statement_timeout": "200", "lock_timeout": "1", "idle_session_timeout": "300"},
    "other transactions": {"default_transaction_isolation": "serializable"},
    "other quotes": {"standard_conforming_strings": "off", "quote_all_identifiers": "on"},
    "nulls that equal": {"transform_null_equals": "on", "array_nulls": "off", "xmlbinary": "hex"},
}
ALL = {name: value for settings in FOREIGN.values() for name, value in settings.items()}
FORGETFUL = "server_reset_query = "
"""A session is handed on as it is: with the settings and prepared statements of who had it."""
IGNORING = "ignore_startup_parameters = options"


@pytest.fixture(scope="module")
def store(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    """An installation, used by all tests of this module."""
    folder = tmp_path_factory.mktemp("store") / "own"
    with fresh_database(cluster, TEMPLATE) as dsn, installation(dsn, folder) as store:
        yield store


@pytest.fixture(scope="module")
def expected(store: Installation) -> dict[str, Reply]:
    """The replies under ordinary settings."""
    replies = all_replies(store, store.client)
    assert {name for name, reply in replies.items() if reply[0] not in (200, 204)} == set()
    return replies


@pytest.fixture
def place(open_folder: Path) -> Path:
    """A folder that the user of the cluster can enter."""
    return open_folder / uuid4().hex[:8]


@pytest.fixture(autouse=True)
def checked_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Readiness repeats no result."""
    monkeypatch.setattr(readiness, "VALID_S", 0.0)


@pytest.mark.parametrize(
    ("whose", "name"),
    [
        ("role", "all of them"),
        *(
            pytest.param(whose, name, marks=pytest.mark.thorough)
            for whose, names in (("role", FOREIGN), ("database", ["all of them"]))
            for name in names
        ),
    ],
)
def test_the_same_requests_get_the_same_replies_whatever_is_set_elsewhere(
    store: Installation, expected: dict[str, Reply], cluster: Cluster, whose: str, name: str
):
    settings, dsn = FOREIGN.get(name, ALL), store.database.dsn
    database = sql.Identifier(str(conninfo_to_dict(dsn)["dbname"]))
    theirs = sql.SQL("database {}").format(database)
    if whose == "role":
        theirs = sql.SQL("role {} in {}").format(sql.Identifier(ROLE), theirs)
    with psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as operator:
        for setting, value in settings.items():
            statement = sql.SQL("alter {} set {} = {}")
            operator.execute(statement.format(theirs, sql.Identifier(setting), value))
        try:
            with psycopg.connect(dsn) as other:
                for setting, value in settings.items():
                    row = other.execute("select current_setting(%s)", [setting]).fetchone()
                    assert row is not None
                    assert row[0].startswith(value), "what is set holds for others"
            with served_from(store, dsn) as client:
                found = all_replies(store, client)
        finally:
            operator.execute(sql.SQL("alter {} reset all").format(theirs))
    assert differences(found, expected) == {}


@pytest.mark.parametrize(
    "more",
    [
        (IGNORING, FORGETFUL),
        pytest.param((), marks=pytest.mark.thorough),
        pytest.param((IGNORING,), marks=pytest.mark.thorough),
    ],
)
def test_behind_a_pooler_of_sessions_all_replies_are_the_same(
    store: Installation, expected: dict[str, Reply], place: Path, more: tuple[str, ...]
):
    headers = store.headers["read"]
    paths = [f"/collections/points/items?limit={n % 50 + 1}" for n in range(100)]
    with pooler(store.database.dsn, place, "session", *more) as address:
        for _ in range(2):
            with served_from(store, address) as client:
                assert differences(all_replies(store, client), expected) == {}
                assert client.get("/readyz").json()["parts"]["database"] == {"status": "ok"}
                with ThreadPoolExecutor(8) as threads:
                    replies = threads.map(lambda path: client.get(path, headers=headers), paths)
                    assert {reply.status_code for reply in replies} == {200}


def test_behind_a_pooler_of_sessions_reading_connections_only_read_and_not_for_long(
    store: Installation, settings: Settings, place: Path
):
    hasty = settings.model_copy(update={"read_timeout_seconds": 0.2})
    with (
        pooler(store.database.dsn, place, "session", IGNORING) as address,
        engine.pooled(address, hasty) as database,
        database.reading() as connection,
    ):
        reader = engine.driver(connection)
        with pytest.raises(psycopg.errors.ReadOnlySqlTransaction):
            reader.execute("create temporary table t (n int)")
        with pytest.raises(psycopg.errors.QueryCanceled):
            reader.execute("select pg_sleep(3)")
        assert reader.execute("select current_user::text").fetchone() == (engine.READER,)


@pytest.mark.parametrize("more", ["", IGNORING, "server_round_robin = 1"])
@pytest.mark.parametrize("mode", ["transaction", "statement"])
def test_a_pooler_that_shares_sessions_is_refused_with_what_to_set(
    store: Installation, place: Path, mode: str, more: str
):
    with (
        pooler(store.database.dsn, place, mode, more) as address,
        pytest.raises(InputError, match="set pool_mode=session for this database"),
        driver_connection(address),
    ):
        pass


def test_a_service_behind_such_a_pooler_does_not_start(store: Installation, place: Path):
    with (
        pooler(store.database.dsn, place, "transaction", IGNORING) as address,
        pytest.raises(InputError, match="set pool_mode=session for this database"),
        served_from(store, address),
    ):
        pass


def test_a_pooler_without_a_second_connection_is_refused_soon(
    store: Installation, place: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(session, "CONNECT_SECONDS", 1)
    with (
        pooler(store.database.dsn, place, "session", size=1) as address,
        pytest.raises(InputError, match="pool_size"),
        driver_connection(address),
    ):
        pass


@pytest.fixture(scope="module")
def copies(store: Installation, cluster: Cluster) -> Iterator[tuple[Server, Server]]:
    """Two standbys of the server with the installation, up to date."""
    primary, place = Server(cluster.data, cluster.sockets), cluster.folder.parent
    with standby(primary, place / "first") as first, standby(primary, place / "second") as second:
        for one in (first, second):
            one.follows(primary)
        yield first, second


def test_on_a_standby_reading_goes_on_and_after_a_failover_writing_too(
    store: Installation, expected: dict[str, Reply], copies: tuple[Server, Server]
):
    me, (first, second) = store.headers["register"], copies
    writes = (
        ("post", f"/scenes?name=c.tif&sigma_m={SIGMA_M}", {"content": b"II*\0"}),
        ("post", "/processes/register-scene/execution", {"json": {"inputs": {"scene": "<own_scene>"}}}),
        ("delete", "/scenes/<own_scene>", {}),
    )
    hosts = f"{first.sockets},{second.sockets}"
    name = str(conninfo_to_dict(store.database.dsn)["dbname"])
    with served_from(store, make_conninfo(first.dsn(name), host=hosts)) as client:
        assert differences(all_replies(store, client), expected) == {}
        for method, path, more in writes:
            more = json.loads(store.filled(json.dumps(more))) if "json" in more else more
            reply = client.request(method, store.filled(path), headers=me, **more)
            assert reply.status_code == 503, reply.text
            assert reply.headers["retry-after"]
            assert "read-only" in reply.json()["detail"]
        ready = client.get("/readyz")
        part = ready.json()["parts"]["database"]
        assert (ready.status_code, part["status"]) == (200, "degraded")
        assert "read-only" in part["reason"]
        ended = threading.Event()

        def ask(path: str) -> set[int]:
            statuses = set()
            while not ended.is_set():
                reply = client.get(path, headers=me)
                statuses.add(reply.status_code)
                assert reply.status_code == 200 or reply.headers["retry-after"], reply.text
            return statuses

        with ThreadPoolExecutor(4) as threads:
            asked = [threads.submit(ask, f"/collections/points/items?limit={n}") for n in range(1, 5)]
            first.control("stop", "--mode", "immediate")
            second.control("promote")
            ended.set()
        assert set().union(*(one.result() for one in asked)) <= {200, 503}
        assert differences(all_replies(store, client), expected) == {}
        assert client.get("/readyz").json()["parts"]["database"] == {"status": "ok"}
        deleted = client.delete(store.filled("/scenes/<own_scene>"), headers=me)
        assert deleted.status_code in (200, 204), deleted.text
