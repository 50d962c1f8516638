create extension if not exists postgis;

-- Functions of the store. They come before the tables, whose defaults call them, so that the bodies are
-- not checked yet.
set local check_function_bodies = off;

-- Time that the service has run, in seconds.
create function uptime_s() returns double precision language sql stable as $$
    select elapsed_s from uptime
$$;

-- Area on the WGS 84 ellipsoid from the equator to a latitude, for one degree of longitude.
-- Source: Snyder (1987), Map projections: a working manual, equation 3-12.
create function zone_km2(lat_deg double precision) returns double precision
language sql immutable strict parallel safe as $$
    select 6356.752314245 ^ 2 / 2 * radians(1) * (
        sin(radians(lat_deg)) / (1 - 0.00669437999014 * sin(radians(lat_deg)) ^ 2)
        + atanh(0.0818191908426215 * sin(radians(lat_deg))) / 0.0818191908426215)
$$;

-- Add the cells of a block's quality figures to the density cells (sign 1), or take them away (sign -1).
-- A cell of level k is 0.1 * 2^k degrees wide; columns count from 180 W, rows from the south pole.
-- Rows change in the order of their keys, so that of two publications one waits and none deadlocks.
create function add_density(quality jsonb, sign int) returns void language sql as $$
    with listed as (
        select (((c->>0)::float8 * 10)::numeric::int + 1800 + 3600) % 3600 as col,
            ((c->>1)::float8 * 10)::numeric::int + 900 as row,
            (c->>2)::float8 as km2, (c->>3)::float8::bigint as n
        from jsonb_array_elements(quality->'cells') c
    ), cell as (
        select level, col >> level as col, row >> level as row, sum(km2) as km2, sum(n)::bigint as n
        from listed, generate_series(0, 6) level group by 1, 2, 3
    ), placed as (
        select (level << 24) + row * 3600 + col as id, level, km2, n,
            col * w.deg - 180 as west, row * w.deg - 90 as south,
            least((col + 1) * w.deg - 180, 180) as east, least((row + 1) * w.deg - 90, 90) as north
        from cell, lateral (select (0.1 * (1 << level)) as deg) w
    )
    insert into density_cell as d
        (id, level, geom, n_points, n_blocks, outline_km2, cell_km2)
    select id, level, st_makeenvelope(west, south, east, north, 4326), sign * n, sign, sign * km2,
        (zone_km2(north) - zone_km2(south)) * (east - west)::float8
    from placed order by id
    on conflict (id) do update set n_points = d.n_points + excluded.n_points,
        n_blocks = d.n_blocks + excluded.n_blocks, outline_km2 = d.outline_km2 + excluded.outline_km2
$$;

-- Trigger of `block`: density cells count published blocks only.
create function keep_density() returns trigger language plpgsql as $$
begin
    if tg_op <> 'INSERT' and old.state = 'published' then
        perform add_density(old.quality, -1);
    end if;
    if tg_op <> 'DELETE' and new.state = 'published' then
        perform add_density(new.quality, 1);
    end if;
    delete from density_cell where n_blocks = 0;
    return null;
end $$;

-- Count the superseded and suspended points of published blocks again in every density cell.
-- Publications, withdrawals and suspensions call it in their own transaction.
create function count_unserved_cells() returns void language sql as $$
    with lowest as (
        select least(floor((st_x(geom) + 180) * 10)::int, 3599) as col,
            least(floor((st_y(geom) + 90) * 10)::int, 1799) as row, count(*) as n
        from point where (superseded_by is not null or suspended_at is not null)
            and block_number in (select number from block where state = 'published') group by 1, 2
    ), counted as (
        select (level << 24) + (row >> level) * 3600 + (col >> level) as id, sum(n)::bigint as n
        from lowest, generate_series(0, 6) level group by 1
    ), changed as (
        select d.id, coalesce(c.n, 0) as n from density_cell d left join counted c using (id)
        where d.n_unserved <> coalesce(c.n, 0) order by d.id
    )
    update density_cell d set n_unserved = changed.n from changed where d.id = changed.id
