"""The outline of each block: of its points, where its document may declare no more than a box.

The blocks present get theirs. It locks the table of blocks while all points are read once; they are not
touched.
"""

from alembic import op
from sqlalchemy import text

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None

UPGRADE = """
alter table block add column outline geometry(geometry, 4326);
alter table block drop column extent_on_map;
alter table block add column outline_on_map geometry(geometry, 4326) generated always as (
    st_forcepolygonccw(st_wrapx(st_wrapx(coalesce(outline, extent), 180, -360), -180, 360))) stored;
create index block_outline_on_map on block using gist (outline_on_map)
"""

FILL = """
with place as (
    select n_points, extent, st_x(st_centroid(extent)) as lon,
        greatest(cos(radians(st_y(st_centroid(extent)))), 0.01) as narrow
    from block where number = :number
), grid as (
    select *, greatest((st_xmax(extent) - st_xmin(extent)) * narrow, st_ymax(extent) - st_ymin(extent))
        / 512 as step
    from place
), seen as (
    select distinct st_snaptogrid(st_makepoint(
        (st_x(geom) + 360 * round((lon - st_x(geom)) / 360)) * narrow, st_y(geom)), step) as position
    from point, grid where id >= :first and id < :end
), spread as (
    select st_collect(position) as whole from seen
), spaced as (
    select greatest(4 * step, sqrt(st_area(st_convexhull(whole)) / n_points),
        greatest(st_xmax(whole) - st_xmin(whole), st_ymax(whole) - st_ymin(whole))
            / least(n_points, 64)) as spacing
    from spread, grid
), reached as (
    select st_union(st_buffer(position, 2.8 * spacing, 4)) as ground
    from (select distinct st_snaptogrid(position, spacing / 2) as position from seen, spaced) few, spaced
), outlined as (
    select st_collectionextract(st_intersection(extent, st_setsrid(st_scale(
        st_simplifypreservetopology(st_buffer(ground, -2 * spacing, 4), spacing / 8),
        1 / narrow, 1), 4326)), 3) as outline
    from reached, spaced, grid
)
update block set outline = outlined.outline from outlined
where number = :number and not st_isempty(outlined.outline)
"""

DOWNGRADE = """
alter table block drop column outline_on_map;
alter table block drop column outline;
alter table block add column extent_on_map geometry(geometry, 4326) generated always as (
    st_forcepolygonccw(st_wrapx(st_wrapx(extent, 180, -360), -180, 360))) stored;
create index block_extent_on_map on block using gist (extent_on_map)
"""


def upgrade() -> None:
    op.execute(UPGRADE)
    connection = op.get_bind()
    for number in connection.scalars(text("select number from block order by number")).all():
        ids = {"first": number << 26, "end": (number + 1) << 26}
        connection.execute(text(FILL), {"number": number, **ids})


def downgrade() -> None:
    op.execute(DOWNGRADE)
