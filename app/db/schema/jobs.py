"""Tables of scenes, uploads and jobs."""

from sqlalchemy import (
    BigInteger,
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
    column,
    text,
)

from amers.app.db.schema.base import (
    Double,
    Json,
    MapOutline,
    Polygon,
    Real,
    Timestamp,
    clock,
    metadata,
    now,
    on_map,
    one_of,
    uptime_s,
)
from amers.app.db.states import JobResponse, JobState, SceneState, UploadPurpose

scene = Table(
    "scene",
    metadata,
    Column("id", Uuid, primary_key=True),
    Column("owner", ForeignKey("token.id")),
    Column("name", Text, nullable=False),
    Column("state", Text, nullable=False),
    # Of the image in the storage; null while it is on its way and once it was removed.
    Column("file_key", Text),
    Column("file_name", Text, nullable=False),
    Column("size_bytes", BigInteger),
    Column("sha256", Text),
    # Accuracy of the sensor model as its owner states it.
    Column("sigma_m", Real),
    Column("footprint", Polygon),
    Column("created_at", Timestamp, nullable=False, server_default=now),
    Column("removed_at", Timestamp),
    # Files beside the image: name to size and checksum.
    Column("models", Json, nullable=False, server_default="{}"),
    # Path below AMERS_SCENE_FOLDER of an image that was not uploaded.
    Column("reference", Text),
    # From here to `samples`: read from the files by the first registration.
    Column("acquired_at", Timestamp),
    Column("sensor", Text),
    Column("gsd_m", Real),
    Column("incidence_deg", Real),
    Column("azimuth_deg", Real),
    Column("sun_elevation_deg", Real),
    Column("sun_azimuth_deg", Real),
    Column("lines", Integer),
    Column("samples", Integer),
    Column("created_at_uptime_s", Double, nullable=False, server_default=uptime_s),
    Column("footprint_on_map", MapOutline, on_map(column("footprint"))),
    # Sum of the sizes in `models`.
    Column("side_file_bytes", BigInteger, nullable=False, server_default=text("0")),
    one_of("state", SceneState),
    CheckConstraint("sigma_m > 0", name="sigma_m"),
    Index("scene_owner", "owner", "created_at"),
    Index("scene_footprint_on_map", "footprint_on_map", postgresql_using="gist"),
    Index(
        "scene_usage",
        "owner",
        postgresql_include=["size_bytes", "side_file_bytes"],
        postgresql_where=text("state <> 'removed'"),
    ),
)

# Files that arrive in pieces.
upload = Table(
    "upload",
    metadata,
    Column("id", Uuid, primary_key=True),
    Column("owner", ForeignKey("token.id")),
    Column("purpose", Text, nullable=False),
    # Null for a block.
    Column("scene_id", ForeignKey("scene.id", ondelete="CASCADE")),
    # As the sender calls it, and as the storage does.
    Column("name", Text, nullable=False),
    Column("file_name", Text, nullable=False),
    Column("size_bytes", BigInteger, nullable=False),
    Column("sha256", Text),
    # As sent, to be repeated to the sender.
    Column("metadata", Text, nullable=False, server_default=""),
    # Of the complete archive of a block.
    Column("file_key", Text),
    Column("created_at", Timestamp, nullable=False, server_default=now),
    Column("expires_at", Timestamp, nullable=False),
    Column("finished_at", Timestamp),
    # Uptime at the last piece.
    Column("active_at_uptime_s", Double, nullable=False, server_default=uptime_s),
    one_of("purpose", UploadPurpose),
    CheckConstraint("size_bytes > 0", name="size_bytes"),
    CheckConstraint("purpose = 'block' or scene_id is not null", name="scene_id"),
    Index("upload_expiry", "expires_at", postgresql_where=text("finished_at is null")),
    Index(
        "upload_usage",
        "owner",
        postgresql_include=["size_bytes", "finished_at"],
        postgresql_where=text("finished_at is null or file_key is not null"),
    ),
)

