"""Access of commands to the store: one command is one transaction, committed at its end."""

from collections.abc import Iterator
from contextlib import contextmanager

from amers.app.config import Settings, read_settings
from amers.app.db import engine
from amers.app.db.engine import Connection
from amers.app.db.ready import ready_database


@contextmanager
def transaction(settings: Settings | None = None) -> Iterator[Connection]:
    """A transaction on the installation's database; the private one is started and upgraded first.

    Raises:
        InputError: the database cannot be used; the message says what to do.
    """
    chosen = settings or read_settings()
    with ready_database(chosen) as dsn, engine.connect(dsn) as connection:
        yield connection
