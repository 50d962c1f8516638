"""The store as it begins: blocks of points with their views, scenes, jobs, registrations and tokens.

A point's id is `block.number * 2^26 + its id in the block`, so that a block is a range of ids and the
rows of its views need no column of their own to be found.
"""

from alembic import op

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

POSTGIS = "create extension if not exists postgis"

TOKEN = """
create table token (
    id uuid primary key,
    name text not null,
    secret_hash bytea not null unique,
    scopes text[] not null check (scopes <@ array['read', 'register', 'admin'] and scopes <> '{}'),
    created_at timestamptz not null default now(),
    expires_at timestamptz,
    revoked_at timestamptz
)
"""

BLOCK = """
create table block (
    number int generated always as identity primary key,
    id text not null,
    version text not null,
    title text not null default '',
    state text not null check (state in ('staged', 'published', 'withdrawn')),
    extent geometry(Polygon, 4326) not null,
    n_points bigint not null,
    n_views bigint not null,
    metadata jsonb not null,
    quality jsonb,
    checksum text not null,
    created_at timestamptz not null default now(),
    state_changed_at timestamptz not null default now(),
    unique (id, version)
)
"""

IMAGE = """
create table image (
    block_number int not null references block on delete cascade,
    image int not null,
    image_id text not null,
    sensor text not null,
    acquired_at timestamptz,
    incidence_deg real,
    azimuth_deg real,
    sun_elevation_deg real,
    sun_azimuth_deg real,
    primary key (block_number, image)
)
"""

CHIP_FILE = """
create table chip_file (
    id int generated always as identity primary key,
    block_number int not null references block on delete cascade,
    name text not null,
    storage_key text not null,
    dtype text not null check (dtype in ('uint8', 'uint16')),
    n_chips bigint not null,
    unique (block_number, name)
)
"""

POINT = """
create table point (
    id bigint primary key,
    block_number int not null references block on delete cascade,
    geom geometry(PointZ, 4979) not null,
    sigma_east_m real not null check (sigma_east_m > 0 and sigma_east_m < 'infinity'),
    sigma_north_m real not null check (sigma_north_m > 0 and sigma_north_m < 'infinity'),
    sigma_up_m real not null check (sigma_up_m > 0 and sigma_up_m < 'infinity'),
    corr_east_north real not null check (corr_east_north between -1 and 1),
    corr_east_up real not null check (corr_east_up between -1 and 1),
    corr_north_up real not null check (corr_north_up between -1 and 1),
    n_views smallint not null,
    saliency real not null check (saliency between 0 and 1),
    typology text,
    first_view date,
    last_view date,
    chip_file int not null references chip_file,
    chip_row bigint not null,
    chip_count smallint not null,
    check (id >> 26 = block_number)
)
"""

VIEW = """
create table view (
    point_id bigint not null,
    view smallint not null,
    image int not null,
    gsd_m real not null,
    incidence_deg real not null,
    azimuth_deg real not null,
    primary key (point_id, view)
)
"""

SCENE = """
create table scene (
    id uuid primary key,
    owner uuid references token,
    name text not null,
    state text not null check (state in ('uploading', 'uploaded', 'removed')),
    file_key text,
    file_name text not null,
    size_bytes bigint,
    sha256 text,
    sigma_m real check (sigma_m > 0),
    footprint geometry(Polygon, 4326),
    created_at timestamptz not null default now(),
    removed_at timestamptz
)
"""

JOB = """
create table job (
    id uuid primary key,
    kind text not null,
    state text not null check (state in ('accepted', 'running', 'successful', 'failed', 'dismissed')),
    progress smallint not null default 0 check (progress between 0 and 100),
    message text not null default '',
    inputs jsonb not null,
    owner uuid references token,
    attempt int not null default 0,
    failures int not null default 0,
    lease_until timestamptz,
    worker text,
    cancel_requested boolean not null default false,
    idempotency_key text,
    created_at timestamptz not null default now(),
    started_at timestamptz,
    finished_at timestamptz,
    updated_at timestamptz not null default now(),
    error jsonb,
    results jsonb,
    unique (owner, idempotency_key)
)
"""

REGISTRATION = """
create table registration (
    id uuid primary key,
    job_id uuid unique references job,
    scene_id uuid references scene,
    block_versions jsonb not null,
    options jsonb not null,
    report jsonb not null,
    verdict text not null,
    files jsonb not null,
    created_at timestamptz not null default now()
)
"""

MEASURE = """
create table measure (
    registration_id uuid not null references registration on delete cascade,
    point_id bigint not null,
    matched boolean not null,
    active boolean not null,
    reason text not null,
    score real,
    line double precision,
    sample double precision,
    sigma_px real,
    residual_line_px real,
    residual_sample_px real,
    primary key (registration_id, point_id)
)
"""

INDEXES = (
    "create index point_geom on point using gist (geom)",
    "create index block_extent on block using gist (extent) where state = 'published'",
    "create index chip_file_key on chip_file (storage_key)",
    "create index scene_owner on scene (owner, created_at)",
    "create index job_owner on job (owner, created_at)",
    "create index job_lease on job (lease_until) where state in ('accepted', 'running')",
    "create index registration_scene on registration (scene_id)",
)

TABLES = (TOKEN, BLOCK, IMAGE, CHIP_FILE, POINT, VIEW, SCENE, JOB, REGISTRATION, MEASURE)


def upgrade() -> None:
    for statement in (POSTGIS, *TABLES, *INDEXES):
        op.execute(statement)


def downgrade() -> None:
    for name in (
        "measure",
        "registration",
        "job",
        "scene",
        "view",
        "point",
        "chip_file",
        "image",
        "block",
        "token",
    ):
        op.execute(f"drop table {name}")
