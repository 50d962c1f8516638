"""Vector tiles, made by the database: points, density cells, outlines of blocks."""

from dataclasses import dataclass
from functools import cache
from typing import Any

from sqlalchemy import (
    REAL,
    ColumnElement,
    Float,
    FromClause,
    Integer,
    LargeBinary,
    Numeric,
    SmallInteger,
    Text,
    and_,
    bindparam,
    case,
    cast,
    extract,
    func,
    select,
    true,
)
from sqlalchemy.types import NullType

from amers.app.db.constants import integer_constant, text_constant
from amers.app.db.density import AREA_KM2, COARSEST, SERVED
from amers.app.db.engine import Connection, driver
from amers.app.db.features.collection import Viewer
from amers.app.db.features.outlines import BLOCKS
from amers.app.db.features.predicates import meets_box
from amers.app.db.history import HEALTH
from amers.app.db.points import POINTS
from amers.app.db.schema import audit, block, density_cell, point, point_history, registration
from amers.app.db.schema.base import Double
from amers.app.db.statements import HotStatement, hot

EXTENT = 4096
BUFFER = 64
WORLD_M = 2.0 * 20037508.342789244
"""Side of the world in EPSG:3857."""
COUNTED_REGISTRATIONS = 64
"""The last of them tell whether one was added: one that began earlier may end later."""
FIRST_POINT_ZOOM = 8
"""Below, a tile of points would contain more than a map can show apart: it contains cells instead."""

LEVEL = bindparam("level", None, SmallInteger())
TILE = func.st_tileenvelope(*(bindparam(name, None, Integer()) for name in ("z", "x", "y")))
TILE_LON_LAT = func.st_transform(
    func.st_expand(TILE, bindparam("margin_m", None, Float())), integer_constant(4326)
)
CELL_FIELDS: tuple[ColumnElement[Any], ...] = (
    SERVED.label("n_points"),
    density_cell.c.n_blocks,
    cast(func.round(cast(AREA_KM2, Numeric()), integer_constant(3)), Double).label("area_km2"),
    cast(SERVED / AREA_KM2, REAL()).label("points_per_km2"),
)
_VARIANCE_EAST_M2, _VARIANCE_NORTH_M2 = (
    cast(sigma, Double) * sigma for sigma in (point.c.sigma_east_m, point.c.sigma_north_m)
)
SIGMA_HORIZONTAL_M: ColumnElement[float] = cast(
    func.sqrt((_VARIANCE_EAST_M2 + _VARIANCE_NORTH_M2) / integer_constant(2)), REAL()
)


TRIED_HEALTH: ColumnElement[float] = cast(
    case((integer_constant(0) < point_history.c.attempts, HEALTH)), REAL()
)
"""Health of a point that a scene has tried; null for others, a property that a tile leaves out."""

_NONE, _DASH = integer_constant(0), text_constant("-")
_POINT_CHANGES = select(func.max(audit.c.id)).where(audit.c.kind == text_constant("point"))
PUBLICATIONS: ColumnElement[str] = (
    select(
        func.concat(
            func.count(),
            _DASH,
            func.coalesce(extract("epoch", func.max(block.c.state_changed_at)), _NONE),
            _DASH,
            func.coalesce(_POINT_CHANGES.scalar_subquery(), _NONE),
            type_=Text(),
        )
    )
    .select_from(block)
    .scalar_subquery()
)
"""A text that changes when a block is published, withdrawn or replaced, or a point suspended."""
_LAST_COUNTED = (
    select(registration.c.id)
    .where(registration.c.counted)
    .order_by(registration.c.created_at.desc())
    .limit(integer_constant(COUNTED_REGISTRATIONS))
    .subquery("last_counted")
)
REGISTRATIONS: ColumnElement[str] = select(
    func.string_agg(cast(_LAST_COUNTED.c.id, Text()), _DASH, type_=Text())
).scalar_subquery()
"""A text that changes when a registration counts towards the health of points."""


