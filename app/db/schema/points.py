"""Tables of blocks: their points, views, images and files of chips, and the density of points."""

from typing import Literal

from sqlalchemy import (
    BigInteger,
    CheckConstraint,
    Column,
    Date,
    ForeignKey,
    Identity,
    Index,
    Integer,
    LargeBinary,
    SmallInteger,
    Table,
    Text,
    UniqueConstraint,
    column,
    func,
    text,
)

from amers.app.db.schema.base import (
    Double,
    Json,
    MapOutline,
    PointZ,
    Polygon,
    Real,
    Timestamp,
    metadata,
    now,
    on_map,
    one_of,
)
from amers.app.db.states import BlockState

block = Table(
    "block",
    metadata,
    # Of this version in this database; the upper bits of the ids of its points.
    Column("number", Integer, Identity(always=True), primary_key=True),
    Column("id", Text, nullable=False),
    Column("version", Text, nullable=False),
    Column("title", Text, nullable=False, server_default=""),
    Column("state", Text, nullable=False),
    # As its document declares it.
    Column("extent", Polygon, nullable=False),
    Column("n_points", BigInteger, nullable=False),
    Column("n_views", BigInteger, nullable=False),
    # block.json as delivered.
    Column("metadata", Json, nullable=False),
    Column("quality", Json),
    # SHA-256 of block.json.
    Column("checksum", Text, nullable=False),
    Column("created_at", Timestamp, nullable=False, server_default=now),
    Column("state_changed_at", Timestamp, nullable=False, server_default=now),
    # Where blocks overlap, points of the block with the greatest priority are served.
    Column("priority", Integer, nullable=False, server_default=text("0")),
    # Points that are superseded by a better block or suspended.
    Column("n_unserved", BigInteger, nullable=False, server_default=text("0")),
    # CE90 and LE90 of its median point, in its frame and on the Earth; null: unknown.
    Column("relative_ce90_m", Real),
    Column("relative_le90_m", Real),
    Column("on_the_earth_ce90_m", Real),
    Column("on_the_earth_le90_m", Real),
    # Of its points, inside `extent`; longitudes continue across 180 degrees; null without points.
    Column("outline", MapOutline),
    Column("outline_on_map", MapOutline, on_map(func.coalesce(column("outline"), column("extent")))),
    UniqueConstraint("id", "version"),
    one_of("state", BlockState),
    Index(
        "block_extent", "extent", postgresql_using="gist", postgresql_where=text("state = 'published'")
    ),
    Index("block_outline_on_map", "outline_on_map", postgresql_using="gist"),
)

# Images that the views of a block were cut from.
image = Table(
    "image",
    metadata,
    Column("block_number", ForeignKey("block.number", ondelete="CASCADE"), primary_key=True),
    # Index in block.json.
    Column("image", Integer, primary_key=True, autoincrement=False),
    Column("image_id", Text, nullable=False),
    Column("sensor", Text, nullable=False),
    Column("acquired_at", Timestamp),
    Column("incidence_deg", Real),
    Column("azimuth_deg", Real),
    Column("sun_elevation_deg", Real),
    Column("sun_azimuth_deg", Real),
)

# Arrays of chips in the storage.
chip_file = Table(
    "chip_file",
    metadata,
    Column("id", Integer, Identity(always=True), primary_key=True),
    Column("block_number", ForeignKey("block.number", ondelete="CASCADE"), nullable=False),
    # Path in the block.
    Column("name", Text, nullable=False),
    Column("storage_key", Text, nullable=False),
    Column("dtype", Text, nullable=False),
    Column("n_chips", BigInteger, nullable=False),
    # Four bytes for each chip; null: ingested by an earlier version and not verified since.
    Column("chip_checksums", LargeBinary),
    UniqueConstraint("block_number", "name"),
    one_of("dtype", Literal["uint8", "uint16"]),
    Index("chip_file_key", "storage_key"),
)