$$;

-- Trigger with column names as arguments: a row in `audit` when one of these columns changes.
-- Settings of the transaction name who changes it and why (`app/db/engine.py`).
create function record_change() returns trigger language plpgsql as $$
declare
    full_before jsonb;
    full_after jsonb;
    before jsonb;
    after jsonb;
    named jsonb;
begin
    if tg_op <> 'INSERT' then full_before := to_jsonb(old); end if;
    if tg_op <> 'DELETE' then full_after := to_jsonb(new); end if;
    select jsonb_object_agg(key, value) into before
        from jsonb_each(full_before) where key = any(tg_argv);
    select jsonb_object_agg(key, value) into after
        from jsonb_each(full_after) where key = any(tg_argv);
    if before is not distinct from after then return null; end if;
    named := coalesce(full_after, full_before);
    insert into audit
        (actor, actor_name, request_id, job_id, kind, subject, action, before, after)
    values (
        nullif(current_setting('amers.actor', true), '')::uuid,
        coalesce(
            nullif(current_setting('amers.actor_name', true), ''), 'database role ' || session_user),
        nullif(current_setting('amers.request_id', true), ''),
        nullif(current_setting('amers.job_id', true), '')::uuid,
        tg_table_name,
        case tg_table_name when 'block' then (named->>'id') || '@' || (named->>'version')
                           else named->>'id' end,
        case tg_op when 'INSERT' then 'created' when 'UPDATE' then 'changed' else 'deleted' end,
        before, after);
    return null;
end $$;

-- Trigger of tables that only grow.
create function refuse_change() returns trigger language plpgsql as $$
begin
    raise exception 'table % only grows', tg_table_name using errcode = 'insufficient_privilege';
end $$;

-- Trigger of `job`: each new message, and each new attempt, leaves a row in `job_message`.
create function keep_job_message() returns trigger language plpgsql as $$
begin
    if tg_op = 'INSERT' or (old.message, old.attempt) is distinct from (new.message, new.attempt) then
        insert into job_message (job_id, attempt, progress, message)
        values (new.id, new.attempt, new.progress, new.message);
    end if;
    return null;
end $$;

