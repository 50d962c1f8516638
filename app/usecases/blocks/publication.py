"""Which blocks are served: publish, withdraw, restore and prioritise them."""

from dataclasses import dataclass

from amers.app.db import blocks, superseding
from amers.app.db.blocks import Block
from amers.app.db.engine import Connection
from amers.app.db.schema import BlockState
from amers.app.errors import Conflict, InputError, NotFound
from amers.app.usecases.blocks.lookup import find_block

MAY_BECOME: dict[BlockState, tuple[BlockState, ...]] = {
    "staged": ("published",),
    "published": ("withdrawn",),
    "withdrawn": ("published",),
}
LARGEST_PRIORITY = 1000


@dataclass(frozen=True)
class Published:
    """A block that was published.

    Attributes:
        block: the published version.
        superseded: the version of the same block that was published before; None when there was none.
    """

    block: Block
    superseded: Block | None


def publish_block(connection: Connection, reference: str) -> Published:
    """Publish a block and, in the same step, withdraw the version of it that was published before.

    Where several blocks have a point at one place, the point of the better block is served: see
    `amers.app.db.superseding`.

    Raises:
        NotFound: there is no such block.
        Conflict: it is already published, or the reference fits several versions.
    """
    block, versions = lock_block(connection, reference)
    before = next((v for v in versions if v.state == "published" and v.number != block.number), None)
    _set_state(connection, block, "published")
    if before is not None:
        _set_state(connection, before, "withdrawn")
        superseding.recompute(connection, before.number)
    superseding.recompute(connection, block.number)
    return Published(
        blocks.read_block_row(connection, block.number),
        None if before is None else blocks.read_block_row(connection, before.number),
    )


def withdraw_block(connection: Connection, reference: str) -> Block:
    """Withdraw a published block; it can be restored.

    Raises:
        NotFound: there is no such block.
        Conflict: it is not published, or the reference fits several versions.
    """
    block, _ = lock_block(connection, reference)
    _set_state(connection, block, "withdrawn")
    superseding.recompute(connection, block.number)
    return blocks.read_block_row(connection, block.number)


def restore_block(connection: Connection, reference: str) -> Published:
    """Publish a withdrawn or superseded block again, in place of its published version.

    Raises:
        NotFound: there is no such block.
        Conflict: it was never published or is published, or the reference fits several versions.
    """
    block = find_block(connection, reference)
    if block.state == "staged":
        raise Conflict(
            f"block {block.id}@{block.version} was never published: publish it instead of restoring it"
        )
    return publish_block(connection, str(block.number))


def prioritise_block(connection: Connection, reference: str, priority: int) -> Block:
    """Set the priority of a block among overlapping blocks; it takes effect at once if it is published.

    Raises:
        NotFound: there is no such block.
        Conflict: the reference fits several versions.
        InputError: the priority is out of range.
    """
    check_priority(priority)
    block, _ = lock_block(connection, reference)
    blocks.set_priority(connection, block.number, priority)
    if block.state == "published":
        superseding.recompute(connection, block.number)
    return blocks.read_block_row(connection, block.number)


def find_published(connection: Connection, reference: str) -> Block:
    """The published block with this number, ID or ID@VERSION; an ID has at most one published version.

    Raises:
        NotFound: there is no such block, or it is not published.
    """
    for block in blocks.find_blocks(connection, reference):
        if block.state == "published":
            return block
    raise NotFound(
        f"no published block {reference:.100}: expected the number, ID or ID@VERSION of one of the store"
    )


def lock_block(connection: Connection, reference: str) -> tuple[Block, list[Block]]:
    """Lock a block against changes by others; returns its present state, and all its versions."""
    superseding.lock_publications(connection)
    number = find_block(connection, reference).number
    versions = blocks.lock_versions(connection, blocks.read_block_row(connection, number).id)
    return next(version for version in versions if version.number == number), versions


def check_priority(priority: int) -> None:
    if not -LARGEST_PRIORITY <= priority <= LARGEST_PRIORITY:
        raise InputError(
            f"priority: {priority} found, {-LARGEST_PRIORITY} to {LARGEST_PRIORITY} expected"
        )


def _set_state(connection: Connection, block: Block, state: BlockState) -> Block:
    if state not in MAY_BECOME[block.state]:
        raise Conflict(f"block {block.id}@{block.version} is {block.state}: it cannot become {state}")
    return blocks.set_state(connection, block.number, state)
