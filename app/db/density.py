"""The number of points in cells of a tenth of a degree, and in coarser ones.

Triggers of the database count the points of a cell when a block is published or withdrawn, and count
again which of them are not served when points are superseded or suspended (`app/db/sql/functions.sql`).
A cell of level k is 0.1 * 2^k degrees wide.
"""

from functools import cache

from sqlalchemy import BigInteger, Float, Integer, bindparam, cast, func, select

from amers.app.db.constants import integer_constant
from amers.app.db.engine import Connection, driver
from amers.app.db.features.bbox import Box
from amers.app.db.features.collection import Collection, Property, column_property
from amers.app.db.features.predicates import meets_box
from amers.app.db.schema import density_cell
from amers.app.db.schema.base import Double
from amers.app.db.statements import HotStatement, hot

COARSEST = 6
CELL_DEG = 0.1
MOST_CELLS = 10_000
"""Cells that are added up for one box."""

SERVED = func.greatest(
    density_cell.c.n_points - density_cell.c.n_unserved, integer_constant(0), type_=BigInteger()
)
AREA_KM2 = func.least(density_cell.c.outline_km2, density_cell.c.cell_km2, type_=Double)

DENSITY = Collection(
    id="density",
    title="Density",
    description="Number of published points in cells of 0.1 degrees that intersect the outlines "
    "of published blocks.",
    source=density_cell,
    key=column_property(density_cell.c.id, "Identifier of the cell"),
    properties=(
        Property("n_points", "Served points of all blocks in the cell", SERVED),
        column_property(density_cell.c.n_blocks, "Blocks that intersect the cell"),
        Property(
            "area_km2",
            "Area of the cell inside the outlines of blocks; at most the area of the whole cell",
            AREA_KM2,
            unit="km2",
        ),
        Property(
            "points_per_km2", "Points per square kilometre of that area", SERVED / AREA_KM2, unit="1/km2"
        ),
    ),
    geometry_type="Polygon",
    geometry=density_cell.c.geom,
    visible=density_cell.c.level == integer_constant(0),
)


def count_unserved_cells(connection: Connection) -> None:
    """Count again in each cell the points that are superseded or suspended."""
    connection.execute(select(func.count_unserved_cells()))


def points_in_box(connection: Connection, box: Box) -> int:
    """Estimated number of points in a box: cells inside count fully, others in proportion to area.

    The error is at most the number of points of the cells that the edge of the box cuts.
    """
    width = sum(east - west for west, east in box.longitude_ranges)
    height = box.north - box.south
    level = 0
    while level < COARSEST and width * height / (CELL_DEG * 2**level) ** 2 > MOST_CELLS:
        level += 1
    statement, number = _points_in_range(), 0
    for west, east in box.longitude_ranges:
        sides = {"west": west, "south": box.south, "east": east, "north": box.north}
        parameters = statement.parameters({"level": level, **sides})
        row = driver(connection).execute(statement.sql, parameters).fetchone()
        assert row is not None
        number += int(row[0])
    return number


@cache
def _points_in_range() -> HotStatement:
    west, south, east, north = (
        bindparam(side, None, Float()) for side in ("west", "south", "east", "north")
    )
    cell = density_cell.c.geom
    inside_deg2 = (func.least(func.st_xmax(cell), east) - func.greatest(func.st_xmin(cell), west)) * (
        func.least(func.st_ymax(cell), north) - func.greatest(func.st_ymin(cell), south)
    )
    points = func.sum(SERVED * inside_deg2 / func.st_area(cell, type_=Double), type_=Double)
    number = cast(func.coalesce(func.round(points), integer_constant(0)), BigInteger())
    return hot(
        select(number).where(
            density_cell.c.level == bindparam("level", None, Integer()),
            meets_box(cell, func.st_makeenvelope(west, south, east, north, integer_constant(4326))),
        )
    )
