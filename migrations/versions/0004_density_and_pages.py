"""Density cells of what is published, kept as blocks come and go; a secret that signs pages.

Counting points cell by cell takes seconds where there are millions, and a map asks for the world at
once: the counts are kept in cells of 0.1 degree and in six coarser levels, from the quality figures of
the blocks.
"""

from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None

DENSITY_CELL = """
create table density_cell (
    id int primary key,
    level smallint not null check (level between 0 and 6),
    geom geometry(Polygon, 4326) not null,
    n_points bigint not null,
    n_blocks int not null,
    outline_km2 double precision not null,
    cell_km2 double precision not null
)
"""

# Area on the WGS 84 ellipsoid from the equator to a latitude, for a degree of longitude.
# Source: Snyder (1987), Map projections: a working manual, equation 3-12.
ZONE = """
create function zone_km2(lat_deg double precision) returns double precision
language sql immutable strict parallel safe as $$
    select 6356.752314245 ^ 2 / 2 * radians(1) * (
        sin(radians(lat_deg)) / (1 - 0.00669437999014 * sin(radians(lat_deg)) ^ 2)
        + atanh(0.0818191908426215 * sin(radians(lat_deg))) / 0.0818191908426215)
$$
"""

# A cell of level k is 0.1 * 2^k degrees wide; columns count from 180 W, rows from the south pole.
# Rows are changed in the order of their keys, so that two publications wait and never deadlock.
ADD_DENSITY = """
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
    select id, level, st_makeenvelope(west, south, east, north, 4326), sign * n, sign, sign * km2,
        (zone_km2(north) - zone_km2(south)) * (east - west)::float8
    from placed order by id
    on conflict (id) do update set n_points = d.n_points + excluded.n_points,
        n_blocks = d.n_blocks + excluded.n_blocks, outline_km2 = d.outline_km2 + excluded.outline_km2
$$
"""

KEEP_DENSITY = """
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
end $$
"""

TRIGGER = """
create trigger keep_density after insert or delete or update of state on block
    for each row execute function keep_density()
"""

INSTALLATION = """
create table installation (
    one boolean primary key default true check (one),
    page_secret bytea not null
)
"""

SECRET = """
insert into installation (page_secret) select sha256(decode(replace(
    gen_random_uuid()::text || gen_random_uuid()::text || gen_random_uuid()::text, '-', ''), 'hex'))
"""

UP = (
    DENSITY_CELL,
    "create index density_cell_geom on density_cell using gist (geom)",
    "create index density_cell_empty on density_cell (id) where n_blocks = 0",
    ZONE,
    ADD_DENSITY,
    KEEP_DENSITY,
    "select add_density(quality, 1) from block where state = 'published' and quality is not null",
    TRIGGER,
    INSTALLATION,
    SECRET,
)
DOWN = (
    "drop trigger keep_density on block",
    "drop function keep_density()",
    "drop function add_density(jsonb, int)",
    "drop function zone_km2(double precision)",
    "drop table density_cell",
    "drop table installation",
)


def upgrade() -> None:
    for statement in UP:
        op.execute(statement)


def downgrade() -> None:
    for statement in DOWN:
        op.execute(statement)
