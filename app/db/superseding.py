"""Several blocks over one place: which of two points is served.

Blocks have an order. A point is superseded when a published block that comes before its own has a point
within `SAME_PLACE_M` of it. Which points are superseded follows from which blocks are published and from
nothing else, so that publications and withdrawals can be undone in any order.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import shapely
from sqlalchemy import LargeBinary, func, select

from amers.app.db.blocks import FRAME_SIGMA_M, ID_BITS
from amers.app.db.constants import text_constant
from amers.app.db.density import count_unserved_cells
from amers.app.db.engine import Connection, driver
from amers.app.db.features.antimeridian import on_the_map
from amers.app.db.schema import block
from amers.app.db.schema.base import Double
from amers.app.db.statements import HotStatement, hot, named

SAME_PLACE_M = 10.0
"""Horizontally: two fifths of what a chip of half a metre shows to either side of its centre."""
SHORTEST_DEGREE_M = 110_574.0
"""A degree of latitude at the equator, the shortest one, rounded down."""
PUBLICATION_LOCK = 0x504F494E54
MARGIN_DEG = 0.01
"""Around outlines: points of two blocks whose outlines do not quite touch may still be one place."""

INDEX_SCANS = "select set_config('enable_indexscan', %(allowed)s, true)"
"""Turned off, indexes are read by bitmap scans.

Of a first page that is the whole index, an index scan of GiST that starts again for each row keeps which
entries are dead, and after a split of that page marks others in their place: the index no longer finds
living points (seen with PostgreSQL 15). The statement that supersedes points splits pages while it
scans. A bitmap scan marks nothing.
"""


@dataclass(frozen=True)
class Ranked:
    """A published block in the order of blocks; `area` is its outline on the map with a margin."""

    number: int
    area: shapely.Geometry


def lock_publications(connection: Connection) -> None:
    """Make other publications wait until the end of the transaction."""
    connection.execute(select(func.pg_advisory_xact_lock(PUBLICATION_LOCK)))


def recompute(connection: Connection, number: int) -> None:
    """Update which points are superseded wherever a block counts whose state or priority has changed.

    Args:
        number: of the block, published now or not.
    """
    ranked = _published(connection)
    own = next((other for other in ranked if other.number == number), None)
    if own is None:
        _release(connection, ranked, number)
    else:
        for other in ranked:
            area = shapely.intersection(other.area, own.area)
            if other.number != number and not area.is_empty:
                _supersede_inside(connection, other, _before(ranked, other), area)
        _supersede_inside(connection, own, _before(ranked, own), own.area)
    count_unserved(connection)


def count_unserved(connection: Connection) -> None:
    """Count again the points of each block and cell that are not served: superseded, or suspended."""
    connection.execute(named("superseding.sql", "count_unserved"), {"id_bits": ID_BITS})
    count_unserved_cells(connection)


def _published(connection: Connection) -> list[Ranked]:
    """The published blocks, the one whose points win first.

    In this order: by priority; by how well the frame is known on the Earth, unknown last; by the stated
    precision; the newer first.
    """
    sigma_horizontal_m = block.c.quality["sigma_horizontal_m"]["median"].astext.cast(Double)
    statement = (
        select(block.c.number, func.st_asbinary(block.c.extent, type_=LargeBinary()).label("outline"))
        .where(block.c.state == text_constant("published"))
        .order_by(
            block.c.priority.desc(),
            FRAME_SIGMA_M.nulls_last(),
            sigma_horizontal_m,
            block.c.number.desc(),
        )
    )
    return [
        Ranked(row.number, _with_margin(bytes(row.outline))) for row in connection.execute(statement)
    ]


def _before(ranked: list[Ranked], own: Ranked) -> list[int]:
    """Numbers of the blocks that win over a block and lie near it, the best one first."""
    place = [other.number for other in ranked].index(own.number)
    return [other.number for other in ranked[:place] if shapely.intersects(other.area, own.area)]


def _supersede_inside(
    connection: Connection, own: Ranked, winners: list[int], area: shapely.Geometry
) -> None:
    """Write to each point of a block in an area which point supersedes it, or none."""
    for part in shapely.get_parts(area):
        wkb = shapely.to_wkb(part, hex=True)
        _supersede(connection, own.number, winners, part=wkb, lost_first=None, lost_end=None)


def _release(connection: Connection, ranked: list[Ranked], number: int) -> None:
    """Let a block that is not published supersede nothing, and be superseded by nothing."""
    connection.execute(named("superseding.sql", "release"), _range(number))
    lost = {f"lost_{name}": value for name, value in _range(number).items()}
    for other in ranked:
        _supersede(connection, other.number, _before(ranked, other), part=None, **lost)


def _supersede(connection: Connection, number: int, winners: list[int], **restrictions: Any) -> None:
    parameters = {
        **_range(number),
        **restrictions,
        "winners": winners,
        "metres": SAME_PLACE_M,
        "degrees": SAME_PLACE_M / SHORTEST_DEGREE_M,
    }
    statement = _supersede_statement()
    with driver(connection).cursor() as cursor:
        cursor.execute(INDEX_SCANS, {"allowed": "off"})
        # Not prepared: the best plan depends on the restrictions.
        cursor.execute(statement.sql, parameters, prepare=False)
        cursor.execute(INDEX_SCANS, {"allowed": "on"})


@cache
def _supersede_statement() -> HotStatement:
    return hot(named("superseding.sql", "supersede"))


def _range(number: int) -> dict[str, int]:
    """The ids of the points of a block."""
    return {"first": number << ID_BITS, "end": (number + 1) << ID_BITS}


def _with_margin(outline: bytes) -> shapely.Geometry:
    """An outline with continuous longitudes, grown by a margin, between -180 and 180 degrees."""
    return on_the_map(shapely.make_valid(shapely.from_wkb(outline)).buffer(MARGIN_DEG))
