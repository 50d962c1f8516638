"""`amers block ingest`: a block folder into the store."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.block_listing import block_row
from amers.app.cli.block_quality import quality_row
from amers.app.cli.output import AsJson, print_json, show_one
from amers.app.cli.progress import shown_progress
from amers.app.cli.transaction import transaction
from amers.app.config import read_settings
from amers.app.storage import open_storage
from amers.app.usecases import storage_identity
from amers.app.usecases.blocks import lifecycle
from amers.services.quality.accuracy_statement import accuracy_document
from amers.services.quality.block import quality_document


def ingest(
    path: Annotated[Path, typer.Argument(help="Folder of the block.")],
    *,
    publish: Annotated[bool, typer.Option("--publish", help="Publish the block at once.")] = False,
    priority: Annotated[
        int,
        typer.Option(
            help="Priority of the block: where blocks overlap, points of the block with the "
            "higher priority are served."
        ),
    ] = 0,
    as_json: AsJson = False,
) -> None:
    """Check a block folder completely and load it into the store, staged."""
    settings = read_settings()
    storage = open_storage(settings)
    with transaction(settings) as connection:
        storage_identity.announce(partial(transaction, settings), storage)
        storage.prove()
        with shown_progress() as progress:
            ingested = lifecycle.ingest_block(connection, storage, path, progress, priority)
        block = ingested.block
        if publish:
            block = lifecycle.publish_block(connection, str(block.number)).block
    if as_json:
        record = {**block_row(block), **accuracy_document(ingested.stated)}
        print_json({"block": record, "quality": quality_document(ingested.quality)})
        return
    show_one(
        {**block_row(block), **ingested.stated.words, **quality_row(ingested.quality)}, as_json=False
    )
