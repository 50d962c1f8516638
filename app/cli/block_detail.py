"""`amers block show`: one block of the store."""

from amers.app.cli.block_listing import Reference, block_row, renewal_row
from amers.app.cli.output import AsJson, print_json, show_one
from amers.app.cli.reading import reading
from amers.app.usecases.blocks.listing import extent_of, listed_block, stated_accuracy
from amers.services.quality.accuracy_statement import accuracy_document


def show_block(reference: Reference, as_json: AsJson = False) -> None:
    """Show one block."""
    with reading() as connection:
        entry = listed_block(connection, reference)
    block, renewed = entry.block, entry.renewal
    extent, stated = extent_of(*entry.box), stated_accuracy(entry)
    if as_json:
        print_json(
            {**block_row(block), "extent": extent, **accuracy_document(stated), "renewal": renewed}
        )
        return
    new = {} if renewed is None else renewal_row(renewed)
    # As --bbox takes it.
    box = {"extent": ",".join(f"{value:.6f}" for value in extent)}
    show_one({**block_row(block), **box, **stated.words, **new}, as_json=False)
