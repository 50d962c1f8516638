"""Blocks and scenes as collections of their outlines."""

from typing import get_args

from sqlalchemy import Numeric, Text, and_, cast, func, or_, select
from sqlalchemy.dialects.postgresql import ARRAY, JSONB

from amers.app.db.constants import integer_constant, text_constant
from amers.app.db.features.collection import (
    IS_ADMIN,
    REFERENCE,
    VIEWER,
    Collection,
    Property,
    column_property,
)
from amers.app.db.schema import BlockState, SceneState, block, registration, scene
from amers.app.db.schema.base import Real

_BLOCK_VISIBLE = or_(block.c.state == text_constant("published"), IS_ADMIN)

_ATTRIBUTION = cast(
    func.jsonb_path_query_first(
        block.c.metadata, text_constant('$."amers:provenance"."options"."attribution"'), type_=JSONB
    ).op("#>>", return_type=Text())(cast(text_constant("{}"), ARRAY(Text()))),
    Text(),
)
"""What the terms of the data ask to show of a block; null where it has none."""

BLOCKS = Collection(
    id="blocks",
    title="Blocks",
    description="Blocks: productions of points that are published as a whole. Administrators "
    "see unpublished blocks too.",
    source=block,
    key=column_property(block.c.number, "Number of this version"),
    properties=(
        column_property(block.c.id, "Name of the block"),
        column_property(block.c.version, "Version"),
        column_property(block.c.title, "Title"),
        Property(
            "attribution", "Attribution that the terms of the data require", _ATTRIBUTION, nullable=True
        ),
        column_property(block.c.state, "State", choices=get_args(BlockState)),
        column_property(block.c.priority, "Priority over other blocks of the same place"),
        column_property(block.c.n_points, "Points"),
        column_property(
            block.c.n_unserved, "Points not served: superseded by a better block, or suspended"
        ),
        column_property(block.c.n_views, "Views"),
        column_property(
            block.c.relative_ce90_m,
            "CE90 of its median point, relative to the control points",
            "m",
            absent="unknown",
        ),
        column_property(
            block.c.relative_le90_m,
            "LE90 of its median point, relative to the control points",
            "m",
            absent="unknown",
        ),
        column_property(
            block.c.on_the_earth_ce90_m, "CE90 of its median point, on the Earth", "m", absent="unknown"
        ),
        column_property(
            block.c.on_the_earth_le90_m, "LE90 of its median point, on the Earth", "m", absent="unknown"
        ),
        column_property(block.c.created_at, "When it was ingested"),
        column_property(block.c.state_changed_at, "When its state changed last"),
    ),
    geometry_type="Polygon",
    geometry=block.c.outline_on_map,
    visible=_BLOCK_VISIBLE,
    interval=("created_at", "created_at"),
    named_by=or_(
        cast(block.c.number, Text()) == REFERENCE,
        block.c.id + text_constant("@") + block.c.version == REFERENCE,
        and_(block.c.id == REFERENCE, _BLOCK_VISIBLE),
    ),
)

_LAST_VERDICT = (
    select(registration.c.verdict)
    .where(registration.c.scene_id == scene.c.id)
    .order_by(registration.c.created_at.desc())
    .limit(integer_constant(1))
    .scalar_subquery()
)
# STAC looks from the sensor, the store from the ground.
_AZIMUTH_FROM_SENSOR = cast(
    func.mod(
        cast(scene.c.azimuth_deg + integer_constant(180), Numeric()),
        integer_constant(360),
        type_=Numeric(),
    ),
    Real,
)

SCENES = Collection(
    id="scenes",
    title="Scenes",
    description="Images that were uploaded to be registered, as STAC items; owners see their own.",
    source=scene,
    key=Property("id", "Identifier", cast(scene.c.id, Text())),
    properties=(
        Property(
            "datetime",
            "Acquisition time; the time of the upload if the acquisition time is unknown",
            func.coalesce(scene.c.acquired_at, scene.c.created_at),
        ),
        column_property(scene.c.name, "Name", name="title"),
        column_property(scene.c.created_at, "When it was uploaded", name="created"),
        column_property(scene.c.sensor, "Platform or instrument", name="platform"),
        column_property(scene.c.gsd_m, "Ground sampling", "m", name="gsd"),
        column_property(scene.c.incidence_deg, "Incidence", "deg", name="view:incidence_angle"),
        Property(
            "view:azimuth",
            "Azimuth from below the sensor to the scene: 180 degrees from that of a view",
            _AZIMUTH_FROM_SENSOR,
            unit="deg",
            nullable=True,
        ),
        column_property(scene.c.sun_elevation_deg, "Sun's elevation", "deg", name="view:sun_elevation"),
        column_property(scene.c.sun_azimuth_deg, "Sun's azimuth", "deg", name="view:sun_azimuth"),
        column_property(scene.c.state, "State", name="amers:state", choices=get_args(SceneState)),
        column_property(scene.c.acquired_at, "When it was taken", name="amers:acquired"),
        column_property(
            scene.c.sigma_m, "Stated standard deviation of its model", "m", name="amers:sigma_m"
        ),
        column_property(scene.c.lines, "Lines", "px", name="amers:lines"),
        column_property(scene.c.samples, "Samples", "px", name="amers:samples"),
        Property(
            "amers:verdict",
            "Verdict on its last registration",
            _LAST_VERDICT,
            nullable=True,
            choices=("good", "usable", "failed"),
        ),
    ),
    geometry_type="Polygon",
    geometry=scene.c.footprint_on_map,
    visible=or_(IS_ADMIN, scene.c.owner == VIEWER),
    interval=("datetime", "datetime"),
    is_open=False,
    members=(Property("collection", "Identifier of the collection", text_constant("scenes")),),
)
