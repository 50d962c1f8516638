"""Uploads that can be resumed, what a scene says of itself, what a job shall return and what it said.

`job.cancel_requested` goes: a job is dismissed by its state, and nothing read it.
"""

from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

SCENE = """
alter table scene
    add column models jsonb not null default '{}',
    add column reference text,
    add column acquired_at timestamptz,
    add column sensor text,
    add column gsd_m real,
    add column incidence_deg real,
    add column azimuth_deg real,
    add column sun_elevation_deg real,
    add column sun_azimuth_deg real,
    add column lines int,
    add column samples int
"""

UPLOAD = """
create table upload (
    id uuid primary key,
    owner uuid references token,
    purpose text not null check (purpose in ('image', 'model', 'block')),
    scene_id uuid references scene on delete cascade,
    name text not null,
    file_name text not null,
    size_bytes bigint not null check (size_bytes > 0),
    sha256 text,
    metadata text not null default '',
    file_key text,
    created_at timestamptz not null default now(),
    expires_at timestamptz not null,
    finished_at timestamptz,
    check (purpose = 'block' or scene_id is not null)
)
"""

JOB = """
alter table job
    drop column cancel_requested,
    add column outputs jsonb,
    add column response text not null default 'document' check (response in ('document', 'raw')),
    add column claimed_at timestamptz,
    add column results_removed_at timestamptz
"""

JOB_MESSAGE = """
create table job_message (
    id bigint generated always as identity primary key,
    job_id uuid not null references job on delete cascade,
    attempt int not null,
    progress smallint not null,
    message text not null,
    written_at timestamptz not null default clock_timestamp()
)
"""

INDEXES = (
    "create index upload_expiry on upload (expires_at) where finished_at is null",
    "create index scene_footprint on scene using gist (footprint)",
    "create index job_message_job on job_message (job_id, id)",
    "create index job_finished on job (kind, finished_at) where state = 'successful'",
)

TABLES = (SCENE, UPLOAD, JOB, JOB_MESSAGE)


def upgrade() -> None:
    for statement in (*TABLES, *INDEXES):
        op.execute(statement)


def downgrade() -> None:
    op.execute("drop table job_message, upload")
    op.execute(
        """alter table job add column cancel_requested boolean not null default false,
           drop column outputs, drop column response, drop column claimed_at,
           drop column results_removed_at"""
    )
    op.execute("drop index scene_footprint")
    op.execute(
        """alter table scene drop column models, drop column reference, drop column acquired_at,
           drop column sensor, drop column gsd_m, drop column incidence_deg, drop column azimuth_deg,
           drop column sun_elevation_deg, drop column sun_azimuth_deg, drop column lines,
           drop column samples"""
    )
