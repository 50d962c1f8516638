"""Blocks as the store has them: find one, list them, state their accuracy."""

from collections.abc import Sequence

from app.db import blocks
from app.db.blocks import Block
from app.db.engine import Connection
from app.db.schema import BlockState
from app.errors import Conflict, NotFound
from services.quality.accuracy_statement import AccuracyStatement, median_accuracy


def find_block(connection: Connection, reference: str) -> Block:
    """The block with this number, ID or ID@VERSION.

    Raises:
        NotFound: there is no such block.
        Conflict: the ID has several versions.
    """
    matches = blocks.find_blocks(connection, reference)
    if not matches:
        raise NotFound(
            f"no block {reference:.100}: expected the number, ID or ID@VERSION of a block of the store"
        )
    if len(matches) > 1:
        versions = ", ".join(f"{block.id}@{block.version}" for block in matches)
        raise Conflict(f"block {reference} has {len(matches)} versions, name one: {versions}")
    return matches[0]


def list_blocks(
    connection: Connection, states: tuple[BlockState, ...] = ("staged", "published", "withdrawn")
) -> list[Block]:
    """The blocks in some states, the newest first."""
    return blocks.list_blocks(connection, states)


def stated_accuracies(connection: Connection, numbers: Sequence[int]) -> dict[int, AccuracyStatement]:
    """The accuracy of the median points of some blocks, by the numbers of the blocks."""
    stated = blocks.stated_sigmas(connection, numbers)
    return {
        number: median_accuracy(one.horizontal_m, one.up_m, one.frame) for number, one in stated.items()
    }
