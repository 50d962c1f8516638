"""Access of commands that list to the store: by the driver alone, which takes half of the time."""

from collections.abc import Iterator
from contextlib import contextmanager

from amers.app.config import read_settings
from amers.app.db.ready import ready_database
from amers.app.db.revisions import driver_connection
from amers.app.db.session import DriverConnection


@contextmanager
def reading() -> Iterator[DriverConnection]:
    """A connection of the driver to the installation's database.

    Raises:
        InputError: the database cannot be used; the message says what to do.
    """
    with ready_database(read_settings()) as dsn, driver_connection(dsn) as connection:
        yield connection