CREATE TABLE audit (
    id BIGINT GENERATED ALWAYS AS IDENTITY,
    at TIMESTAMP WITH TIME ZONE DEFAULT clock_timestamp() NOT NULL,
    actor UUID,
    actor_name TEXT NOT NULL,
    request_id TEXT,
    job_id UUID,
    kind TEXT NOT NULL,
    subject TEXT NOT NULL,
    action TEXT NOT NULL,
    before JSONB,
    after JSONB,
    CONSTRAINT audit_pkey PRIMARY KEY (id),
    CONSTRAINT audit_action_check CHECK (action IN ('created', 'changed', 'deleted'))
);
CREATE INDEX audit_subject ON audit (kind, subject, id);
CREATE TABLE block (
    number INTEGER GENERATED ALWAYS AS IDENTITY,
    id TEXT NOT NULL,
    version TEXT NOT NULL,
    title TEXT DEFAULT '' NOT NULL,
    state TEXT NOT NULL,
    extent geometry(POLYGON,4326) NOT NULL,
    n_points BIGINT NOT NULL,
    n_views BIGINT NOT NULL,
    metadata JSONB NOT NULL,
    quality JSONB,
    checksum TEXT NOT NULL,
    created_at TIMESTAMP WITH TIME ZONE DEFAULT now() NOT NULL,
    state_changed_at TIMESTAMP WITH TIME ZONE DEFAULT now() NOT NULL,
    priority INTEGER DEFAULT 0 NOT NULL,
    n_unserved BIGINT DEFAULT 0 NOT NULL,
    extent_on_map geometry(GEOMETRY,4326) GENERATED ALWAYS AS (ST_ForcePolygonCCW(ST_WrapX(ST_WrapX(extent, 180, -360), -180, 360))) STORED,
    CONSTRAINT block_pkey PRIMARY KEY (number),
    CONSTRAINT block_id_version_key UNIQUE (id, version),
    CONSTRAINT block_state_check CHECK (state IN ('staged', 'published', 'withdrawn'))
);
CREATE INDEX block_extent ON block USING gist (extent) WHERE state = 'published';
CREATE INDEX block_extent_on_map ON block USING gist (extent_on_map);
CREATE TABLE density_cell (
    id INTEGER NOT NULL,
    level SMALLINT NOT NULL,
    geom geometry(POLYGON,4326) NOT NULL,
    n_points BIGINT NOT NULL,
    n_blocks INTEGER NOT NULL,
    outline_km2 DOUBLE PRECISION NOT NULL,
    cell_km2 DOUBLE PRECISION NOT NULL,
    n_unserved BIGINT DEFAULT 0 NOT NULL,
    CONSTRAINT density_cell_pkey PRIMARY KEY (id),
    CONSTRAINT density_cell_level_check CHECK (level between 0 and 6)
);
CREATE INDEX density_cell_empty ON density_cell (id) WHERE n_blocks = 0;
CREATE INDEX density_cell_geom ON density_cell USING gist (geom);
CREATE TABLE installation (
    single BOOLEAN DEFAULT true NOT NULL,
    page_secret BYTEA NOT NULL,
    CONSTRAINT installation_pkey PRIMARY KEY (single),
    CONSTRAINT installation_single_check CHECK (single)
);
CREATE TABLE point_history (
    point_id BIGINT NOT NULL,
    attempts INTEGER DEFAULT 0 NOT NULL,
    successes INTEGER DEFAULT 0 NOT NULL,
    expected DOUBLE PRECISION DEFAULT 0 NOT NULL,
    matched INTEGER DEFAULT 0 NOT NULL,
    sum_residual_px DOUBLE PRECISION DEFAULT 0 NOT NULL,
    sum_east_m DOUBLE PRECISION DEFAULT 0 NOT NULL,
    sum_north_m DOUBLE PRECISION DEFAULT 0 NOT NULL,
    last_attempt TIMESTAMP WITH TIME ZONE,
    last_success TIMESTAMP WITH TIME ZONE,
    CONSTRAINT point_history_pkey PRIMARY KEY (point_id)
);
CREATE TABLE reference_image (
    id INTEGER GENERATED ALWAYS AS IDENTITY,
    name TEXT NOT NULL,
    image TEXT NOT NULL,
    dem TEXT,
    vertical TEXT,
    geoid TEXT,
    sigma_m REAL,
    gsd_m DOUBLE PRECISION NOT NULL,
    footprint geometry(POLYGON,4326) NOT NULL,
    created_at TIMESTAMP WITH TIME ZONE DEFAULT now() NOT NULL,
    CONSTRAINT reference_image_pkey PRIMARY KEY (id),
    CONSTRAINT reference_image_sigma_m_check CHECK (sigma_m > 0),
    CONSTRAINT reference_image_gsd_m_check CHECK (gsd_m > 0),
    CONSTRAINT reference_image_name_key UNIQUE (name)
);
CREATE TABLE token (
    id UUID NOT NULL,
    name TEXT NOT NULL,
    secret_hash BYTEA,
    scopes TEXT[] NOT NULL,
    created_at TIMESTAMP WITH TIME ZONE DEFAULT now() NOT NULL,
    expires_at TIMESTAMP WITH TIME ZONE,
    revoked_at TIMESTAMP WITH TIME ZONE,
    subject TEXT,
    upload_quota_bytes BIGINT,
    job_quota INTEGER,
    CONSTRAINT token_pkey PRIMARY KEY (id),
    CONSTRAINT token_scopes_check CHECK (scopes <@ array['read', 'register', 'monitor', 'admin'] and scopes <> '{}'),
    CONSTRAINT token_secret_or_subject_check CHECK ((secret_hash is null) <> (subject is null)),
    CONSTRAINT token_upload_quota_bytes_check CHECK (upload_quota_bytes >= 0),
    CONSTRAINT token_job_quota_check CHECK (job_quota >= 0),
    CONSTRAINT token_secret_hash_key UNIQUE (secret_hash),
    CONSTRAINT token_subject_key UNIQUE (subject)
);
CREATE TABLE uptime (
    single BOOLEAN DEFAULT true NOT NULL,
    elapsed_s DOUBLE PRECISION DEFAULT 0 NOT NULL,
    advanced_at TIMESTAMP WITH TIME ZONE DEFAULT now() NOT NULL,
    CONSTRAINT uptime_pkey PRIMARY KEY (single),
    CONSTRAINT uptime_single_check CHECK (single)
);
CREATE TABLE view (
    point_id BIGINT NOT NULL,
    view SMALLINT NOT NULL,
    image INTEGER NOT NULL,
    gsd_m REAL NOT NULL,
    incidence_deg REAL NOT NULL,
    azimuth_deg REAL NOT NULL,
    CONSTRAINT view_pkey PRIMARY KEY (point_id, view)
);
CREATE TABLE view_history (
    point_id BIGINT NOT NULL,
    view SMALLINT NOT NULL,
    attempts INTEGER NOT NULL,
    successes INTEGER NOT NULL,
    expected DOUBLE PRECISION NOT NULL,
    CONSTRAINT view_history_pkey PRIMARY KEY (point_id, view)
);
CREATE TABLE chip_file (
    id INTEGER GENERATED ALWAYS AS IDENTITY,
    block_number INTEGER NOT NULL,
    name TEXT NOT NULL,
    storage_key TEXT NOT NULL,
    dtype TEXT NOT NULL,
    n_chips BIGINT NOT NULL,
    CONSTRAINT chip_file_pkey PRIMARY KEY (id),
    CONSTRAINT chip_file_block_number_name_key UNIQUE (block_number, name),
    CONSTRAINT chip_file_dtype_check CHECK (dtype IN ('uint8', 'uint16')),
    CONSTRAINT chip_file_block_number_fkey FOREIGN KEY(block_number) REFERENCES block (number) ON DELETE CASCADE
);
CREATE INDEX chip_file_key ON chip_file (storage_key);
CREATE TABLE image (
    block_number INTEGER NOT NULL,
    image INTEGER NOT NULL,
    image_id TEXT NOT NULL,
    sensor TEXT NOT NULL,
    acquired_at TIMESTAMP WITH TIME ZONE,
    incidence_deg REAL,
    azimuth_deg REAL,
    sun_elevation_deg REAL,
    sun_azimuth_deg REAL,
    CONSTRAINT image_pkey PRIMARY KEY (block_number, image),
    CONSTRAINT image_block_number_fkey FOREIGN KEY(block_number) REFERENCES block (number) ON DELETE CASCADE
);
CREATE TABLE job (
    id UUID NOT NULL,
    kind TEXT NOT NULL,
    state TEXT NOT NULL,
    progress SMALLINT DEFAULT 0 NOT NULL,
    message TEXT DEFAULT '' NOT NULL,
    inputs JSONB NOT NULL,
    owner UUID,
    attempt INTEGER DEFAULT 0 NOT NULL,
    failures INTEGER DEFAULT 0 NOT NULL,
    lease_until TIMESTAMP WITH TIME ZONE,
    worker TEXT,
    idempotency_key TEXT,
    created_at TIMESTAMP WITH TIME ZONE DEFAULT clock_timestamp() NOT NULL,
    started_at TIMESTAMP WITH TIME ZONE,
    finished_at TIMESTAMP WITH TIME ZONE,
    updated_at TIMESTAMP WITH TIME ZONE DEFAULT now() NOT NULL,
    error JSONB,
    results JSONB,
    outputs JSONB,
    response TEXT DEFAULT 'document' NOT NULL,
    claimed_at TIMESTAMP WITH TIME ZONE,
    results_removed_at TIMESTAMP WITH TIME ZONE,
    CONSTRAINT job_pkey PRIMARY KEY (id),
    CONSTRAINT job_owner_idempotency_key_key UNIQUE (owner, idempotency_key),
    CONSTRAINT job_state_check CHECK (state IN ('accepted', 'running', 'successful', 'failed', 'dismissed')),
    CONSTRAINT job_response_check CHECK (response IN ('document', 'raw')),
    CONSTRAINT job_progress_check CHECK (progress between 0 and 100),
    CONSTRAINT job_owner_fkey FOREIGN KEY(owner) REFERENCES token (id)
);
CREATE INDEX job_finished ON job (kind, finished_at) WHERE state = 'successful';
CREATE INDEX job_lease ON job (lease_until) WHERE state in ('accepted', 'running');
CREATE INDEX job_owner ON job (owner, created_at);
CREATE INDEX job_results ON job (finished_at) WHERE state = 'successful' and results_removed_at is null;
CREATE TABLE reference_point (
    id BIGINT GENERATED ALWAYS AS IDENTITY,
    reference_id INTEGER NOT NULL,
    geom geometry(POINTZ,4979) NOT NULL,
    attempts INTEGER NOT NULL,
    successes INTEGER NOT NULL,
    last_success_at TIMESTAMP WITH TIME ZONE NOT NULL,
    CONSTRAINT reference_point_pkey PRIMARY KEY (id),
    CONSTRAINT reference_point_attempts_check CHECK (attempts > 0),
    CONSTRAINT reference_point_successes_check CHECK (successes between 0 and attempts),
    CONSTRAINT reference_point_reference_id_fkey FOREIGN KEY(reference_id) REFERENCES reference_image (id) ON DELETE CASCADE
);
CREATE INDEX reference_point_geom ON reference_point USING gist (geom);
CREATE INDEX reference_point_reference ON reference_point (reference_id);
CREATE TABLE scene (
    id UUID NOT NULL,
    owner UUID,
    name TEXT NOT NULL,
    state TEXT NOT NULL,
    file_key TEXT,
    file_name TEXT NOT NULL,
    size_bytes BIGINT,
    sha256 TEXT,
    sigma_m REAL,
    footprint geometry(POLYGON,4326),
    created_at TIMESTAMP WITH TIME ZONE DEFAULT now() NOT NULL,
    removed_at TIMESTAMP WITH TIME ZONE,
    models JSONB DEFAULT '{}' NOT NULL,
    reference TEXT,
    acquired_at TIMESTAMP WITH TIME ZONE,
    sensor TEXT,
    gsd_m REAL,
    incidence_deg REAL,
    azimuth_deg REAL,
    sun_elevation_deg REAL,
    sun_azimuth_deg REAL,
    lines INTEGER,
    samples INTEGER,
    created_at_uptime_s DOUBLE PRECISION DEFAULT uptime_s() NOT NULL,
    footprint_on_map geometry(GEOMETRY,4326) GENERATED ALWAYS AS (ST_ForcePolygonCCW(ST_WrapX(ST_WrapX(footprint, 180, -360), -180, 360))) STORED,
    CONSTRAINT scene_pkey PRIMARY KEY (id),
    CONSTRAINT scene_state_check CHECK (state IN ('uploading', 'uploaded', 'removed')),
    CONSTRAINT scene_sigma_m_check CHECK (sigma_m > 0),
    CONSTRAINT scene_owner_fkey FOREIGN KEY(owner) REFERENCES token (id)
);
CREATE INDEX scene_footprint_on_map ON scene USING gist (footprint_on_map);
CREATE INDEX scene_owner ON scene (owner, created_at);
CREATE TABLE job_message (
    id BIGINT GENERATED ALWAYS AS IDENTITY,
    job_id UUID NOT NULL,
    attempt INTEGER NOT NULL,
    progress SMALLINT NOT NULL,
    message TEXT NOT NULL,
    written_at TIMESTAMP WITH TIME ZONE DEFAULT clock_timestamp() NOT NULL,
    CONSTRAINT job_message_pkey PRIMARY KEY (id),
    CONSTRAINT job_message_job_id_fkey FOREIGN KEY(job_id) REFERENCES job (id) ON DELETE CASCADE
);
CREATE INDEX job_message_job ON job_message (job_id, id);
CREATE TABLE point (
    id BIGINT NOT NULL,
    block_number INTEGER NOT NULL,
    geom geometry(POINTZ,4979) NOT NULL,
    sigma_east_m REAL NOT NULL,
    sigma_north_m REAL NOT NULL,
    sigma_up_m REAL NOT NULL,
    corr_east_north REAL NOT NULL,
    corr_east_up REAL NOT NULL,
    corr_north_up REAL NOT NULL,
    n_views SMALLINT NOT NULL,
    saliency REAL NOT NULL,
    typology TEXT,
    first_view DATE,
    last_view DATE,
    chip_file INTEGER NOT NULL,
    chip_row BIGINT NOT NULL,
    chip_count SMALLINT NOT NULL,
    superseded_by BIGINT,
    suspended_at TIMESTAMP WITH TIME ZONE,
    suspended_because TEXT,
    CONSTRAINT point_pkey PRIMARY KEY (id),
    CONSTRAINT point_id_in_block_check CHECK (id >> 26 = block_number),
    CONSTRAINT point_sigma_east_m_check CHECK (sigma_east_m > 0 and sigma_east_m < 'infinity'),
    CONSTRAINT point_sigma_north_m_check CHECK (sigma_north_m > 0 and sigma_north_m < 'infinity'),
    CONSTRAINT point_sigma_up_m_check CHECK (sigma_up_m > 0 and sigma_up_m < 'infinity'),
    CONSTRAINT point_corr_east_north_check CHECK (corr_east_north between -1 and 1),
    CONSTRAINT point_corr_east_up_check CHECK (corr_east_up between -1 and 1),
    CONSTRAINT point_corr_north_up_check CHECK (corr_north_up between -1 and 1),
    CONSTRAINT point_saliency_check CHECK (saliency between 0 and 1),
    CONSTRAINT point_block_number_fkey FOREIGN KEY(block_number) REFERENCES block (number) ON DELETE CASCADE,
    CONSTRAINT point_chip_file_fkey FOREIGN KEY(chip_file) REFERENCES chip_file (id)
);
CREATE INDEX point_geom ON point USING gist (geom);
CREATE INDEX point_superseded ON point (id) WHERE superseded_by is not null;
CREATE INDEX point_superseded_by ON point (superseded_by) WHERE superseded_by is not null;
CREATE INDEX point_suspended ON point (id) WHERE suspended_at is not null;
CREATE TABLE registration (
    id UUID NOT NULL,
    job_id UUID,
    scene_id UUID,
    block_versions JSONB NOT NULL,
    options JSONB NOT NULL,
    report JSONB NOT NULL,
    verdict TEXT NOT NULL,
    files JSONB NOT NULL,
    created_at TIMESTAMP WITH TIME ZONE DEFAULT now() NOT NULL,
    scene_key TEXT,
    counted BOOLEAN DEFAULT false NOT NULL,
    CONSTRAINT registration_pkey PRIMARY KEY (id),
    CONSTRAINT registration_job_id_key UNIQUE (job_id),
    CONSTRAINT registration_job_id_fkey FOREIGN KEY(job_id) REFERENCES job (id),
    CONSTRAINT registration_scene_id_fkey FOREIGN KEY(scene_id) REFERENCES scene (id)
);
CREATE UNIQUE INDEX registration_counted ON registration (scene_key) WHERE counted;
CREATE INDEX registration_scene ON registration (scene_id);
CREATE TABLE upload (
    id UUID NOT NULL,
    owner UUID,
    purpose TEXT NOT NULL,
    scene_id UUID,
    name TEXT NOT NULL,
    file_name TEXT NOT NULL,
    size_bytes BIGINT NOT NULL,
    sha256 TEXT,
    metadata TEXT DEFAULT '' NOT NULL,
    file_key TEXT,
    created_at TIMESTAMP WITH TIME ZONE DEFAULT now() NOT NULL,
    expires_at TIMESTAMP WITH TIME ZONE NOT NULL,
    finished_at TIMESTAMP WITH TIME ZONE,
    active_at_uptime_s DOUBLE PRECISION DEFAULT uptime_s() NOT NULL,
    CONSTRAINT upload_pkey PRIMARY KEY (id),
    CONSTRAINT upload_purpose_check CHECK (purpose IN ('image', 'model', 'block')),
    CONSTRAINT upload_size_bytes_check CHECK (size_bytes > 0),
    CONSTRAINT upload_scene_id_check CHECK (purpose = 'block' or scene_id is not null),
    CONSTRAINT upload_owner_fkey FOREIGN KEY(owner) REFERENCES token (id),
    CONSTRAINT upload_scene_id_fkey FOREIGN KEY(scene_id) REFERENCES scene (id) ON DELETE CASCADE
);
CREATE INDEX upload_expiry ON upload (expires_at) WHERE finished_at is null;
CREATE TABLE measure (
    registration_id UUID NOT NULL,
    point_id BIGINT NOT NULL,
    matched BOOLEAN NOT NULL,
    active BOOLEAN NOT NULL,
    reason TEXT NOT NULL,
    score REAL,
    line DOUBLE PRECISION,
    sample DOUBLE PRECISION,
    sigma_px REAL,
    residual_line_px REAL,
    residual_sample_px REAL,
    residual_east_m REAL,
    residual_north_m REAL,
    CONSTRAINT measure_pkey PRIMARY KEY (registration_id, point_id),
    CONSTRAINT measure_registration_id_fkey FOREIGN KEY(registration_id) REFERENCES registration (id) ON DELETE CASCADE
);
CREATE TABLE view_measure (
    registration_id UUID NOT NULL,
    point_id BIGINT NOT NULL,
    view SMALLINT NOT NULL,
    agreed BOOLEAN NOT NULL,
    reason TEXT NOT NULL,
    score REAL,
    CONSTRAINT view_measure_pkey PRIMARY KEY (registration_id, point_id, view),
    CONSTRAINT view_measure_registration_id_fkey FOREIGN KEY(registration_id) REFERENCES registration (id) ON DELETE CASCADE
);

