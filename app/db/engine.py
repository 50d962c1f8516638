"""Connections, pools and the version of the schema."""

import logging
import select
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import psycopg
from psycopg.conninfo import conninfo_to_dict, make_conninfo
from psycopg.rows import DictRow, dict_row
from psycopg_pool import ConnectionPool

from app import request_context
from app.config import Settings
from app.db.cluster import embedded
from app.errors import InputError

Connection = psycopg.Connection[DictRow]
Pool = ConnectionPool[Connection]

READER = "amers_reader"
"""Role of the connections that answer reading requests: it can do nothing but select."""
SILENT_LINE_S = 15
"""What was sent over a line and not confirmed for so long shows that the line is cut."""
NOTICING_CUTS: dict[str, Any] = {
    "tcp_user_timeout": 1000 * SILENT_LINE_S,
    "keepalives_idle": SILENT_LINE_S,
    "keepalives_interval": SILENT_LINE_S // 3,
    "keepalives_count": 3,
}
FIRST_SPATIAL_PLAN = """select st_asgeojson(st_transform(st_setsrid(st_makepoint(n, 0, 0), 4326), 3857))
    from generate_series(0, 0) n where n = 0"""
"""Loads PostGIS and PROJ: up to 60 ms that no caller should wait for."""


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Database:
    """An open database.

    Attributes:
        dsn: its connection string.
        reader, writer: pools; connections of the first can only read, and not for long.
    """

    dsn: str
    reader: Pool
    writer: Pool

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection that can only read; every statement has the time limit of the settings.

        Each statement is a transaction: several in one would see what others commit between them all the
        same, for two exchanges with the database more.
        """
        with self.reader.connection() as connection:
            yield connection

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """One transaction, committed at the end of the context, rolled back by an exception."""
        with self.writer.connection() as connection:
            say_origin(connection)
            yield connection


@dataclass(frozen=True)
class SchemaStatus:
    """The version of the schema: as found in a database (None: empty) and as this Amers needs it."""

    found: str | None
    needed: str

    @property
    def current(self) -> bool:
        """Whether the database can be used as it is."""
        return self.found == self.needed


@contextmanager
def opened(settings: Settings) -> Iterator[Database]:
    """The installation's database, ready for use: running, with the schema of this Amers, pools warm.

    The schema of the private cluster is upgraded on the way; that of a database of your own is not.

    Raises:
        InputError: the database cannot be used; the message says what to do.
    """
    with embedded.database(settings) as dsn:
        # First: the schema grants what the role of the reading connections needs.
        ensure_schema(dsn, upgradable=settings.database_url is None)
        with pooled(dsn, settings) as database:
            for pool in (database.reader, database.writer):
                pool.wait()
            yield database


@contextmanager
def pooled(dsn: str, settings: Settings) -> Iterator[Database]:
    """Pools on a database, whatever its schema; a line that is cut is noticed within seconds."""
    dsn = make_conninfo(**(NOTICING_CUTS | conninfo_to_dict(dsn)))
    limit_ms = round(1000 * settings.read_timeout_seconds)
    # A parallel worker is a process that loads PostGIS for one query, longer than most queries take.
    reading = (
        f"-c default_transaction_read_only=on -c statement_timeout={limit_ms}"
        " -c max_parallel_workers_per_gather=0"
    )
    if _may_read_as_reader(dsn):
        reading += f" -c role={READER}"
    else:
        log.warning("reading as the role of the database's owner: there is no usable %s", READER)
    with (
        _pool(dsn, settings.pool_size, {"options": reading, "autocommit": True}) as reader,
        _pool(dsn, settings.pool_size, {}) as writer,
    ):
        yield Database(dsn, reader, writer)


@contextmanager
def connect(dsn: str) -> Iterator[Connection]:
    """A connection without a pool: one transaction, committed at the end of the context."""
    with _reachable(dsn) as connection:
        say_origin(connection)
        yield connection


def say_origin(connection: Connection) -> None:
    """Tell the transaction who is behind it, for the record of changes."""
    where = request_context.current()
    connection.execute(
        """select set_config('amers.actor', %s, true), set_config('amers.actor_name', %s, true),
                  set_config('amers.request_id', %s, true), set_config('amers.job_id', %s, true)""",
        [
            str(where.actor or ""),
            where.actor_name,
            where.request_id or "",
            str(where.job_id or ""),
        ],
    )


def status(dsn: str) -> SchemaStatus:
    """The version of a database's schema beside the one this Amers needs."""
    with _reachable(dsn) as connection:
        known = connection.execute(
            "select to_regclass('alembic_version') is not null as known"
        ).fetchone()
        row = (
            connection.execute("select version_num from alembic_version").fetchone()
            if known and known["known"]
            else None
        )
    return SchemaStatus(found=row["version_num"] if row else None, needed=newest_revision())


