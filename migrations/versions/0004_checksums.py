"""Checksums of chips, results and reference images, and the files found damaged."""

from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

UPGRADE = """
alter table chip_file add column chip_checksums bytea;
alter table reference_image add column checksums jsonb;
create table result_file (
    storage_key text not null,
    job_id uuid not null,
    size_bytes bigint not null,
    sha256 text not null,
    constraint result_file_pkey primary key (storage_key),
    constraint result_file_size_bytes_check check (size_bytes >= 0),
    constraint result_file_job_id_fkey foreign key (job_id) references job (id) on delete cascade
);
create index result_file_job on result_file (job_id);
create table damaged_file (
    storage_key text not null,
    reason text not null,
    found_at timestamptz not null default clock_timestamp(),
    last_found_at timestamptz not null default clock_timestamp(),
    constraint damaged_file_pkey primary key (storage_key)
);
"""
DOWNGRADE = """
drop table damaged_file;
drop table result_file;
alter table reference_image drop column checksums;
alter table chip_file drop column chip_checksums;
"""


def upgrade() -> None:
    op.execute(UPGRADE)


def downgrade() -> None:
    op.execute(DOWNGRADE)
