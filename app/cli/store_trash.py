"""`amers store trash`: files that the sweep removed."""

from typing import Annotated

import typer

from amers.app.cli.deletion import giving_up_reserve
from amers.app.cli.output import AsJson, show, show_one
from amers.app.config import read_settings
from amers.app.db import engine
from amers.app.errors import InputError
from amers.app.storage import open_storage, trash
from amers.app.usecases import storage_identity


def list_trash(as_json: AsJson = False) -> None:
    """List the files in the trash, oldest first."""
    files = trash.batches(open_storage(read_settings()))
    rows = [{"batch": batch, "key": key} for batch, keys in files.items() for key in keys]
    show(rows, as_json=as_json)


def restore(
    batch: Annotated[
        str, typer.Argument(help="Name of the batch, as `amers store trash list` prints it.")
    ],
    as_json: AsJson = False,
) -> None:
    """Move the files of a batch back, except files whose place is occupied."""
    settings = read_settings()
    storage = open_storage(settings)
    with engine.opened(settings) as database, database.reading() as connection:
        storage_identity.expect(connection, storage)
    storage.prove()
    keys = trash.batches(storage).get(batch)
    if keys is None:
        raise InputError(f"no batch {batch} in the trash: `amers store trash list` lists them")
    show([{"key": key} for key in trash.put_back(storage, batch, keys)], as_json=as_json)


@giving_up_reserve
def empty(as_json: AsJson = False) -> None:
    """Delete all files in the trash."""
    settings = read_settings()
    storage = open_storage(settings)
    with engine.opened(settings) as database:
        storage_identity.require_match(database, storage)
        n_deleted = trash.empty(storage)
    show_one({"deleted": n_deleted}, as_json=as_json)
