"""The session of every connection that an installation makes: its settings are those of Amers.

A server, a database and a role can have settings of their own, such as another time zone, order of dates
or search path. The settings below hold whatever these are. One statement sets them when a connection
begins, and not the connection's start-up packet: poolers refuse or ignore what comes there.

Behind a pooler a session of the server may have been somebody else's: it is cleaned first. A pooler that
gives a session to several connections at a time, transaction by transaction, is refused: settings, roles
and prepared statements would be those of any of them.

Source: PostgreSQL documentation, chapter "Server Configuration"; PgBouncer documentation, "Features".
"""

import time
from collections.abc import Mapping
from select import POLLIN, POLLOUT, poll
from typing import Any

import psycopg
from psycopg import sql
from psycopg.conninfo import conninfo_to_dict, make_conninfo
from psycopg.pq import ExecStatus
from psycopg.pq.abc import PGconn, PGresult

from amers.app.outages import POOLER, outage_of

DriverConnection = psycopg.Connection[tuple[Any, ...]]

CONNECT_SECONDS = 10
"""Longest time until a server lets a connection in, and until it has begun its session."""
SILENT_LINE_S = 15
"""A TCP connection is cut when data that was sent is not confirmed for so long."""
PATIENCE: dict[str, Any] = {
    "connect_timeout": CONNECT_SECONDS,
    "tcp_user_timeout": 1000 * SILENT_LINE_S,
    "keepalives_idle": SILENT_LINE_S,
    "keepalives_interval": SILENT_LINE_S // 3,
    "keepalives_count": 3,
}
"""Parameters of a connection, unless the address has its own: what is cut is noticed within seconds."""
LOCK_WAIT = "60s"
"""Longest wait for a lock: a transaction that was left open would keep it for ever."""
SETTINGS: dict[str, str] = {
    # What values look like, in both directions.
    "client_encoding": "UTF8",
    "DateStyle": "ISO, MDY",
    "IntervalStyle": "postgres",
    "TimeZone": "UTC",
    "timezone_abbreviations": "Default",
    "extra_float_digits": "1",
    "bytea_output": "hex",
    "lc_monetary": "C",
    "lc_numeric": "C",
    "lc_time": "C",
    "xmlbinary": "base64",
    "xmloption": "content",
    # What statements mean.
    "standard_conforming_strings": "on",
    "quote_all_identifiers": "off",
    "array_nulls": "on",
    "transform_null_equals": "off",
    "gin_fuzzy_search_limit": "0",
    "check_function_bodies": "on",
    # Policies make an error, and not a shorter answer.
    "row_security": "off",
    # How transactions begin and when they are cut off.
    "default_transaction_isolation": "read committed",
    "default_transaction_deferrable": "off",
    "statement_timeout": "0",
    "lock_timeout": LOCK_WAIT,
    "idle_in_transaction_session_timeout": "0",
    "idle_session_timeout": "0",
    "transaction_timeout": "0",
    # How statements are planned: what they cost is measured with these.
    "jit": "off",
    "geqo": "on",
    "from_collapse_limit": "8",
    "join_collapse_limit": "8",
    "constraint_exclusion": "partition",
    "plan_cache_mode": "auto",
    "enable_seqscan": "on",
    "enable_indexscan": "on",
    "enable_indexonlyscan": "on",
    "enable_bitmapscan": "on",
    "enable_nestloop": "on",
    "enable_hashjoin": "on",
    "enable_mergejoin": "on",
    "enable_hashagg": "on",
    "enable_sort": "on",
    "enable_material": "on",
    "enable_memoize": "on",
}
"""Settings that every role may change; those that a server does not know are left out.

`default_transaction_read_only` is missing: an operator who sets it wants no writes.
"""
FOUND: dict[str, str] = {
    # The schema of the tables: one in the present path, or else the one there is; then that of PostGIS.
    "search_path": """concat_ws(', ',
        coalesce(
            (select quote_ident(n.nspname) from pg_class c join pg_namespace n on n.oid = c.relnamespace
             where c.relname = 'alembic_version' and c.relkind = 'r' and exists (
                 select from pg_class o where o.relname = 'chip_file' and o.relnamespace = n.oid)
             order by c.oid is distinct from cast(to_regclass('alembic_version') as oid),
                 n.nspname <> 'public', c.oid limit 1),
            quote_ident(current_schema()), 'public'),
        (select quote_ident(n.nspname) from pg_extension e join pg_namespace n on n.oid = e.extnamespace
         where e.extname = 'postgis'),
        'pg_temp')""",
    # What was acknowledged must outlast a crash; stricter settings stay.
    "synchronous_commit": "replace(current_setting('synchronous_commit'), 'off', 'on')",
}
"""Settings whose values are found by expressions."""
CLEAN = b"discard all"
WHICH = b"select pg_backend_pid()"
WITHOUT_TRIGGERS = "replica"
DISARMED = (
    "the settings of the database or its role switch triggers off, and with them the audit "
    f"(session_replication_role is {WITHOUT_TRIGGERS}): reset it with `alter role ... reset "
    "session_replication_role`, or `alter database ... reset session_replication_role`"
)
TOO_FEW = (
    "the pooler in front of the database has no second connection to give: its pool_size has to be "
    "larger than the connections of all processes of Amers, see AMERS_POOL_SIZE"
)


