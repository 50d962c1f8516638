"""The installation's database, ready for use by this Amers."""

from collections.abc import Iterator
from contextlib import contextmanager

from amers.app.config import Settings
from amers.app.db.cluster import embedded
from amers.app.db.revisions import ensure_schema


@contextmanager
def ready_database(settings: Settings) -> Iterator[str]:
    """The connection string of the database, which runs and has the schema of this Amers.

    The schema of the private cluster is upgraded on the way; that of a database of your own is not.

    Raises:
        InputError: the database cannot be used; the message says what to do.
    """
    with embedded.database(settings) as dsn:
        ensure_schema(dsn, upgradable=settings.database_url is None)
        yield dsn
