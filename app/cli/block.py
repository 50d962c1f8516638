"""`amers block`: blocks of points, from a folder to the publication."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from app.cli.block_frame import frame
from app.cli.block_quality import quality, quality_row
from app.cli.block_renewal import renew, renewal_row
from app.cli.output import AsJson, Row, print_json, show, show_one
from app.cli.progress import shown_progress
from app.cli.transaction import transaction
from app.config import read_settings
from app.db.blocks import Block
from app.db.engine import opened
from app.errors import InputError
from app.storage import open_storage
from app.usecases import storage_identity
from app.usecases.blocks import lifecycle
from app.usecases.blocks.export import ExportBlock, select_points, write_selected
from app.usecases.blocks.lifecycle import Published
from app.usecases.blocks.renewal import find_renewal
from app.usecases.damage import open_chips
from services.quality.accuracy_statement import accuracy_document
from services.quality.block import quality_document

app = typer.Typer(no_args_is_help=True)
app.command()(quality)
app.command()(renew)
app.command()(frame)

Reference = Annotated[str, typer.Argument(help="Number of the block, its ID, or ID@VERSION.")]


@app.command()
def ingest(
    path: Annotated[Path, typer.Argument(help="Folder of the block.")],
    *,
    publish: Annotated[bool, typer.Option("--publish", help="Publish the block at once.")] = False,
    priority: Annotated[
        int, typer.Option(help="Where blocks overlap, points of the greater priority are served.")
    ] = 0,
    as_json: AsJson = False,
) -> None:
    """Check a block folder completely and load it into the store, staged."""
    settings = read_settings()
    storage = open_storage(settings)
    with transaction(settings) as connection:
        storage_identity.announce(partial(transaction, settings), storage)
        with shown_progress() as progress:
            ingested = lifecycle.ingest_block(connection, storage, path, progress, priority)
        block = ingested.block
        if publish:
            block = lifecycle.publish_block(connection, str(block.number)).block
    if as_json:
        record = {**_record(block), **accuracy_document(ingested.stated)}
        print_json({"block": record, "quality": quality_document(ingested.quality)})
        return
    show_one({**_record(block), **ingested.stated.words, **quality_row(ingested.quality)}, as_json=False)


@app.command("list")
def list_blocks(as_json: AsJson = False) -> None:
    """List all blocks, the newest first."""
    with transaction() as connection:
        blocks = lifecycle.list_blocks(connection)
        stated = lifecycle.stated_accuracies(connection, [block.number for block in blocks])
    shown = {number: accuracy_document(one) if as_json else one.words for number, one in stated.items()}
    show([{**_record(block), **shown[block.number]} for block in blocks], as_json=as_json)


@app.command("show")
def show_block(reference: Reference, as_json: AsJson = False) -> None:
    """Show one block."""
    with transaction() as connection:
        block = lifecycle.find_block(connection, reference)
        stated = lifecycle.block_report(connection, block).stated
        renewed = find_renewal(connection, block)
    if as_json:
        print_json({**_record(block), **accuracy_document(stated), "renewal": renewed})
        return
    new = {} if renewed is None else renewal_row(renewed)
    show_one({**_record(block), **stated.words, **new}, as_json=False)


@app.command()
def publish(reference: Reference, as_json: AsJson = False) -> None:
    """Publish a block, and withdraw the version of it that was published before."""
    with transaction() as connection:
        published = lifecycle.publish_block(connection, reference)
    show_one(_published(published), as_json=as_json)


@app.command()
def restore(reference: Reference, as_json: AsJson = False) -> None:
    """Publish a withdrawn or superseded block again, in place of its published version."""
    with transaction() as connection:
        published = lifecycle.restore_block(connection, reference)
    show_one(_published(published), as_json=as_json)


@app.command()
def prioritise(
    reference: Reference,
    priority: Annotated[int, typer.Argument(help="-1000 to 1000; new blocks have 0.")],
    as_json: AsJson = False,
) -> None:
    """Set which of overlapping blocks is served: points of the block with the greater priority."""
    with transaction() as connection:
        block = lifecycle.prioritise_block(connection, reference, priority)
    show_one(_record(block), as_json=as_json)


@app.command()
def export(
    *,
    bbox: Annotated[
        str, typer.Option(help="W,S,E,N in degrees; W greater than E crosses the antimeridian.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder of the block.")],
    name: Annotated[str, typer.Option("--id", help="Id of the new block.")] = "extract",
    version: Annotated[str, typer.Option(help="Version of the new block.")] = "1",
    title: Annotated[str, typer.Option(help="Title of the new block.")] = "",
    as_json: AsJson = False,
) -> None:
    """Write the served points of a box, with their chips, into a new block folder."""
    try:
        west, south, east, north = (float(part) for part in bbox.split(","))
    except ValueError:
        raise InputError(f"--bbox: {bbox!r:.100} found, four numbers W,S,E,N expected") from None
    settings = read_settings()
    inputs = ExportBlock((west, south, east, north), name, version, title)
    with opened(settings) as database:
        with database.snapshot() as connection:
            selected = select_points(connection, inputs)
        chips = open_chips(database, open_storage(settings))
        try:
            with shown_progress() as progress:
                n_points = write_selected(selected, chips, output, progress)
        finally:
            chips.close()
    show_one({"block": output, "points": n_points}, as_json=as_json)


@app.command()
def withdraw(reference: Reference, as_json: AsJson = False) -> None:
    """Withdraw a published block; it can be restored."""
    with transaction() as connection:
        block = lifecycle.withdraw_block(connection, reference)
    show_one(_record(block), as_json=as_json)


def _published(published: Published) -> Row:
    superseded = published.superseded
    return {
        **_record(published.block),
        "superseded": None if superseded is None else f"{superseded.id}@{superseded.version}",
    }


def _record(block: Block) -> Row:
    return {
        "number": block.number,
        "id": block.id,
        "version": block.version,
        "state": block.state,
        "priority": block.priority,
        "points": block.n_points,
        "points superseded": block.n_unserved,
        "views": block.n_views,
        "title": block.title,
        "created_at": block.created_at,
        "state_changed_at": block.state_changed_at,
    }