job = Table(
    "job",
    metadata,
    Column("id", Uuid, primary_key=True),
    # The process.
    Column("kind", Text, nullable=False),
    Column("state", Text, nullable=False),
    # Percent.
    Column("progress", SmallInteger, nullable=False, server_default=text("0")),
    Column("message", Text, nullable=False, server_default=""),
    Column("inputs", Json, nullable=False),
    # Null: the command line.
    Column("owner", ForeignKey("token.id")),
    # Number of the last claim; a write that names another one is refused.
    Column("attempt", Integer, nullable=False, server_default=text("0")),
    # Attempts that ended without an outcome: a crash, an outage, a lost worker.
    Column("failures", Integer, nullable=False, server_default=text("0")),
    Column("lease_until", Timestamp),
    Column("worker", Text),
    Column("idempotency_key", Text),
    Column("created_at", Timestamp, nullable=False, server_default=clock),
    # The first attempt; `claimed_at` is the last.
    Column("started_at", Timestamp),
    Column("finished_at", Timestamp),
    Column("updated_at", Timestamp, nullable=False, server_default=now),
    # Problem details of a failure.
    Column("error", Json),
    Column("results", Json),
    # Outputs wanted, each with its form; null: all.
    Column("outputs", Json),
    Column("response", Text, nullable=False, server_default="document"),
    Column("claimed_at", Timestamp),
    # When the files of the results were removed.
    Column("results_removed_at", Timestamp),
    # Jobs of a higher priority come first; only administrators set it.
    Column("priority", SmallInteger, nullable=False, server_default=text("0")),
    # The delay of a repeated attempt; null: the job may be claimed at once.
    Column("not_before", Timestamp),
    # Of the files of the results, reserved before they are stored; null: an earlier version did not
    # record it, and the sweep measures the files.
    Column("results_bytes", BigInteger, server_default=text("0")),
    Column("created_at_uptime_s", Double, nullable=False, server_default=uptime_s),
    UniqueConstraint("owner", "idempotency_key"),
    one_of("state", JobState),
    one_of("response", JobResponse),
    CheckConstraint("progress between 0 and 100", name="progress"),
    CheckConstraint("priority between -100 and 100", name="priority"),
    Index("job_owner", "owner", "created_at"),
    Index("job_lease", "lease_until", postgresql_where=text("state in ('accepted', 'running')")),
    Index("job_finished", "kind", "finished_at", postgresql_where=text("state = 'successful'")),
    Index(
        "job_results",
        "finished_at",
        postgresql_where=text("state = 'successful' and results_removed_at is null"),
    ),
    # The next jobs of every owner, and how many of his jobs run.
    Index(
        "job_waiting",
        "owner",
        text("priority desc"),
        "created_at",
        "id",
        postgresql_where=text("state = 'accepted'"),
    ),
    Index("job_running", "owner", postgresql_where=text("state = 'running'")),
    Index(
        "job_usage",
        "owner",
        postgresql_include=["results_bytes"],
        postgresql_where=text("results_bytes > 0"),
    ),
)

# When a job of each owner was last claimed: the owner who waits longest is next. Jobs may be deleted
# later, so this time is kept beside them.
job_turn = Table(
    "job_turn",
    metadata,
    # Null: the command line.
    Column("owner", ForeignKey("token.id", ondelete="CASCADE")),
    Column("claimed_at", Timestamp, nullable=False),
    UniqueConstraint("owner", postgresql_nulls_not_distinct=True),
    # CPU that jobs of the owner took, less what has been given back until `cpu_at`.
    Column("cpu_s", Double, nullable=False, server_default=text("0")),
    Column("cpu_at", Timestamp, nullable=False, server_default=clock),
)

# Messages of a job in their order; the trigger `job_messages` writes them.
job_message = Table(
    "job_message",
    metadata,
    Column("id", BigInteger, Identity(always=True), primary_key=True),
    Column("job_id", ForeignKey("job.id", ondelete="CASCADE"), nullable=False),
    Column("attempt", Integer, nullable=False),
    Column("progress", SmallInteger, nullable=False),
    Column("message", Text, nullable=False),
    Column("written_at", Timestamp, nullable=False, server_default=clock),
    Index("job_message_job", "job_id", "id"),
)
