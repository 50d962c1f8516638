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

-- Add a row to `audit`. Settings of the transaction name who makes the change and why
-- (`app/db/engine.py`); the change of a job is a change of the owner of the job.
create function add_audit_row(kind text, subject text, action text, before jsonb, after jsonb)
returns void language sql as $$
    with origin as (
        select nullif(current_setting('amers.actor', true), '')::uuid as actor,
            nullif(current_setting('amers.job_id', true), '')::uuid as job_id
    )
    insert into audit (actor, actor_name, request_id, job_id, kind, subject, action, before, after)
    select coalesce(actor, (select owner from job where id = origin.job_id)),
        coalesce(
            nullif(current_setting('amers.actor_name', true), ''), 'database role ' || session_user),
        nullif(current_setting('amers.request_id', true), ''),
        job_id, kind, subject, action, before, after
    from origin
$$;

-- Trigger with column names as arguments: a row in `audit` when one of these columns changes.
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
    perform add_audit_row(
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

-- Trigger of `audit` after a deletion: accept the oldest rows without a gap, if the service has run for 30
-- days since the last of them, and leave a row that says which rows were removed. Refuse anything else.
create function record_audit_removal() returns trigger language plpgsql as $$
declare
    gone record;
begin
    select count(*) as rows, min(id) as first, max(id) as last, min(at) as since, max(at) as until,
        max(at_uptime_s) as until_uptime_s into gone from removed;
    if gone.rows = 0 then return null; end if;
    if gone.until > now() - interval '30 days' or gone.until_uptime_s > uptime_s() - 30 * 86400
        or exists (select from audit where id < gone.last)
    then
        raise exception 'table audit only grows: only its oldest rows can be removed, 30 days after them'
            using errcode = 'insufficient_privilege';
    end if;
    perform add_audit_row('audit', gone.first || '-' || gone.last, 'deleted',
        jsonb_build_object('rows', gone.rows, 'since', gone.since, 'until', gone.until), null);
    return null;
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
