"""Tables of the checks of stored files: checksums of results, and the files found damaged."""

from sqlalchemy import BigInteger, CheckConstraint, Column, ForeignKey, Index, Table, Text

from amers.app.db.schema.base import Timestamp, clock, metadata

# Files of the results of jobs; other files have size and checksum in the rows that name them.
result_file = Table(
    "result_file",
    metadata,
    Column("storage_key", Text, primary_key=True),
    Column("job_id", ForeignKey("job.id", ondelete="CASCADE"), nullable=False),
    Column("size_bytes", BigInteger, nullable=False),
    Column("sha256", Text, nullable=False),
    CheckConstraint("size_bytes >= 0", name="size_bytes"),
    Index("result_file_job", "job_id"),
)

# Files that were found damaged or missing; a row goes when its file is whole again or no longer named.
damaged_file = Table(
    "damaged_file",
    metadata,
    Column("storage_key", Text, primary_key=True),
    Column("reason", Text, nullable=False),
    Column("found_at", Timestamp, nullable=False, server_default=clock),
    Column("last_found_at", Timestamp, nullable=False, server_default=clock),
)
