"""`amers db upgrade` and `status`: the schema of the database."""

from amers.app.cli.output import AsJson, show_one
from amers.app.config import read_settings
from amers.app.db import revisions
from amers.app.db.cluster import embedded


def upgrade(as_json: AsJson = False) -> None:
    """Upgrade the schema of the database to the version that this Amers needs."""
    with embedded.database(read_settings()) as dsn:
        before = revisions.status(dsn)
        revisions.upgrade(dsn)
        after = revisions.status(dsn)
    show_one({"from": before.found, "to": after.found}, as_json=as_json)


def status(as_json: AsJson = False) -> None:
    """Show the schema version of the database and the one that this Amers needs."""
    settings = read_settings()
    with embedded.database(settings) as dsn:
        schema = revisions.status(dsn)
    record = {
        "database": "private cluster" if settings.database_url is None else "AMERS_DATABASE_URL",
        "data_folder": settings.data_folder,
        "revision": schema.found,
        "needed": schema.needed,
        "current": schema.current,
    }
    show_one(record, as_json=as_json)
