"""Blocks and scenes as collections of their outlines."""

from app.db.features.collection import Collection, Property

STATES = ("staged", "published", "withdrawn")

BLOCKS = Collection(
    id="blocks",
    title="Blocks",
    description="Productions of points, published as a whole; an administrator sees all of them.",
    source="block t",
    key=Property("number", "bigint", "Number of this version"),
    properties=(
        Property("id", "text", "Name of the block"),
        Property("version", "text", "Version"),
        Property("title", "text", "Title"),
        Property("state", "text", "State", choices=STATES),
        Property("priority", "bigint", "Which block comes first over one place"),
        Property("n_points", "bigint", "Points"),
        Property(
            "n_unserved", "bigint", "Points not served: superseded by a better block, or suspended"
        ),
        Property("n_views", "bigint", "Views"),
        Property("created_at", "timestamptz", "When it was ingested"),
        Property("state_changed_at", "timestamptz", "When its state changed last"),
    ),
    geometry_type="Polygon",
    geometry="t.extent_on_map",
    visible="(t.state = 'published' or %(admin)s::boolean)",
    interval=("created_at", "created_at"),
    found_by="(t.number::text = %(key)s or t.id || '@' || t.version = %(key)s"
    " or (t.id = %(key)s and (t.state = 'published' or %(admin)s::boolean)))",
)

SCENES = Collection(
    id="scenes",
    title="Scenes",
    description="Images that were uploaded to be registered, as STAC items; an owner sees his own.",
    source="scene t",
    key=Property("id", "text", "Identifier", sql="t.id::text"),
    properties=(
        Property(
            "datetime",
            "timestamptz",
            "When it was taken; when it was uploaded as long as that is not known",
            sql="coalesce(t.acquired_at, t.created_at)",
        ),
        Property("title", "text", "Name", sql="t.name"),
        Property("created", "timestamptz", "When it was uploaded", sql="t.created_at"),
        Property("platform", "text", "Platform or instrument", sql="t.sensor", nullable=True),
        Property("gsd", "real", "Ground sampling", sql="t.gsd_m", unit="m", nullable=True),
        Property("view:incidence_angle", "real", "Incidence", "t.incidence_deg", "deg", True),
        Property(
            "view:azimuth",
            "real",
            "Azimuth from below the sensor to the scene: 180 degrees from that of a view",
            # STAC looks from the sensor, the store from the ground.
            sql="mod((t.azimuth_deg + 180.0)::numeric, 360)::real",
            unit="deg",
            nullable=True,
        ),
        Property("view:sun_elevation", "real", "Sun's elevation", "t.sun_elevation_deg", "deg", True),
        Property("view:sun_azimuth", "real", "Sun's azimuth", "t.sun_azimuth_deg", "deg", True),
        Property(
            "amers:state", "text", "State", "t.state", choices=("uploading", "uploaded", "removed")
        ),
        Property("amers:acquired", "timestamptz", "When it was taken", "t.acquired_at", nullable=True),
        Property(
            "amers:sigma_m", "real", "Stated standard deviation of its model", "t.sigma_m", "m", True
        ),
        Property("amers:lines", "bigint", "Lines", "t.lines", "px", True),
        Property("amers:samples", "bigint", "Samples", "t.samples", "px", True),
        Property(
            "amers:verdict",
            "text",
            "Verdict on its last registration",
            sql="(select r.verdict from registration r where r.scene_id = t.id"
            " order by r.created_at desc limit 1)",
            nullable=True,
            choices=("good", "usable", "failed"),
        ),
    ),
    geometry_type="Polygon",
    geometry="t.footprint_on_map",
    visible="(%(admin)s::boolean or t.owner = %(viewer)s::uuid)",
    interval=("datetime", "datetime"),
    is_open=False,
)
