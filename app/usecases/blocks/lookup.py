"""Find a block of the store, and its extent."""

from amers.app.db import blocks
from amers.app.db.blocks import Block
from amers.app.db.engine import Connection
from amers.app.usecases.blocks.listing import extent_of, only_block, published_first


def find_block(connection: Connection, reference: str) -> Block:
    """The block with this number, ID or ID@VERSION.

    Raises:
        NotFound, Conflict: as `only_block`.
    """
    return only_block(blocks.find_blocks(connection, reference), reference)


def find_shown_block(connection: Connection, reference: str) -> Block:
    """The block to show for a number, ID or ID@VERSION; of several versions the published one.

    Raises:
        NotFound, Conflict: as `only_block`.
    """
    return only_block(published_first(blocks.find_blocks(connection, reference)), reference)


def block_extent(block: Block) -> tuple[float, float, float, float]:
    """West, south, east, north of the outline of a block, degrees; see `extent_of`."""
    return extent_of(*block.outline.min(axis=0).tolist(), *block.outline.max(axis=0).tolist())
