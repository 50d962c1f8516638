"""Tables of registrations: the outcome of each point and view, their histories, reference images."""

from sqlalchemy import (
    BigInteger,
    Boolean,
    CheckConstraint,
    Column,
    ForeignKey,
    Identity,
    Index,
    Integer,
    SmallInteger,
    Table,
    Text,
    UniqueConstraint,
    Uuid,
    text,
)

from amers.app.db.schema.base import Double, Json, PointZ, Polygon, Real, Timestamp, metadata, now

registration = Table(
    "registration",
    metadata,
    Column("id", Uuid, primary_key=True),
    Column("job_id", ForeignKey("job.id", ondelete="SET NULL")),
    Column("scene_id", ForeignKey("scene.id")),
    # Id and version of each block whose points were used.
    Column("block_versions", Json, nullable=False),
    Column("options", Json, nullable=False),
    # report.json.
    Column("report", Json, nullable=False),
    Column("verdict", Text, nullable=False),
    # Name to key in the storage.
    Column("files", Json, nullable=False),
    Column("created_at", Timestamp, nullable=False, server_default=now),
    # What identifies the scene; only one registration of a scene counts in the histories.
    Column("scene_key", Text),
    Column("counted", Boolean, nullable=False, server_default=text("false")),
    # A job registers one scene or several, each once.
    UniqueConstraint("job_id", "scene_id"),
    Index("registration_scene", "scene_id"),
    Index("registration_counted", "scene_key", unique=True, postgresql_where=text("counted")),
    Index("registration_last_counted", "created_at", postgresql_where=text("counted")),
)

# Outcome of one point in one registration.
measure = Table(
    "measure",
    metadata,
    Column("registration_id", ForeignKey("registration.id", ondelete="CASCADE"), primary_key=True),
    Column("point_id", BigInteger, primary_key=True, autoincrement=False),
    Column("matched", Boolean, nullable=False),
    Column("active", Boolean, nullable=False),
    Column("reason", Text, nullable=False),
    Column("score", Real),
    Column("line", Double),
    Column("sample", Double),
    Column("sigma_px", Real),
    Column("residual_line_px", Real),
    Column("residual_sample_px", Real),
    Column("residual_east_m", Real),
    Column("residual_north_m", Real),
)

# Outcome of one view in one registration.
view_measure = Table(
    "view_measure",
    metadata,
    Column("registration_id", ForeignKey("registration.id", ondelete="CASCADE"), primary_key=True),
    Column("point_id", BigInteger, primary_key=True, autoincrement=False),
    Column("view", SmallInteger, primary_key=True, autoincrement=False),
    Column("agreed", Boolean, nullable=False),
    Column("reason", Text, nullable=False),
    Column("score", Real),
)

# Sums over all registrations that counted; they outlive the rows of `measure`.
point_history = Table(
    "point_history",
    metadata,
    Column("point_id", BigInteger, primary_key=True, autoincrement=False),
    Column("attempts", Integer, nullable=False, server_default=text("0")),
    Column("successes", Integer, nullable=False, server_default=text("0")),
    # Successes that the neighbours of the point would have had.
    Column("expected", Double, nullable=False, server_default=text("0")),
    Column("matched", Integer, nullable=False, server_default=text("0")),
    Column("sum_residual_px", Double, nullable=False, server_default=text("0")),
    Column("sum_east_m", Double, nullable=False, server_default=text("0")),
    Column("sum_north_m", Double, nullable=False, server_default=text("0")),
    Column("last_attempt", Timestamp),
    Column("last_success", Timestamp),
)

view_history = Table(
    "view_history",
    metadata,
    Column("point_id", BigInteger, primary_key=True, autoincrement=False),
    Column("view", SmallInteger, primary_key=True, autoincrement=False),
    Column("attempts", Integer, nullable=False),
    Column("successes", Integer, nullable=False),
    Column("expected", Double, nullable=False),
)

# Images on which scenes are registered where there are no points; paths below AMERS_REFERENCE_FOLDER.
reference_image = Table(
    "reference_image",
    metadata,
    Column("id", Integer, Identity(always=True), primary_key=True),
    Column("name", Text, nullable=False, unique=True),
    Column("image", Text, nullable=False),
    Column("dem", Text),
    Column("vertical", Text),
    Column("geoid", Text),
    Column("sigma_m", Real),
    Column("gsd_m", Double, nullable=False),
    Column("footprint", Polygon, nullable=False),
    Column("created_at", Timestamp, nullable=False, server_default=now),
    # Path to SHA-256 of each of its files; null: added by an earlier version and not verified since.
    Column("checksums", Json),
    # Of its heights on the Earth, as sigma_m of its positions; null: unknown.
    Column("sigma_up_m", Real),
    CheckConstraint("sigma_m > 0", name="sigma_m"),
    CheckConstraint("sigma_up_m > 0", name="sigma_up_m"),
    CheckConstraint("gsd_m > 0", name="gsd_m"),
)

# Places of a reference image where scenes were matched; later scenes are matched there first.
reference_point = Table(
    "reference_point",
    metadata,
    Column("id", BigInteger, Identity(always=True), primary_key=True),
    Column("reference_id", ForeignKey("reference_image.id", ondelete="CASCADE"), nullable=False),
    Column("geom", PointZ, nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("successes", Integer, nullable=False),
    Column("last_success_at", Timestamp, nullable=False),
    CheckConstraint("attempts > 0", name="attempts"),
    CheckConstraint("successes between 0 and attempts", name="successes"),
    Index("reference_point_geom", "geom", postgresql_using="gist"),
    Index("reference_point_reference", "reference_id"),
)
