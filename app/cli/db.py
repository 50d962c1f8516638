"""`amers db`: the database and its schema."""

import os
from pathlib import Path
from typing import Annotated

import typer

from app.cli.output import AsJson, show_one
from app.config import read_settings
from app.db import engine
from app.db.cluster import backup as archive
from app.db.cluster import embedded

app = typer.Typer(help="The database and its schema.", no_args_is_help=True)


@app.command()
def upgrade(as_json: AsJson = False) -> None:
    """Bring the schema up to date."""
    with embedded.database(read_settings()) as dsn:
        before = engine.status(dsn)
        engine.upgrade(dsn)
        after = engine.status(dsn)
    show_one({"from": before.found, "to": after.found}, as_json=as_json)


@app.command()
def status(as_json: AsJson = False) -> None:
    """Say which schema the database has and which one this Amers needs."""
    settings = read_settings()
    with embedded.database(settings) as dsn:
        found = engine.status(dsn)
    record = {
        "database": "private cluster" if settings.database_url is None else "AMERS_DATABASE_URL",
        "data_folder": settings.data_folder,
        "revision": found.found,
        "needed": found.needed,
        "current": found.current,
    }
    show_one(record, as_json=as_json)


@app.command()
def backup(
    file: Annotated[Path, typer.Argument(help="The archive to write; it must not exist.")],
    as_json: AsJson = False,
) -> None:
    """Write the database into an archive; copy the storage folder after it."""
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
    file: Annotated[Path, typer.Argument(help="An archive that `amers db backup` wrote.")],
    as_json: AsJson = False,
) -> None:
    """Read an archive into an empty database, and bring its schema up to date."""
    with embedded.database(read_settings()) as dsn:
        archive.restore(dsn, file)
        engine.upgrade(dsn)
        found = engine.status(dsn)
    show_one({"archive": file, "revision": found.found}, as_json=as_json)
