"""Find a block of the store, and its extent."""

import numpy as np

from amers.app.db import blocks
from amers.app.db.blocks import Block
from amers.app.db.engine import Connection
from amers.app.errors import Conflict, NotFound

_PARTS_OF_DEGREE, _HALF_TURN = 1e6, 180.0


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


def block_extent(block: Block) -> tuple[float, float, float, float]:
    """West, south, east, north of the outline of a block, degrees, rounded outwards to 1e-6.

    West is greater than east across the antimeridian, as in a `bbox` of OGC API.
    """
    low, high = block.outline.min(axis=0), block.outline.max(axis=0)
    west, south = np.floor(low * _PARTS_OF_DEGREE) / _PARTS_OF_DEGREE
    east, north = np.ceil(high * _PARTS_OF_DEGREE) / _PARTS_OF_DEGREE
    return _wrapped(west), float(south), _wrapped(east), float(north)


def _wrapped(lon_deg: float) -> float:
    """A longitude from -180 to 180."""
    return float(lon_deg) if abs(lon_deg) <= _HALF_TURN else float(lon_deg - np.sign(lon_deg) * 360.0)
