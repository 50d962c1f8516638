"""How many points there are in cells of a tenth of a degree, and in coarser ones.

The database keeps the cells as blocks are published and withdrawn (revision 0004). A cell of level k is
0.1 * 2^k degrees wide.
"""

from app.db.collections import Collection, Property

COARSEST = 6

DENSITY = Collection(
    id="density",
    title="Density",
    description="Published points in cells of 0.1 degree that the outlines of published blocks meet.",
    source="density_cell t",
    key=Property("id", "bigint", "Identifier of the cell"),
    properties=(
        Property("n_points", "bigint", "Points in the cell, of all blocks"),
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
            sql="t.n_points / least(t.outline_km2, t.cell_km2)",
            unit="1/km2",
        ),
    ),
    geometry_type="Polygon",
    visible="t.level = 0",
)
