"""Several blocks over one place: which of two points is served.

Blocks have an order. A point is superseded when a published block that comes before its own has a point
within `SAME_PLACE_M` of it. What is superseded follows from which blocks are published and nothing else,
so that publications and withdrawals can be undone in any order.
"""

from dataclasses import dataclass

import shapely
import shapely.affinity

from app.db.blocks import ID_BITS
from app.db.density import count_unserved_cells
from app.db.engine import Connection

SAME_PLACE_M = 10.0
"""Horizontally: two fifths of what a chip of half a metre shows to either side of its centre."""
PUBLICATION_LOCK = 0x504F494E54
MARGIN_DEG = 0.01
"""Around outlines: points of two blocks whose outlines do not quite touch may still be one place."""
METRES_PER_DEGREE = 110_500.0
"""Of latitude, at most one part in a hundred less than anywhere."""

# How far a point and another are apart is told on a sphere: 0.5 % of ten metres are of no account.
NEAREST = """(select w.id
    from point w, lateral (select st_distancesphere(w.geom, l.geom) as metres) apart
    where w.geom && st_expand(
            l.geom, %(degrees)s / greatest(cos(radians(st_y(l.geom))), 0.001), %(degrees)s)
        and w.block_number = any(%(winners)s) and apart.metres <= %(metres)s
    order by array_position(%(winners)s, w.block_number), apart.metres, w.id limit 1)"""


@dataclass(frozen=True)
class Ranked:
    """A published block in the order of blocks; `area` is its outline on the map with a margin."""

    number: int
    area: shapely.Geometry


def lock_publications(connection: Connection) -> None:
    """Let one publication after the other decide what is served, until the end of the transaction."""
    connection.execute("select pg_advisory_xact_lock(%s)", [PUBLICATION_LOCK])


def recompute(connection: Connection, number: int) -> None:
    """Decide anew wherever a block matters whose state or priority has changed.

    Args:
        number: of the block, published now or not.
    """
    ranked = _published(connection)
    own = next((block for block in ranked if block.number == number), None)
    if own is None:
        _release(connection, ranked, number)
    else:
        for block in ranked:
            area = shapely.intersection(block.area, own.area)
            if block.number != number and not area.is_empty:
                _decide(connection, block, _before(ranked, block), area)
        _decide(connection, own, _before(ranked, own), own.area)
    count_unserved(connection)


def _published(connection: Connection) -> list[Ranked]:
    """The published blocks, the one whose points win first.

    In this order: by priority; by how well the frame is known on the Earth, one that says nothing last;
    by the stated precision; the newer first.
    """
    rows = connection.execute(
        """select number, st_asbinary(extent) as outline from block where state = 'published'
           order by priority desc,
               jsonb_path_query_first(metadata, '$."amers:accuracy"."absolute"[*]
                   ? (@.name == "frame_sigma_m").value')::float8 nulls last,
               (quality -> 'sigma_horizontal_m' ->> 'median')::float8, number desc"""
    ).fetchall()
    return [Ranked(row["number"], _on_the_map(bytes(row["outline"]))) for row in rows]


def _before(ranked: list[Ranked], block: Ranked) -> list[int]:
    """Numbers of the blocks that win over a block and lie near it, the best one first."""
    place = [other.number for other in ranked].index(block.number)
    return [other.number for other in ranked[:place] if shapely.intersects(other.area, block.area)]


def _decide(connection: Connection, block: Ranked, winners: list[int], area: shapely.Geometry) -> None:
    """Say of each point of a block in an area which point supersedes it, or that none does."""
    for part in shapely.get_parts(area):
        connection.execute(
            f"""update point set superseded_by = found.by
                from (select l.id, {NEAREST} as by from point l
                      where l.id >= %(first)s and l.id < %(end)s
                          and l.geom && st_setsrid(%(part)s::geometry, 4979)) found
                where point.id = found.id and point.superseded_by is distinct from found.by""",
            {
                **_range(block.number),
                "winners": winners,
                "part": shapely.to_wkb(part, hex=True),
                "metres": SAME_PLACE_M,
                "degrees": SAME_PLACE_M / METRES_PER_DEGREE,
            },
            prepare=False,
        )


def _release(connection: Connection, ranked: list[Ranked], number: int) -> None:
    """A block that is not published supersedes nothing, and is superseded by nothing."""
    connection.execute(
        """update point set superseded_by = null
           where id >= %(first)s and id < %(end)s and superseded_by is not null""",
        _range(number),
    )
    for block in ranked:
        connection.execute(
            f"""update point l set superseded_by = {NEAREST}
                where l.superseded_by >= %(lost_first)s and l.superseded_by < %(lost_end)s
                    and l.id >= %(first)s and l.id < %(end)s""",
            {
                **_range(block.number),
                **{f"lost_{name}": value for name, value in _range(number).items()},
                "winners": _before(ranked, block),
                "metres": SAME_PLACE_M,
                "degrees": SAME_PLACE_M / METRES_PER_DEGREE,
            },
            prepare=False,
        )


def count_unserved(connection: Connection) -> None:
    """Keep how many points of each block and cell are not served: superseded, or suspended."""
    connection.execute(
        f"""update block set n_unserved = coalesce(found.n, 0)
            from block b left join (select (id >> {ID_BITS})::int as number, count(*) as n from point
                                    where superseded_by is not null or suspended_at is not null
                                    group by 1) found using (number)
            where block.number = b.number and block.n_unserved <> coalesce(found.n, 0)"""
    )
    count_unserved_cells(connection)


def _range(number: int) -> dict[str, int]:
    """The ids of the points of a block."""
    return {"first": number << ID_BITS, "end": (number + 1) << ID_BITS}


def _on_the_map(outline: bytes) -> shapely.Geometry:
    """An outline with continuous longitudes, grown by a margin, between -180 and 180 degrees."""
    polygon = shapely.make_valid(shapely.from_wkb(outline)).buffer(MARGIN_DEG)
    world = shapely.box(-180.0, -90.0, 180.0, 90.0)

    turned = (shapely.affinity.translate(polygon, xoff=degrees) for degrees in (-360.0, 0.0, 360.0))
    return shapely.union_all([shapely.intersection(part, world) for part in turned])
