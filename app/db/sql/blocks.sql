-- Blocks (app/db/ingestion.py).

-- name: set_outline
-- The outline of the points of a block: the ground around them within 2.8 times their spacing, less a rim
-- of twice their spacing. So gaps between points close, and islands and large lakes stay apart. It
-- surrounds all points, within the outline that the block declares, to a 64th of its size.
-- Longitudes continue across 180 degrees as in the declared outline, and are as long as latitudes while
-- circles are drawn. Of millions of points, one in each cell of a grid is drawn.
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
