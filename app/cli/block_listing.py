"""`amers block list`, and what the commands on blocks of the store print alike."""

from typing import Annotated, Any

import typer

from amers.app.cli.output import AsJson, Row, show
from amers.app.cli.reading import reading
from amers.app.db.block_list import BlockSummary
from amers.app.usecases.blocks import listing
from amers.services.quality.accuracy_statement import accuracy_document

Reference = Annotated[str, typer.Argument(help="Number of the block, its ID, or ID@VERSION.")]


def list_blocks(as_json: AsJson = False) -> None:
    """List all blocks, the newest first."""
    with reading() as connection:
        blocks = listing.list_blocks(connection)
    rows: list[Row] = [
        {**block_row(block), **(accuracy_document(stated) if as_json else stated.words)}
        for block, stated in blocks
    ]
    show(rows, as_json=as_json)


def block_row(block: BlockSummary) -> Row:
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


def renewal_row(document: dict[str, Any]) -> Row:
    """What a renewed version of a block has of new and leaves out, by its names."""
    scenes = "; ".join(
        f"{one['image']}: {one['points_with_new_views']} points of {one['points_seen']} seen"
        for one in document["scenes"]
    )
    withdrawals = [
        f"point {one['point']}, missed by {one['scenes_that_missed_it']} scenes, "
        f"last found {one['last_found'] or 'never'}, "
        f"p = {one['probability_if_still_there']:g} if still there"
        for one in document["proposed_withdrawals"]
    ]
    return {
        "renews": document["renews"],
        "scenes": scenes,
        "new views": document["new_views"],
        "new points": f"{document['new_points']}: {document['new_points_note']}",
        "proposed withdrawals": "; ".join([str(len(withdrawals)), *withdrawals]),
    }