-- Triggers of the store; they come after the tables.

-- The audit: columns whose changes are recorded. A progress or a lease is none of them.
create trigger audit_only_grows before update or delete or truncate on audit
    for each statement execute function refuse_change();
create trigger token_changes after insert or update or delete on token
    for each row execute function record_change(
        'name', 'scopes', 'subject', 'expires_at', 'revoked_at', 'upload_quota_bytes', 'job_quota');
create trigger block_changes after insert or update or delete on block
    for each row execute function record_change(
        'number', 'state', 'priority', 'checksum', 'n_points', 'n_views');
create trigger scene_changes after insert or update or delete on scene
    for each row execute function record_change('name', 'state', 'owner', 'sha256');
create trigger job_changes after insert or update or delete on job
    for each row execute function record_change(
        'kind', 'state', 'owner', 'inputs', 'error', 'results_removed_at');
create trigger point_changes after update of suspended_at on point
    for each row execute function record_change('suspended_at', 'suspended_because');
create trigger reference_image_changes after insert or update or delete on reference_image
    for each row execute function record_change(
        'name', 'image', 'dem', 'vertical', 'geoid', 'sigma_m');

-- Density cells and the messages of jobs follow the rows they come from.
create trigger keep_density after insert or delete or update of state on block
    for each row execute function keep_density();
create trigger job_messages after insert or update of message, attempt on job
    for each row execute function keep_job_message();

-- Rows that every store has.

-- 256 random bits, in terms of what PostgreSQL has without an extension.
insert into installation (page_secret) select sha256(decode(replace(
    gen_random_uuid()::text || gen_random_uuid()::text || gen_random_uuid()::text, '-', ''), 'hex'));
insert into uptime default values;
