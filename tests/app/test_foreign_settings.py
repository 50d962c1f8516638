"""Settings of servers, databases and roles that are not ours: the replies stay the same, byte for byte."""

from collections.abc import Iterator

import psycopg
import pytest
from psycopg import sql
from psycopg.conninfo import conninfo_to_dict

from app.db import engine, session
from app.db.cluster.embedded import ROLE, SUPERUSER, Cluster
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.hostile_installation import Installation
from tests.app.same_requests import Reply, all_replies, differences, installation, served_from

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
    "no plans": {"join_collapse_limit": "1", "enable_indexscan": "off", "jit_above_cost": "0", "jit": "on"},
    "no time": {"statement_timeout": "200", "lock_timeout": "1", "idle_session_timeout": "300"},
    "other transactions": {"default_transaction_isolation": "serializable"},
    "other quotes": {"standard_conforming_strings": "off", "quote_all_identifiers": "on"},
    "nulls that equal": {"transform_null_equals": "on", "array_nulls": "off", "xmlbinary": "hex"},
}
ALL = {name: value for settings in FOREIGN.values() for name, value in settings.items()}
THOROUGH = {"a zone of odd minutes", "days first, with dots", "other intervals", "no plans"}


@pytest.fixture(scope="module")
def store(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    with (
        fresh_database(cluster, TEMPLATE) as dsn,
        installation(dsn, tmp_path_factory.mktemp("store") / "own") as store,
    ):
        yield store


@pytest.fixture(scope="module")
def expected(store: Installation) -> dict[str, Reply]:
    """The replies under ordinary settings."""
    replies = all_replies(store, store.client)
    assert {name for name, reply in replies.items() if reply[0] not in (200, 204)} == set()
    return replies


@pytest.mark.parametrize("name", [*FOREIGN, "all of them"])
@pytest.mark.parametrize("whose", ["role", "database"])
def test_the_same_requests_get_the_same_replies_whatever_is_set_elsewhere(
    store: Installation, expected: dict[str, Reply], cluster: Cluster, name: str, whose: str
):
    settings = FOREIGN.get(name, ALL)
    dsn = store.database.dsn
    database = sql.Identifier(str(conninfo_to_dict(dsn)["dbname"]))
    theirs = sql.SQL("database {}").format(database)
    if whose == "role":
        theirs = sql.SQL("role {} in database {}").format(sql.Identifier(ROLE), database)
    with psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as operator:
        for setting, value in settings.items():
            statement = sql.SQL("alter {} set {} = {}")
            operator.execute(statement.format(theirs, sql.Identifier(setting), value))
        try:
            with psycopg.connect(dsn) as other:
                for setting, value in settings.items():
                    (held,) = other.execute("select current_setting(%s)", [setting]).fetchone()
                    assert held.startswith(value), "what is set would hold without us"
            with served_from(store, dsn) as client:
                found = all_replies(store, client)
        finally:
            operator.execute(sql.SQL("alter {} reset all").format(theirs))
    assert differences(found, expected) == {}
