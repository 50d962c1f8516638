"""Vector tiles, made by the database: points, density cells, outlines of blocks."""

from app.db.density import COARSEST, SERVED
from app.db.engine import Connection
from app.db.features.collection import Viewer
from app.db.features.outlines import BLOCKS
from app.db.points import POINTS

EXTENT = 4096
BUFFER = 64
FIRST_POINT_ZOOM = 8
"""Below, a tile of points would hold more than can be told apart: it holds cells instead."""

TILE = "st_tileenvelope(%(z)s, %(x)s, %(y)s)"
TILE_LON_LAT = f"st_transform(st_expand({TILE}, %(margin_m)s), 4326)"
CELL_FIELDS = (
    f"{SERVED} as n_points, t.n_blocks,"
    " round(least(t.outline_km2, t.cell_km2)::numeric, 3)::float8 as area_km2,"
    f" ({SERVED} / least(t.outline_km2, t.cell_km2))::real as points_per_km2"
)
NOBODY = Viewer()
POINT_FIELDS = (
    "t.id, t.n_views, t.saliency, t.block_number,"
    " sqrt((t.sigma_east_m ^ 2 + t.sigma_north_m ^ 2) / 2)::real as sigma_horizontal_m"
)


def point_tile(connection: Connection, z: int, x: int, y: int) -> bytes:
    """Published points, each with its id; below zoom 8 the centres of density cells that hold some."""
    if z < FIRST_POINT_ZOOM:
        where = f"t.level = {_level(z)} and {SERVED} > 0"
        fields = f"true as aggregated, {CELL_FIELDS}"
        return _tile(
            connection,
            "points",
            "density_cell t",
            "st_centroid(t.geom)",
            "t.geom",
            fields,
            where,
            z,
            x,
            y,
        )
    geometry = "st_setsrid(st_force2d(t.geom), 4326)"
    box = f"st_setsrid({TILE_LON_LAT}, 4979)"
    return _tile(
        connection, "points", "point t", geometry, "t.geom", POINT_FIELDS, POINTS.visible, z, x, y, box
    )


def density_tile(connection: Connection, z: int, x: int, y: int) -> bytes:
    """Density cells: of 0.1 degree from zoom 6 on, twice as wide for each zoom before."""
    fields = f"{_level(z)} as level, t.id, {CELL_FIELDS}"
    where = f"t.level = {_level(z)}"
    return _tile(connection, "density", "density_cell t", "t.geom", "t.geom", fields, where, z, x, y)


def block_tile(connection: Connection, z: int, x: int, y: int, viewer: Viewer) -> bytes:
    """Outlines of the blocks that the viewer may see."""
    fields = "t.number, t.id, t.version, t.title, t.state, t.n_points"
    return _tile(
        connection,
        "blocks",
        BLOCKS.source,
        BLOCKS.geometry,
        BLOCKS.geometry,
        fields,
        BLOCKS.visible,
        z,
        x,
        y,
        viewer=viewer,
    )


def version(connection: Connection) -> str:
    """Changes whenever a block is published, withdrawn, or becomes another, or a point is suspended."""
    row = connection.execute(
        """select count(*) || '-' || coalesce(extract(epoch from max(state_changed_at)), 0)
               || '-' || coalesce((select max(id) from audit where kind = 'point'), 0) as it
           from block"""
    ).fetchone()
    assert row is not None
    return str(row["it"])


def _level(z: int) -> int:
    return max(0, COARSEST - z)


def _tile(
    connection: Connection,
    layer: str,
    source: str,
    geometry: str,
    indexed: str,
    fields: str,
    where: str,
    z: int,
    x: int,
    y: int,
    box: str = TILE_LON_LAT,
    viewer: Viewer = NOBODY,
) -> bytes:
    # Without `offset 0`, which keeps the inner query apart, geometries are projected and clipped twice.
    margin_m = 2.0 * 20037508.342789244 / 2**z * BUFFER / EXTENT
    row = connection.execute(
        f"""select st_asmvt(tile, '{layer}', {EXTENT}, 'geom') as tile from (
                select st_asmvtgeom(st_transform({geometry}, 3857), {TILE}, {EXTENT}, {BUFFER}) as geom,
                    {fields}
                from {source} where {indexed} && {box} and {where} offset 0) tile
            where geom is not null""",
        {"z": z, "x": x, "y": y, "margin_m": margin_m, "viewer": viewer.token, "admin": viewer.is_admin},
        prepare=False,
    ).fetchone()
    assert row is not None
    return bytes(row["tile"])
