"""`amers block show`: one block of the store."""

from amers.app.cli.block_listing import Reference, block_row
from amers.app.cli.block_renewal import renewal_row
from amers.app.cli.output import AsJson, print_json, show_one
from amers.app.cli.transaction import transaction
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.lookup import block_extent
from amers.app.usecases.blocks.renewal import find_renewal
from amers.services.quality.accuracy_statement import accuracy_document


def show_block(reference: Reference, as_json: AsJson = False) -> None:
    """Show one block."""
    with transaction() as connection:
        block = lifecycle.find_block(connection, reference)
        stated = lifecycle.block_report(connection, block).stated
        renewed = find_renewal(connection, block)
    extent = block_extent(block)
    if as_json:
        print_json(
            {**block_row(block), "extent": extent, **accuracy_document(stated), "renewal": renewed}
        )
        return
    new = {} if renewed is None else renewal_row(renewed)
    # As --bbox takes it.
    box = {"extent": ",".join(f"{value:.6f}" for value in extent)}
    show_one({**block_row(block), **box, **stated.words, **new}, as_json=False)