point = Table(
    "point",
    metadata,
    # block.number * 2^26 + the id in the block: a block is a range of ids.
    Column("id", BigInteger, primary_key=True, autoincrement=False),
    Column("block_number", ForeignKey("block.number", ondelete="CASCADE"), nullable=False),
    Column("geom", PointZ, nullable=False),
    Column("sigma_east_m", Real, nullable=False),
    Column("sigma_north_m", Real, nullable=False),
    Column("sigma_up_m", Real, nullable=False),
    Column("corr_east_north", Real, nullable=False),
    Column("corr_east_up", Real, nullable=False),
    Column("corr_north_up", Real, nullable=False),
    Column("n_views", SmallInteger, nullable=False),
    Column("saliency", Real, nullable=False),
    Column("typology", Text),
    Column("first_view", Date),
    Column("last_view", Date),
    # Chips of the point: `chip_count` consecutive rows of one file.
    Column("chip_file", ForeignKey("chip_file.id"), nullable=False),
    Column("chip_row", BigInteger, nullable=False),
    Column("chip_count", SmallInteger, nullable=False),
    # The point of a better block at the same place, which is served instead.
    Column("superseded_by", BigInteger),
    # Set by an administrator: the point is not served.
    Column("suspended_at", Timestamp),
    Column("suspended_because", Text),
    # The surface at its longitude and latitude, where its block states it: both or neither.
    Column("surface_height_m", Double),
    Column("surface_sigma_m", Real),
    CheckConstraint("id >> 26 = block_number", name="id_in_block"),
    CheckConstraint("sigma_east_m > 0 and sigma_east_m < 'infinity'", name="sigma_east_m"),
    CheckConstraint("sigma_north_m > 0 and sigma_north_m < 'infinity'", name="sigma_north_m"),
    CheckConstraint("sigma_up_m > 0 and sigma_up_m < 'infinity'", name="sigma_up_m"),
    CheckConstraint("corr_east_north between -1 and 1", name="corr_east_north"),
    CheckConstraint("corr_east_up between -1 and 1", name="corr_east_up"),
    CheckConstraint("corr_north_up between -1 and 1", name="corr_north_up"),
    CheckConstraint("saliency between 0 and 1", name="saliency"),
    Index("point_geom", "geom", postgresql_using="gist"),
    Index("point_superseded", "id", postgresql_where=text("superseded_by is not null")),
    Index("point_superseded_by", "superseded_by", postgresql_where=text("superseded_by is not null")),
    Index("point_suspended", "id", postgresql_where=text("suspended_at is not null")),
    # A block is deleted with its points and files: its points are physically together.
    Index("point_block", "block_number", postgresql_using="brin"),
    Index("point_chip_file", "chip_file"),
)

# One chip of a point and the geometry of the image it was cut from.
view = Table(
    "view",
    metadata,
    Column("point_id", BigInteger, primary_key=True, autoincrement=False),
    Column("view", SmallInteger, primary_key=True, autoincrement=False),
    # Index of the image in its block.
    Column("image", Integer, nullable=False),
    Column("gsd_m", Real, nullable=False),
    Column("incidence_deg", Real, nullable=False),
    Column("azimuth_deg", Real, nullable=False),
)

# Counts of published points in cells of 0.1 * 2^level degrees; `keep_density` keeps them.
density_cell = Table(
    "density_cell",
    metadata,
    Column("id", Integer, primary_key=True, autoincrement=False),
    Column("level", SmallInteger, nullable=False),
    Column("geom", Polygon, nullable=False),
    Column("n_points", BigInteger, nullable=False),
    Column("n_blocks", Integer, nullable=False),
    # Area of the cell inside the outlines of its blocks, and of the whole cell.
    Column("outline_km2", Double, nullable=False),
    Column("cell_km2", Double, nullable=False),
    # Points that are superseded or suspended.
    Column("n_unserved", BigInteger, nullable=False, server_default=text("0")),
    CheckConstraint("level between 0 and 6", name="level"),
    Index("density_cell_geom", "geom", postgresql_using="gist"),
    Index("density_cell_empty", "id", postgresql_where=text("n_blocks = 0")),
)
