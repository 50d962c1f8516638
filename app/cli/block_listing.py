"""`amers block list`, and what the commands on blocks of the store print alike."""

from typing import Annotated

import typer

from app.cli.output import AsJson, Row, show
from app.cli.transaction import transaction
from app.db.blocks import Block
from app.usecases.blocks import listing
from services.quality.accuracy_statement import accuracy_document

Reference = Annotated[str, typer.Argument(help="Number of the block, its ID, or ID@VERSION.")]


def list_blocks(as_json: AsJson = False) -> None:
    """List all blocks, the newest first."""
    with transaction() as connection:
        blocks = listing.list_blocks(connection)
        stated = listing.stated_accuracies(connection, [block.number for block in blocks])
    shown = {number: accuracy_document(one) if as_json else one.words for number, one in stated.items()}
    show([{**block_row(block), **shown[block.number]} for block in blocks], as_json=as_json)


def block_row(block: Block) -> Row:
    """The properties of a block, by their names."""
    return {
        "number": block.number,
        "id": block.id,
        "version": block.version,
        "state": block.state,
        "priority": block.priority,
        "points": block.n_points,
        "points_superseded": block.n_unserved,
        "views": block.n_views,
        "title": block.title,
        "created_at": block.created_at,
        "state_changed_at": block.state_changed_at,
    }
