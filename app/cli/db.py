"""`amers db`: the database and its schema."""

import os
from pathlib import Path
from typing import Annotated

import typer

from app.cli.output import AsJson, show_one
from app.config import read_settings
from app.db import revisions
from app.db.cluster import backup as archive
from app.db.cluster import embedded

app = typer.Typer(no_args_is_help=True)


@app.command()
def upgrade(as_json: AsJson = False) -> None:
    """Upgrade the schema of the database to the version that this Amers needs."""
    with embedded.database(read_settings()) as dsn:
        before = revisions.status(dsn)
        revisions.upgrade(dsn)
        after = revisions.status(dsn)
    show_one({"from": before.found, "to": after.found}, as_json=as_json)


@app.command()
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


@app.command()
def backup(
    file: Annotated[Path, typer.Argument(help="Archive to write; it must not exist.")],
    as_json: AsJson = False,
) -> None:
    """Write the database into an archive; copy the storage folder afterwards."""
    settings = read_settings()
    with embedded.database(settings) as dsn:
        archive.dump(dsn, file)
    record = {
        "archive": file,
        "size_bytes": os.stat(file).st_size,
        "copy too": settings.data_folder / "storage",
    }
    show_one(record, as_json=as_json)


@app.command()
def restore(
    file: Annotated[Path, typer.Argument(help="An archive written by `amers db backup`.")],
    as_json: AsJson = False,
) -> None:
    """Restore an archive into an empty database, and upgrade its schema."""
    with embedded.database(read_settings()) as dsn:
        archive.restore(dsn, file)
        revisions.upgrade(dsn)
        schema = revisions.status(dsn)
    show_one({"archive": file, "revision": schema.found}, as_json=as_json)
