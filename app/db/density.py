"""How many points there are in cells of a tenth of a degree, and in coarser ones.

The database keeps the cells as blocks are published and withdrawn (revision 0004), and what is taken
from them as points are superseded or suspended (revision 0010). A cell of level k is 0.1 * 2^k degrees
wide.
"""

from app.db.engine import Connection
from app.db.features.bbox import Box
from app.db.features.collection import Collection, Property

COARSEST = 6
CELL_DEG = 0.1
MOST_CELLS = 10_000
"""Cells that are added up for one box."""

SERVED = "greatest(t.n_points - t.n_unserved, 0)"

DENSITY = Collection(
    id="density",
    title="Density",
    description="Published points in cells of 0.1 degree that the outlines of published blocks meet.",
    source="density_cell t",
    key=Property("id", "bigint", "Identifier of the cell"),
    properties=(
        Property("n_points", "bigint", "Points served in the cell, of all blocks", sql=SERVED),
        Property("n_blocks", "bigint", "Blocks that meet the cell"),
        Property(
            "area_km2",
            "double precision",
            "Area of the cell inside outlines of blocks; the whole cell's at most where blocks overlap",
            sql="least(t.outline_km2, t.cell_km2)",
            unit="km2",
        ),
        Property(
            "points_per_km2",
            "double precision",
            "Points by that area",
            sql=f"{SERVED} / least(t.outline_km2, t.cell_km2)",
            unit="1/km2",
        ),
    ),
    geometry_type="Polygon",
    visible="t.level = 0",
)


def count_unserved_cells(connection: Connection) -> None:
    """Keep how many points of each cell are superseded or suspended."""
    connection.execute("select count_unserved_cells()")


def points_in_box(connection: Connection, box: Box) -> int:
    """About how many points a box holds: those of cells inside, and of others by the part inside.

    It is wrong by no more than the points of the cells that the edge of the box cuts.
    """
    east = box.east if box.west <= box.east else box.east + 360.0
    width, height = east - box.west, box.north - box.south
    level = 0
    while level < COARSEST and width * height / (CELL_DEG * 2**level) ** 2 > MOST_CELLS:
        level += 1
    ranges = [(box.west, min(east, 180.0))] + ([(-180.0, box.east)] if east > 180.0 else [])
    return sum(_in_range(connection, level, west, box.south, east, box.north) for west, east in ranges)


def _in_range(
    connection: Connection, level: int, west: float, south: float, east: float, north: float
) -> int:
    row = connection.execute(
        f"""select coalesce(round(sum({SERVED}
                * (least(st_xmax(t.geom), %(east)s) - greatest(st_xmin(t.geom), %(west)s))
                * (least(st_ymax(t.geom), %(north)s) - greatest(st_ymin(t.geom), %(south)s))
                / st_area(t.geom))), 0)::bigint as n
            from density_cell t where t.level = %(level)s
                and t.geom && st_makeenvelope(%(west)s, %(south)s, %(east)s, %(north)s, 4326)""",
        {"level": level, "west": west, "south": south, "east": east, "north": north},
    ).fetchone()
    assert row is not None
    return int(row["n"])