@dataclass(frozen=True, eq=False)
class Layer:
    """The features of a tile.

    Attributes:
        name: of the layer.
        geometry: drawn; longitude and latitude.
        indexed: the geometry that has an index.
        box: of the tile with its margin, in the reference system of `indexed`.
        fields: of each feature.
        visible: which rows are drawn.
        changes: a text that changes when the features do.
    """

    name: str
    source: FromClause
    geometry: ColumnElement[Any]
    indexed: ColumnElement[Any]
    fields: tuple[ColumnElement[Any], ...]
    visible: ColumnElement[bool]
    box: ColumnElement[Any] = TILE_LON_LAT
    changes: ColumnElement[str] = PUBLICATIONS


POINT_LAYER = Layer(
    name="points",
    source=point.outerjoin(point_history, point_history.c.point_id == point.c.id),
    # Tiles leave heights out by themselves.
    geometry=func.st_setsrid(point.c.geom, integer_constant(4326)),
    indexed=point.c.geom,
    fields=(
        point.c.id,
        point.c.n_views,
        point.c.saliency,
        point.c.block_number,
        SIGMA_HORIZONTAL_M.label("sigma_horizontal_m"),
        TRIED_HEALTH.label("health"),
    ),
    visible=POINTS.visible,
    box=func.st_setsrid(TILE_LON_LAT, integer_constant(4979)),
    changes=func.concat(PUBLICATIONS, _DASH, REGISTRATIONS),
)
POINT_CELL_LAYER = Layer(
    name="points",
    source=density_cell,
    geometry=func.st_centroid(density_cell.c.geom),
    indexed=density_cell.c.geom,
    fields=(true().label("aggregated"), *CELL_FIELDS),
    visible=and_(density_cell.c.level == LEVEL, integer_constant(0) < SERVED),
)
DENSITY_LAYER = Layer(
    name="density",
    source=density_cell,
    geometry=density_cell.c.geom,
    indexed=density_cell.c.geom,
    fields=(density_cell.c.level, density_cell.c.id, *CELL_FIELDS),
    visible=density_cell.c.level == LEVEL,
)
"""Density cells: of 0.1 degree from zoom 6 on, twice as wide for each zoom before."""
BLOCK_LAYER = Layer(
    name="blocks",
    source=block,
    geometry=BLOCKS.geometry,
    indexed=BLOCKS.geometry,
    fields=(block.c.number, block.c.id, block.c.version, block.c.title, block.c.state, block.c.n_points),
    visible=BLOCKS.visible,
)


def point_layer(z: int) -> Layer:
    """Published points, each with its id; below zoom 8 the centres of density cells that have some."""
    return POINT_CELL_LAYER if z < FIRST_POINT_ZOOM else POINT_LAYER


def version(connection: Connection, layer: Layer) -> str:
    """A text that changes with the features of a layer."""
    statement = _version_statement(layer)
    row = driver(connection).execute(statement.sql, statement.parameters({})).fetchone()
    assert row is not None
    return str(row[0])


def tile(connection: Connection, layer: Layer, z: int, x: int, y: int, *, viewer: Viewer) -> bytes:
    """The features of a layer that the viewer may see in a tile."""
    statement = _tile_statement(layer)
    place = {"z": z, "x": x, "y": y, "level": max(0, COARSEST - z)}
    parameters = {**place, "margin_m": WORLD_M / 2**z * BUFFER / EXTENT, **viewer.parameters}
    with driver(connection).cursor() as cursor:
        cursor.execute(statement.sql, statement.parameters(parameters), prepare=False)
        row = cursor.fetchone()
    assert row is not None
    return bytes(row[0])


@cache
def _tile_statement(layer: Layer) -> HotStatement:
    extent, buffer = integer_constant(EXTENT), integer_constant(BUFFER)
    projected = func.st_transform(layer.geometry, integer_constant(3857))
    drawn = func.st_asmvtgeom(projected, TILE, extent, buffer, type_=NullType())
    # Without `offset 0`, which keeps the inner query apart, geometries are projected and clipped twice.
    features = (
        select(drawn.label("geom"), *layer.fields)
        .select_from(layer.source)
        .where(meets_box(layer.indexed, layer.box), layer.visible)
        .offset(integer_constant(0))
        .subquery("tile")
    )
    name, geometry = text_constant(layer.name), text_constant("geom")
    tile = func.st_asmvt(features.table_valued(), name, extent, geometry, type_=LargeBinary())
    return hot(select(tile).where(features.c.geom.is_not(None)))


@cache
def _version_statement(layer: Layer) -> HotStatement:
    return hot(select(layer.changes))