def ensure_schema(dsn: str, *, upgradable: bool) -> None:
    """Bring the schema up to date, or say that it is not.

    Raises:
        InputError: the schema is another one and may not be upgraded here.
    """
    state = status(dsn)
    if state.current:
        return
    if not upgradable:
        raise InputError(
            f"the schema of the database is at revision {state.found or 'none'}, "
            f"this Amers needs {state.needed}: run `amers db upgrade`"
        )
    upgrade(dsn)


def upgrade(dsn: str) -> None:
    """Apply the migrations that the database lacks; safe when several commands do it at once.

    Raises:
        InputError: the database was upgraded by a newer Amers.
    """
    from alembic import command
    from alembic.config import Config

    state = status(dsn)
    if state.found is not None and state.found > state.needed:
        raise InputError(
            f"the database is at revision {state.found}, newer than this Amers knows ({state.needed})"
        )
    config = Config()
    config.set_main_option("script_location", str(migrations_folder()).replace("%", "%%"))
    config.attributes["dsn"] = dsn
    command.upgrade(config, "head")
    _grant_reading(dsn)


def migrations_folder() -> Path:
    """Where the migrations are installed."""
    return Path(str(resources.files("migrations")))


def newest_revision() -> str:
    """The revision this Amers needs; migrations are named `REVISION_what_it_does.py`, in order."""
    return max(path.name.split("_")[0] for path in (migrations_folder() / "versions").glob("[0-9]*.py"))


def _grant_reading(dsn: str) -> None:
    """Let the reading role read all tables, those of later migrations too."""
    from app.db.statements import sql_file

    with _reachable(dsn) as connection:
        connection.execute(sql_file("grants.sql").encode())


def _may_read_as_reader(dsn: str) -> bool:
    with _reachable(dsn) as connection:
        row = connection.execute(
            """select from pg_roles where rolname = %(role)s
                and pg_has_role(current_user, oid, 'member')
                and has_table_privilege(oid, to_regclass('block'), 'select')""",
            {"role": READER},
        ).fetchone()
    return row is not None


def _pool(dsn: str, size: int, options: dict[str, Any]) -> Pool:
    return ConnectionPool(
        dsn,
        min_size=min(2, size),
        max_size=size,
        open=False,
        timeout=10.0,
        connection_class=psycopg.Connection[DictRow],
        kwargs={"row_factory": dict_row, **options},
        check=_ask_if_suspect,
        configure=_warm,
    )


def _ask_if_suspect(connection: Connection) -> None:
    """Ask the database for a sign of life where the line is not silent: it tells of its end unasked.

    Raises:
        OperationalError: there is none; the pool takes another connection.
    """
    line = select.poll()
    line.register(connection.fileno(), select.POLLIN)
    if line.poll(0):
        ConnectionPool.check_connection(connection)


def _warm(connection: Connection) -> None:
    """Make a new connection ready for its first query; a database without PostGIS has none to get."""
    without_postgis = (psycopg.errors.UndefinedFunction, psycopg.errors.UndefinedObject)
    with suppress(*without_postgis), connection.transaction():
        # However long that takes: the limit is for what callers ask. It goes with the transaction.
        connection.execute("set local statement_timeout = 0")
        connection.execute(FIRST_SPATIAL_PLAN)


@contextmanager
def _reachable(dsn: str) -> Iterator[Connection]:
    try:
        connection = psycopg.connect(dsn, row_factory=dict_row, connect_timeout=10)
    except psycopg.OperationalError as error:
        raise InputError(f"the database cannot be reached: {str(error).strip()}") from error
    with connection:
        yield connection
