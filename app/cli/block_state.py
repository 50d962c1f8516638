"""`amers block publish`, `withdraw`, `restore` and `prioritise`: which blocks are served."""

from typing import Annotated

import typer

from amers.app.cli.block_listing import Reference, block_row
from amers.app.cli.output import AsJson, Row, show_one
from amers.app.cli.transaction import transaction
from amers.app.usecases.blocks import publication
from amers.app.usecases.blocks.publication import Published


def publish(reference: Reference, as_json: AsJson = False) -> None:
    """Publish a block, and withdraw the version of it that was published before."""
    with transaction() as connection:
        published = publication.publish_block(connection, reference)
    show_one(_published(published), as_json=as_json)


def restore(reference: Reference, as_json: AsJson = False) -> None:
    """Publish a withdrawn or superseded block again, in place of its published version."""
    with transaction() as connection:
        published = publication.restore_block(connection, reference)
    show_one(_published(published), as_json=as_json)


def prioritise(
    reference: Reference,
    priority: Annotated[
        int, typer.Argument(help="Priority from -1000 to 1000; new blocks have priority 0.")
    ],
    as_json: AsJson = False,
) -> None:
    """Set the priority of a block: where blocks overlap, the block with the higher one is served."""
    with transaction() as connection:
        block = publication.prioritise_block(connection, reference, priority)
    show_one(block_row(block), as_json=as_json)


def withdraw(reference: Reference, as_json: AsJson = False) -> None:
    """Withdraw a published block; it can be restored."""
    with transaction() as connection:
        block = publication.withdraw_block(connection, reference)
    show_one(block_row(block), as_json=as_json)


def _published(published: Published) -> Row:
    superseded = published.superseded
    return {
        **block_row(published.block),
        "superseded": None if superseded is None else f"{superseded.id}@{superseded.version}",
    }
