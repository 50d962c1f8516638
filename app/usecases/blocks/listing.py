"""List the blocks of the store with their accuracy, or one of them, of the driver's rows alone."""

import math
from collections.abc import Sequence
from typing import TypeVar

from amers.app.db import block_list
from amers.app.db.block_list import BlockSummary, ListedBlock
from amers.app.db.session import DriverConnection
from amers.app.errors import Conflict, NotFound
from amers.services.quality.accuracy_statement import AccuracyStatement, median_accuracy

_PARTS_OF_DEGREE, _HALF_TURN = 1e6, 180.0
Summary = TypeVar("Summary", bound=BlockSummary)


def list_blocks(connection: DriverConnection) -> list[tuple[BlockSummary, AccuracyStatement]]:
    """All blocks, the newest first, each with the accuracy of its median point."""
    return [(entry.block, stated_accuracy(entry)) for entry in block_list.list_blocks(connection)]


def listed_block(connection: DriverConnection, reference: str) -> ListedBlock:
    """The block with this number, ID or ID@VERSION; of several versions the published one.

    Raises:
        NotFound, Conflict: as `only_block`.
    """
    entries = {entry.block.number: entry for entry in block_list.list_blocks(connection)}
    names = {
        number: (str(number), entry.block.id, f"{entry.block.id}@{entry.block.version}")
        for number, entry in sorted(entries.items())
    }
    matches = [entries[number].block for number in names if reference in names[number]]
    return entries[only_block(published_first(matches), reference).number]


def stated_accuracy(entry: ListedBlock) -> AccuracyStatement:
    """The accuracy of the median point of a block."""
    return median_accuracy(entry.sigma_horizontal_m, entry.sigma_up_m, entry.frame)


def published_first(matches: Sequence[Summary]) -> Sequence[Summary]:
    """The published version of several versions of one block; all of them where none is published."""
    return [block for block in matches if block.state == "published"] or matches


def only_block(matches: Sequence[Summary], reference: str) -> Summary:
    """The one block that a reference means.

    Raises:
        NotFound: there is no such block.
        Conflict: the ID has several versions.
    """
    if not matches:
        raise NotFound(
            f"no block {reference:.100}: expected the number, ID or ID@VERSION of a block of the store"
        )
    if len(matches) > 1:
        versions = ", ".join(f"{block.id}@{block.version}" for block in matches)
        raise Conflict(f"block {reference} has {len(matches)} versions, name one: {versions}")
    return matches[0]


def extent_of(west: float, south: float, east: float, north: float) -> tuple[float, float, float, float]:
    """A box rounded outwards to 1e-6 degrees.

    West is greater than east across the antimeridian, as in a `bbox` of OGC API.
    """
    low = [math.floor(value * _PARTS_OF_DEGREE) / _PARTS_OF_DEGREE for value in (west, south)]
    high = [math.ceil(value * _PARTS_OF_DEGREE) / _PARTS_OF_DEGREE for value in (east, north)]
    return _wrapped(low[0]), low[1], _wrapped(high[0]), high[1]


def _wrapped(lon_deg: float) -> float:
    """A longitude from -180 to 180."""
    return lon_deg if abs(lon_deg) <= _HALF_TURN else lon_deg - math.copysign(360.0, lon_deg)
