"""Connections to the database: engines with their pools.

A request reads on a connection that can only read, each statement a transaction of its own; whatever
writes has one transaction. Role, read-only mode and time limit belong to a connection from its start:
to switch them at each checkout costs more than the whole checkout (decision 13). So there are two
engines, made by one function.

Errors of the database reach callers as the driver raises them, such as `psycopg.OperationalError`.
"""

import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from select import POLLIN, poll
from typing import Any

import psycopg
import sqlalchemy
from sqlalchemy import (
    Engine,
    ExceptionContext,
    NullPool,
    QueuePool,
    create_engine,
    event,
    exc,
    func,
    select,
)
from sqlalchemy.pool import ConnectionPoolEntry, PoolProxiedConnection

from amers.app import request_context
from amers.app.config import Settings
from amers.app.db import session
from amers.app.db.ready import ready_database
from amers.app.db.revisions import driver_connection, reach
from amers.app.db.session import DriverConnection

Connection = sqlalchemy.Connection

READER = "amers_reader"
"""Role of the connections that answer reading requests: it can do nothing but select."""
POOL_TIMEOUT_S = 10.0
"""A caller waits so long for a connection when all are in use."""
POOL_RECYCLE_S = 3600
"""Older connections are replaced: server processes grow with what they have seen."""
WARM_CONNECTIONS = 2
"""Connections of each pool that are opened at the start."""
FIRST_SPATIAL_PLAN = """select st_asgeojson(st_transform(st_setsrid(st_makepoint(n, 0, 0), 4326), 3857))
    from generate_series(0, 0) n where n = 0"""
"""Loads PostGIS and PROJ: up to 60 ms that no caller should wait for."""
SET_ORIGIN = b"""select set_config('amers.actor', %s, true), set_config('amers.actor_name', %s, true),
    set_config('amers.request_id', %s, true), set_config('amers.job_id', %s, true)"""

log = logging.getLogger(__name__)


class PoolTimeout(psycopg.OperationalError):
    """All connections of a pool were in use for longer than a caller waits."""


@dataclass(frozen=True)
class Database:
    """An open database.

    Attributes:
        dsn: its connection string.
        reader, writer: connections of the first can only read, and not for long.
    """

    dsn: str
    reader: Engine
    writer: Engine

    @property
    def writers_are_busy(self) -> bool:
        """Whether all connections that write are in use: one more would have to be waited for."""
        pool = self.writer.pool
        return isinstance(pool, QueuePool) and pool.checkedout() >= pool.size()

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection that can only read; every statement has the time limit of the settings.

        Each statement is a transaction of its own. One transaction around all of them would see the same
        commits of others between statements, and would cost two more round trips.
        """
        with _connection(self.reader) as connection:
            yield connection

    @contextmanager
    def snapshot(self) -> Iterator[Connection]:
        """A read-only transaction whose statements all see one state of the database, for jobs.

        It has no time limit: keep it short, and compute and write files after its end.
        """
        with _connection(self.writer) as connection:
            connection.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
            yield connection

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """One transaction, committed at the end of the context, rolled back by an exception."""
        with _connection(self.writer) as connection:
            set_origin(connection)
            yield connection
            connection.commit()


@contextmanager
def opened(settings: Settings) -> Iterator[Database]:
    """The installation's database, ready for use, its pools warm.

    Raises:
        InputError: the database cannot be used; the message says what to do.
    """
    # Its schema grants what the role of the reading connections needs.
    with ready_database(settings) as dsn, pooled(dsn, settings) as database:
        _warm_pools(database, min(WARM_CONNECTIONS, settings.pool_size))
        yield database


@contextmanager
def pooled(dsn: str, settings: Settings, *, lock_wait_s: float | None = None) -> Iterator[Database]:
    """Engines on a database, whatever its schema; a connection that is cut is noticed within seconds.

    Args:
        lock_wait_s: longest wait of what writes for what others hold; None: that of all sessions.
    """
    reading = {
        "default_transaction_read_only": "on",
        "statement_timeout": f"{round(1000 * settings.read_timeout_seconds)}",
        # A parallel worker is a process that loads PostGIS for one query, longer than most queries take.
        "max_parallel_workers_per_gather": "0",
    }
    if _may_read_as_reader(dsn):
        reading["role"] = READER
    else:
        log.warning("reading as the role of the database's owner: there is no usable %s", READER)
    pool: dict[str, Any] = {
        "poolclass": QueuePool,
        "pool_size": settings.pool_size,
        "max_overflow": 0,
        "pool_timeout": POOL_TIMEOUT_S,
        "pool_recycle": POOL_RECYCLE_S,
        # The connection used last has the plans of its statements at hand.
        "pool_use_lifo": True,
    }
    # A reading connection is never in a transaction: no BEGIN, no ROLLBACK.
    autocommit: dict[str, Any] = {
        "isolation_level": "AUTOCOMMIT",
        "skip_autocommit_rollback": True,
        "pool_reset_on_return": None,
    }
    reader = _engine(dsn, reading, **pool, **autocommit)
    writing = {} if lock_wait_s is None else {"lock_timeout": f"{lock_wait_s:g}s"}
    writer = _engine(dsn, writing, **pool)
    try:
        yield Database(dsn, reader, writer)
    finally:
        reader.dispose()
        writer.dispose()


@contextmanager
def connect(dsn: str) -> Iterator[Connection]:
    """A connection without a pool: one transaction, committed at the end of the context."""
    with _unpooled(dsn).connect() as connection:
        set_origin(connection)
        yield connection
        connection.commit()


def driver(connection: Connection) -> DriverConnection:
    """The driver's own connection, for COPY, streams and hot statements, in the same transaction."""
    if not connection.in_transaction():
        connection.begin()
    own: DriverConnection | None = connection.connection.driver_connection
    assert own is not None
    return own