class Unreachable(psycopg.OperationalError):
    """No connection can be made; the message is the driver's, and quotes parts of the address."""


class UnusableSession(psycopg.OperationalError):
    """A session that can never have the settings of Amers; the message says what to change."""


def connect(dsn: str, more: Mapping[str, str] | None = None) -> DriverConnection:
    """A new connection whose session has the settings of Amers; every connection is made like this.

    Args:
        dsn: connection string; it may name several servers.
        more: further settings, in the order in which they are set.

    Raises:
        Unreachable: no connection can be made.
        UnusableSession: the session can never have these settings.
        psycopg.Error: the session is lost before it has begun.
    """
    try:
        connection: DriverConnection = psycopg.connect(patient(dsn))
    except psycopg.OperationalError as error:
        raise Unreachable(str(error)) from error
    try:
        begin(connection.pgconn, dsn, more)
    except BaseException:
        connection.close()
        raise
    return connection


def patient(dsn: str) -> str:
    """A connection string that notices within seconds that a server is silent or has gone."""
    return make_conninfo(**(PATIENCE | conninfo_to_dict(dsn)))


def begin(pgconn: PGconn, dsn: str, more: Mapping[str, str] | None = None) -> None:
    """Give the session of a new connection the settings of Amers.

    Raises:
        UnusableSession: a pooler shares the session, or its settings switch triggers off.
        psycopg.Error: the server does not answer, or refuses a setting.
    """
    statement = _statement(more or {})
    server, replication_role, _ = _ask(pgconn, statement)
    if replication_role == WITHOUT_TRIGGERS:
        raise UnusableSession(DISARMED)
    if int(server) == pgconn.backend_pid:
        return
    # A pooler has made up a number of its own.
    _require_own_session(pgconn, dsn)
    _ask(pgconn, CLEAN)
    _ask(pgconn, statement)


def _require_own_session(pgconn: PGconn, dsn: str) -> None:
    """Check that no other connection gets the server process of this one, as long as this one is open.

    Raises:
        UnusableSession: another one gets it, or gets none.
    """
    mine = _ask(pgconn, WHICH)
    with psycopg.connect(patient(dsn)) as other:
        try:
            _ask(other.pgconn, b"begin")
            theirs = _ask(other.pgconn, WHICH)
        except psycopg.errors.ConnectionTimeout as error:
            raise UnusableSession(TOO_FEW) from error
        except psycopg.OperationalError as error:
            if outage_of(error) is POOLER:
                raise UnusableSession(POOLER.reason) from error
            raise
        if theirs == mine or _ask(pgconn, WHICH) != mine:
            raise UnusableSession(POOLER.reason)
        _ask(other.pgconn, b"rollback")


def _statement(more: Mapping[str, str]) -> bytes:
    """Sets all settings; returns the number of the server process, and a setting that we cannot set."""
    row = sql.SQL("({}, {})")
    rows = [
        *(row.format(name, value) for name, value in SETTINGS.items()),
        *(row.format(name, sql.SQL(expression)) for name, expression in FOUND.items()),
        *(row.format(name, value) for name, value in more.items()),
    ]
    statement = sql.SQL(
        # No time limit of a role cuts off what comes behind.
        "set statement_timeout = 0;"
        " select pg_backend_pid(), current_setting('session_replication_role'),"
        " count(set_config(name, value, false))"
        " from (values {}) wanted (name, value) where current_setting(name, true) is not null"
    )
    return statement.format(sql.SQL(", ").join(rows)).as_bytes()


def _ask(pgconn: PGconn, statement: bytes) -> tuple[str, ...]:
    """The first row of what a server answers, within `CONNECT_SECONDS`.

    Raises:
        psycopg.Error: it refuses the statement, or does not answer in time.
    """
    deadline = time.monotonic() + CONNECT_SECONDS
    line = poll()
    pgconn.send_query(statement)
    result: PGresult | None = None
    while True:
        unsent = pgconn.flush()
        if not unsent and not pgconn.is_busy():
            if (following := pgconn.get_result()) is None:
                break
            result = following
            continue
        line.register(pgconn.socket, POLLIN | (POLLOUT if unsent else 0))
        left_s = deadline - time.monotonic()
        if left_s <= 0.0 or not line.poll(1000.0 * left_s):
            raise psycopg.errors.ConnectionTimeout("the session timed out before it began")
        pgconn.consume_input()
    assert result is not None
    if result.status not in (ExecStatus.TUPLES_OK, ExecStatus.COMMAND_OK):
        raise psycopg.errors.error_from_result(result)
    return tuple((result.get_value(0, n) or b"").decode() for n in range(result.nfields))
