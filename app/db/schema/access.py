"""Tables of who may call, of the audit and of the installation itself."""

from typing import Literal

from sqlalchemy import (
    ARRAY,
    BigInteger,
    Boolean,
    CheckConstraint,
    Column,
    Identity,
    Index,
    Integer,
    LargeBinary,
    Table,
    Text,
    Uuid,
    text,
)

from amers.app.db.schema.base import Double, Json, Timestamp, clock, metadata, now, one_of, uptime_s

token = Table(
    "token",
    metadata,
    Column("id", Uuid, primary_key=True),
    Column("name", Text, nullable=False),
    # SHA-256 of the secret; null for an identity of an OpenID Connect issuer.
    Column("secret_hash", LargeBinary, unique=True),
    Column("scopes", ARRAY(Text, as_tuple=True), nullable=False),
    Column("created_at", Timestamp, nullable=False, server_default=now),
    Column("expires_at", Timestamp),
    Column("revoked_at", Timestamp),
    # Identity at an OpenID Connect issuer; null for a token with a secret.
    Column("subject", Text, unique=True),
    # Null: the quotas of the settings.
    Column("storage_quota_bytes", BigInteger),
    Column("job_quota", Integer),
    CheckConstraint(
        "scopes <@ array['read', 'register', 'monitor', 'admin'] and scopes <> '{}'", name="scopes"
    ),
    CheckConstraint("(secret_hash is null) <> (subject is null)", name="secret_or_subject"),
    CheckConstraint("storage_quota_bytes >= 0", name="storage_quota_bytes"),
    CheckConstraint("job_quota >= 0", name="job_quota"),
)

# Sessions of browsers that were signed out before their end; a row is needed until then.
ended_session = Table(
    "ended_session",
    metadata,
    Column("id", Uuid, primary_key=True),
    Column("ends_at", Timestamp, nullable=False),
)

# Changes of tokens, blocks, scenes, jobs, points and reference images; triggers write it, and refuse any
# change of it but the removal of its oldest rows, which leaves a row itself.
audit = Table(
    "audit",
    metadata,
    Column("id", BigInteger, Identity(always=True), primary_key=True),
    Column("at", Timestamp, nullable=False, server_default=clock),
    Column("actor", Uuid),
    Column("actor_name", Text, nullable=False),
    Column("request_id", Text),
    Column("job_id", Uuid),
    # The table of the row that changed.
    Column("kind", Text, nullable=False),
    # The id of the row; ID@VERSION of a block.
    Column("subject", Text, nullable=False),
    Column("action", Text, nullable=False),
    Column("before", Json),
    Column("after", Json),
    Column("at_uptime_s", Double, nullable=False, server_default=uptime_s),
    one_of("action", Literal["created", "changed", "deleted"]),
    Index("audit_subject", "kind", "subject", "id"),
)

# One row: what this installation alone has.
installation = Table(
    "installation",
    metadata,
    Column("single", Boolean, primary_key=True, server_default=text("true")),
    # Signs the keys of pages.
    Column("page_secret", LargeBinary, nullable=False),
    # The storage of the files names it in its file `installation.json`.
    Column("id", Uuid, nullable=False, server_default=text("gen_random_uuid()")),
    # Advances here and in the storage while the service runs: an older backup is behind.
    Column("storage_generation", BigInteger, nullable=False, server_default=text("0")),
    CheckConstraint("single", name="single"),
)

# One row: the time that the service has run, which no change of a clock moves by more than hours.
uptime = Table(
    "uptime",
    metadata,
    Column("single", Boolean, primary_key=True, server_default=text("true")),
    Column("elapsed_s", Double, nullable=False, server_default=text("0")),
    Column("advanced_at", Timestamp, nullable=False, server_default=now),
    CheckConstraint("single", name="single"),
)