def set_origin(connection: Connection) -> None:
    """Record in the transaction who is behind it, for the audit."""
    origin = request_context.current()
    driver(connection).execute(
        SET_ORIGIN,
        [
            str(origin.actor or ""),
            origin.actor_name,
            origin.request_id or "",
            str(origin.job_id or ""),
        ],
    )


def export_snapshot(connection: Connection) -> str:
    """A name under which other connections see what this transaction sees, as long as it lasts."""
    return str(connection.scalar(select(func.pg_export_snapshot())))


def limit_lock_wait(connection: Connection, seconds: float) -> None:
    """Let statements fail that wait longer for a lock, until the end of the transaction."""
    connection.execute(select(func.set_config("lock_timeout", f"{seconds:g}s", True)))


def _may_read_as_reader(dsn: str) -> bool:
    with driver_connection(dsn) as connection:
        row = connection.execute(
            """select from pg_roles where rolname = %(role)s
                and pg_has_role(current_user, oid, 'member')
                and has_table_privilege(oid, to_regclass('block'), 'select')
                and not exists (select from pg_extension where extname = 'postgis'
                    and not has_schema_privilege(pg_roles.oid, extnamespace, 'usage'))""",
            {"role": READER},
        ).fetchone()
    return row is not None


def _engine(dsn: str, more: dict[str, str], **options: Any) -> Engine:
    """An engine whose connections are warm, checked before use, and raise the errors of the driver."""
    engine = create_engine(
        "postgresql+psycopg://",
        creator=lambda: session.connect(dsn, more),
        use_native_hstore=False,
        **options,
    )
    event.listen(engine, "connect", _warm)
    event.listen(engine, "checkout", _check)
    event.listen(engine, "handle_error", _raise_as_driver)
    return engine


@lru_cache(maxsize=8)
def _unpooled(dsn: str) -> Engine:
    engine = create_engine(
        "postgresql+psycopg://",
        # What fails once there is a connection is a lost session, not an address that cannot be reached.
        creator=lambda: reach(dsn),
        use_native_hstore=False,
        poolclass=NullPool,
    )
    event.listen(engine, "handle_error", _raise_as_driver)
    return engine


@contextmanager
def _connection(engine: Engine) -> Iterator[Connection]:
    try:
        connection = engine.connect()
    except exc.TimeoutError as error:
        raise PoolTimeout(f"no connection was free within {POOL_TIMEOUT_S:g} s") from error
    with connection:
        yield connection


def _warm_pools(database: Database, count: int) -> None:
    """Open the first connections of both pools, at the same time."""
    engines = [database.reader, database.writer] * count
    with ThreadPoolExecutor(len(engines)) as threads:
        connections = list(threads.map(Engine.connect, engines))
    for connection in connections:
        connection.close()


def _warm(connection: DriverConnection, entry: ConnectionPoolEntry) -> None:
    """Make a new connection ready for its first query; a database without PostGIS has none to get."""
    without_postgis = (psycopg.errors.UndefinedFunction, psycopg.errors.UndefinedObject)
    with suppress(*without_postgis), connection.transaction():
        # However long that takes: the limit is for what callers ask. It goes with the transaction.
        connection.execute("set local statement_timeout = 0")
        connection.execute(FIRST_SPATIAL_PLAN)


def _check(
    connection: DriverConnection, entry: ConnectionPoolEntry, proxy: PoolProxiedConnection
) -> None:
    """Ask the database for a sign of life if there is something to read: it announces its end.

    Raises:
        InvalidatePoolError: there is none; the pool opens new connections in place of all its old ones.
    """
    try:
        line = poll()
        line.register(connection.fileno(), POLLIN)
        if line.poll(0):
            connection.execute("")
            connection.rollback()
    except psycopg.Error as error:
        # Of whatever kind: the driver may take the last words of a session for a second result.
        raise exc.InvalidatePoolError() from error


def _raise_as_driver(context: ExceptionContext) -> None:
    """Let callers see the driver's error: its classes say what happened, and nothing wraps it.

    A session that can write no more is replaced: after a failover another server takes the writes.
    """
    if isinstance(context.original_exception, psycopg.errors.ReadOnlySqlTransaction):
        context.is_disconnect = True
    if isinstance(context.original_exception, psycopg.Error):
        raise context.original_exception
