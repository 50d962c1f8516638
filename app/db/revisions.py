"""Revisions of the schema: the one of a database, the one this Amers needs, and the upgrade."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

import psycopg

from amers.app.db import session
from amers.app.db.address import unreachable
from amers.app.db.preparation import prepare
from amers.app.db.session import DriverConnection
from amers.app.db.sql_files import sql_file
from amers.app.errors import InputError

OWN_WARNING = "01000"
"""SQLSTATE of a warning that a statement raises."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SchemaStatus:
    """The version of the schema: as found in a database (None: empty) and as this Amers needs it."""

    found: str | None
    needed: str

    @property
    def current(self) -> bool:
        """Whether the database can be used as it is."""
        return self.found == self.needed


def status(dsn: str) -> SchemaStatus:
    """The version of a database's schema beside the one this Amers needs."""
    with driver_connection(dsn) as connection:
        found = None
        if connection.execute("select to_regclass('alembic_version')").fetchone() != (None,):
            found = current(connection)
    return SchemaStatus(found=found, needed=newest_revision())


def current(connection: DriverConnection) -> str | None:
    """The version of the schema of a database that has tables of Amers."""
    found = connection.execute("select version_num from alembic_version").fetchone()
    return None if found is None else str(found[0])


def ensure_schema(dsn: str, *, upgradable: bool) -> None:
    """Bring the schema up to date, or say that it is not.

    Raises:
        InputError: the schema is of another Amers, or is an older one and may not be upgraded here.
    """
    state = status(dsn)
    if state.current:
        return
    _refuse_foreign(state)
    if not upgradable:
        raise InputError(
            f"the schema of the database is at revision {state.found or 'none'}, "
            f"this Amers needs {state.needed}: run `amers db upgrade`"
        )
    upgrade(dsn)


def upgrade(dsn: str) -> None:
    """Apply the migrations that the database lacks; safe when several commands do it at once.

    Raises:
        InputError: the database was upgraded by a newer Amers, or by another program; or a superuser has
            to prepare it.
    """
    from alembic import command
    from alembic.config import Config

    _refuse_foreign(status(dsn))
    with driver_connection(dsn) as connection:
        prepare(connection)
    config = Config()
    config.set_main_option("script_location", str(migrations_folder()).replace("%", "%%"))
    config.attributes["dsn"] = dsn
    command.upgrade(config, "head")
    _grant_reading(dsn)


def migrations_folder() -> Path:
    """Where the migrations are installed."""
    return Path(str(resources.files("amers.migrations")))


def newest_revision() -> str:
    """The revision this Amers needs."""
    return max(_revisions())


def require_current(connection: DriverConnection) -> None:
    """Refuse to work on a database that was upgraded while this process ran.

    Raises:
        InputError: the schema is not the one that this Amers needs.
    """
    found, needed = current(connection), newest_revision()
    if found != needed:
        raise InputError(
            f"the schema of the database is at revision {found} by now, this process needs {needed}: "
            "restart it with the Amers that has upgraded the database"
        )


@cache
def _revisions() -> frozenset[str]:
    """All revisions of this Amers; migrations are named `REVISION_what_it_does.py`, in order."""
    scripts = (migrations_folder() / "versions").glob("[0-9]*.py")
    return frozenset(path.name.split("_")[0] for path in scripts)


def _refuse_foreign(state: SchemaStatus) -> None:
    if state.found is not None and state.found not in _revisions():
        raise InputError(
            f"the schema of the database is at revision {state.found}, which this Amers does not know "
            f"(it needs {state.needed}): a newer Amers, or another program, has made it. Install the "
            "Amers that upgraded the database, or name another database in AMERS_DATABASE_URL"
        )


def _grant_reading(dsn: str) -> None:
    """Let the reading role read all tables, those of later migrations too."""
    with driver_connection(dsn) as connection:
        connection.add_notice_handler(_log_warning)
        connection.execute(sql_file("grants.sql").encode())


def _log_warning(notice: psycopg.errors.Diagnostic) -> None:
    """Log the warnings of the statement itself: those of PostgreSQL name the tables of PostGIS."""
    if notice.severity_nonlocalized == "WARNING" and notice.sqlstate == OWN_WARNING:
        log.warning("%s", notice.message_primary)


@contextmanager
def driver_connection(dsn: str) -> Iterator[DriverConnection]:
    """A connection of the driver without an engine: one transaction, committed at the end.

    Raises:
        InputError: the database cannot be reached.
    """
    with reach(dsn) as connection:
        yield connection


def reach(dsn: str) -> DriverConnection:
    """A new connection of the driver.

    Raises:
        InputError: the database cannot be reached, or not used in this way.
    """
    try:
        return session.connect(dsn)
    except (session.Unreachable, session.UnusableSession) as error:
        raise unreachable(error, dsn) from error
