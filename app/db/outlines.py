"""Blocks and scenes as collections of their outlines."""

from app.db.collections import Collection, Property

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
        Property("n_superseded", "bigint", "Points that another block has better"),
        Property("n_views", "bigint", "Views"),
        Property("created_at", "timestamptz", "When it was ingested"),
        Property("state_changed_at", "timestamptz", "When its state changed last"),
    ),
    geometry_type="Polygon",
    geometry="t.extent",
    visible="(t.state = 'published' or %(admin)s::boolean)",
    interval=("created_at", "created_at"),
    found_by="(t.number::text = %(key)s or t.id || '@' || t.version = %(key)s"
    " or (t.id = %(key)s and (t.state = 'published' or %(admin)s::boolean)))",
)

SCENES = Collection(
    id="scenes",
    title="Scenes",
    description="Images that were uploaded to be registered; an owner sees his own.",
    source="scene t",
    key=Property("id", "text", "Identifier", sql="t.id::text"),
    properties=(
        Property("name", "text", "Name"),
        Property("state", "text", "State", choices=("uploading", "uploaded", "removed")),
        Property("created_at", "timestamptz", "When it was uploaded"),
        Property("acquired_at", "timestamptz", "When it was taken", nullable=True),
        Property("sensor", "text", "Platform or instrument", nullable=True),
        Property("gsd_m", "real", "Ground sampling", unit="m", nullable=True),
        Property("sigma_m", "real", "Stated standard deviation of its model", unit="m", nullable=True),
        Property("incidence_deg", "real", "Incidence", unit="deg", nullable=True),
        Property(
            "azimuth_deg", "real", "Azimuth from the ground to the sensor", unit="deg", nullable=True
        ),
        Property("sun_elevation_deg", "real", "Elevation of the sun", unit="deg", nullable=True),
        Property("sun_azimuth_deg", "real", "Azimuth of the sun", unit="deg", nullable=True),
        Property("lines", "bigint", "Lines", unit="px", nullable=True),
        Property("samples", "bigint", "Samples", unit="px", nullable=True),
    ),
    geometry_type="Polygon",
    geometry="t.footprint",
    visible="(%(admin)s::boolean or t.owner = %(viewer)s::uuid)",
    interval=("acquired_at", "acquired_at"),
    is_open=False,
)
