"""Outlines of blocks and scenes as they lie on a map: cut at 180 degrees, as RFC 7946 has it.

What crosses the antimeridian is kept in one piece, with longitudes beyond: areas and overlaps are
calculated with that. What is told, drawn and searched is the outline on the map.
"""

from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

OUTLINES = {"block": "extent", "scene": "footprint"}


def upgrade() -> None:
    for table, outline in OUTLINES.items():
        cut = f"st_wrapx(st_wrapx({outline}, 180, -360), -180, 360)"
        op.execute(
            f"""alter table {table} add column {outline}_on_map geometry(Geometry, 4326)
                generated always as (st_forcepolygonccw({cut})) stored"""
        )
        op.execute(f"create index {table}_{outline}_on_map on {table} using gist ({outline}_on_map)")
    op.execute("drop index scene_footprint")


def downgrade() -> None:
    op.execute("create index scene_footprint on scene using gist (footprint)")
    for table, outline in OUTLINES.items():
        op.execute(f"alter table {table} drop column {outline}_on_map")
