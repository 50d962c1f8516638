"""The schema: a database made by the migrations is the same as one made from `app/db/schema`."""

from collections.abc import Iterator

import psycopg
import pytest
from sqlalchemy import create_engine
from sqlalchemy.pool import NullPool

from amers.app.db.cluster.embedded import Cluster
from amers.app.db.ddl import EXTENSION
from amers.app.db.schema import metadata
from amers.app.db.sql_files import sql_file
from tests.app.conftest import EMPTY_TEMPLATE, TEMPLATE, fresh_database

# Everything that the catalogues record of the store: (what, name, definition). Objects of extensions, of
# the queue and of Alembic are left out.
CATALOGUE = """
with ours as (
    select c.* from pg_class c
    where relnamespace = 'public'::regnamespace and relname not like 'procrastinate%'
        and relname not like 'alembic%'
        and not exists (select from pg_depend d where d.classid = 'pg_class'::regclass
                        and d.objid = c.oid and d.deptype = 'e')
), grantee as (
    select 'public'::text as role, 0::oid as oid union all select rolname, oid from pg_roles
), place as (
    select attrelid, attnum, row_number() over (partition by attrelid order by attnum) as n
    from pg_attribute where attnum > 0 and not attisdropped
)
select case relkind when 'r' then 'table' when 'S' then 'sequence' else 'relation' end,
    relname, concat_ws(' ', relkind, relpersistence, relrowsecurity, relreplident, reloptions,
                       pg_get_userbyid(relowner), case relkind when 'v' then pg_get_viewdef(oid) end)
from ours where relkind <> 'i'
union all
select 'column', relname || '.' || attname, concat_ws(' ', n, format_type(atttypid, atttypmod),
    'not null', attnotnull, 'identity', attidentity, 'generated', attgenerated,
    'default', pg_get_expr(adbin, adrelid), 'collation', attcollation,
    'storage', attstorage, 'statistics', attstattarget, 'grants', attacl::text,
    'comment', col_description(attrelid, attnum))
from ours join pg_attribute on attrelid = ours.oid join place using (attrelid, attnum)
    left join pg_attrdef on adrelid = attrelid and adnum = attnum
where relkind = 'r'
union all
select 'identity', relname, concat_ws(' ', format_type(seqtypid, null), seqstart, seqincrement, seqmin,
    seqmax, seqcache, seqcycle)
from ours join pg_sequence on seqrelid = ours.oid
union all
select 'constraint', relname || '.' || conname, concat_ws(' ', contype, pg_get_constraintdef(con.oid),
    condeferrable, condeferred, convalidated)
from ours join pg_constraint con on conrelid = ours.oid
union all
select 'index', i.relname, concat_ws(' ', pg_get_indexdef(i.oid), indisunique, indisprimary, indisvalid,
    i.reloptions)
from ours join pg_index on indrelid = ours.oid join pg_class i on i.oid = indexrelid
union all
select 'trigger', relname || '.' || tgname, concat_ws(' ', pg_get_triggerdef(t.oid), tgenabled)
from ours join pg_trigger t on tgrelid = ours.oid where not tgisinternal
union all
select 'rule', relname || '.' || rulename, pg_get_ruledef(r.oid)
from ours join pg_rewrite r on ev_class = ours.oid
union all
select 'policy', relname || '.' || polname, concat_ws(' ', polcmd, pg_get_expr(polqual, polrelid))
from ours join pg_policy on polrelid = ours.oid
union all
select 'function', p.oid::regprocedure::text, concat_ws(' ', pg_get_functiondef(p.oid), proacl::text)
from pg_proc p
where pronamespace = 'public'::regnamespace and proname not like 'procrastinate%'
    and not exists (select from pg_depend d where d.classid = 'pg_proc'::regclass
                    and d.objid = p.oid and d.deptype = 'e')
union all
select 'type', typname, concat_ws(' ', typtype, typbasetype, typdefault)
from pg_type t
where typnamespace = 'public'::regnamespace and typtype in ('d', 'e', 'r')
    and typname not like 'procrastinate%'
    and not exists (select from pg_depend d where d.classid = 'pg_type'::regclass
                    and d.objid = t.oid and d.deptype = 'e')
union all
select 'grant', relname || ' to ' || role,
    string_agg(privilege_type || is_grantable, ' ' order by privilege_type)
from ours, aclexplode(relacl) acl join grantee on grantee.oid = acl.grantee
where relkind <> 'i' group by relname, role
union all
select 'default grant', concat_ws(' ', defaclobjtype, 'of', pg_get_userbyid(defaclrole)), defaclacl::text
from pg_default_acl
union all
select 'grant', 'schema public to ' || role, string_agg(privilege_type, ' ' order by privilege_type)
from pg_namespace, aclexplode(nspacl) acl join grantee on grantee.oid = acl.grantee
where nspname = 'public' group by role
union all
select 'extension', extname, extversion from pg_extension
union all
select 'first rows', 'installation', count(*)::text from installation
union all
select 'first rows', 'uptime', count(*)::text from uptime
"""

# One change of each sort on one side, and the one thing that the comparison has to report.
CHANGES = {
    "alter table block add column surplus int": "column block.surplus",
    "alter table view_measure drop column score": "column view_measure.score",
    "alter table chip_file rename column dtype to data_type": "column chip_file.data_type",
    "alter table view alter column gsd_m type double precision": "column view.gsd_m",
    "alter table reference_image alter column footprint type geometry(Polygon, 4326)"
    " using footprint, alter column footprint type geometry(Geometry, 4326)": (
        "column reference_image.footprint"
    ),
    "alter table reference_point alter column geom type geometry(PointZ, 4326)"
    " using st_setsrid(geom, 4326)": "column reference_point.geom",
    "alter table block alter column title drop not null": "column block.title",
    "alter table job alter column failures set default 1": "column job.failures",
    "alter table job alter column created_at set default now()": "column job.created_at",
    "alter table audit alter column id set generated by default": "column audit.id",
    "alter table audit alter column id set increment 2": "identity audit_id_seq",
    "alter table block alter column outline_on_map drop expression": "column block.outline_on_map",
    "alter table point drop constraint point_saliency_check": "constraint point.point_saliency_check",
    "alter table point drop constraint point_saliency_check, add constraint point_saliency_check"
    " check (saliency between 0 and 2)": "constraint point.point_saliency_check",
    "alter table block drop constraint block_id_version_key": "constraint block.block_id_version_key",
    "alter table image drop constraint image_block_number_fkey, add constraint"
    " image_block_number_fkey foreign key (block_number) references block": (
        "constraint image.image_block_number_fkey"
    ),
    "drop index point_geom": "index point_geom",
    "drop index job_finished; create index job_finished on job (kind, finished_at)": (
        "index job_finished"
    ),
    "drop index block_outline_on_map; create index block_outline_on_map on block"
    " using spgist (outline_on_map)": "index block_outline_on_map",
    "drop index chip_file_key; create index chip_file_key on chip_file (lower(storage_key))": (
        "index chip_file_key"
    ),
    "drop index registration_counted; create index registration_counted on registration (scene_key)"
    " where counted": "index registration_counted",
    "create index surplus on view (image)": "index surplus",
    "drop trigger job_messages on job": "trigger job.job_messages",
    "alter table audit disable trigger audit_only_grows": "trigger audit.audit_only_grows",
    "drop trigger scene_changes on scene; create trigger scene_changes after insert or update or delete"
    " on scene for each row execute function record_change('name')": "trigger scene.scene_changes",
    "create or replace function uptime_s() returns double precision language sql stable as"
    " $$ select elapsed_s + 1 from uptime $$": "function uptime_s()",
    "drop function count_unserved_cells": "function count_unserved_cells()",
    "alter function zone_km2 volatile": "function zone_km2(double precision)",
    "revoke select on block from amers_reader": "grant block to amers_reader",
    "grant insert on token to amers_reader": "grant token to amers_reader",
    "alter default privileges in schema public revoke select on tables from amers_reader": (
        "default grant r of amers_app"
    ),
    "create table surplus (id int)": "table surplus",
    "alter table point enable row level security": "table point",
    "delete from uptime": "first rows uptime",
}

Catalogue = dict[str, str]


def catalogue(connection: psycopg.Connection) -> Catalogue:
    rows = connection.execute(CATALOGUE).fetchall()
    entries = {f"{what} {name}": definition for what, name, definition in rows}
    assert len(entries) == len(rows)
    return entries


def differences(one: Catalogue, other: Catalogue) -> dict[str, tuple[str | None, str | None]]:
    """What the catalogues do not agree on, by name, with both definitions."""
    return {
        name: (one.get(name), other.get(name))
        for name in sorted(one.keys() | other.keys())
        if one.get(name) != other.get(name)
    }


@pytest.fixture(scope="module")
def from_schema(cluster: Cluster) -> Iterator[Catalogue]:
    """The catalogue of a database that SQLAlchemy made from the schema, with the SQL files."""
    with fresh_database(cluster, EMPTY_TEMPLATE) as dsn:
        engine = create_engine(
            "postgresql+psycopg://", creator=lambda: psycopg.connect(dsn), poolclass=NullPool
        )
        with engine.begin() as connection:
            driver = connection.connection.driver_connection
            assert driver is not None
            driver.execute(EXTENSION + sql_file("functions.sql"))
            metadata.create_all(connection)
            for name in ("triggers.sql", "first_rows.sql", "grants.sql"):
                driver.execute(sql_file(name))
        with psycopg.connect(dsn) as connection:
            yield catalogue(connection)


@pytest.fixture(scope="module")
def migrated(cluster: Cluster) -> Iterator[psycopg.Connection]:
    """A connection to a database made by the migrations."""
    with fresh_database(cluster, TEMPLATE) as dsn, psycopg.connect(dsn) as connection:
        yield connection


def test_the_migrations_make_what_the_schema_describes(migrated, from_schema):
    assert differences(catalogue(migrated), from_schema) == {}


def test_every_table_of_the_schema_is_compared(from_schema):
    assert {name.removeprefix("table ") for name in from_schema if name.startswith("table ")} == {
        *metadata.tables
    }
    columns = {f"column {column}" for table in metadata.tables.values() for column in table.columns}
    assert columns == {name for name in from_schema if name.startswith("column ")}
    sorts = {name.split(" ")[0] for name in from_schema}
    assert sorts >= {"constraint", "index", "trigger", "function", "grant", "identity", "extension"}


@pytest.mark.parametrize(("change", "reported"), CHANGES.items(), ids=list(CHANGES))
def test_a_change_on_one_side_is_reported_by_name(change, reported, migrated, from_schema):
    with migrated.transaction(force_rollback=True):
        migrated.execute(change)
        assert reported in differences(catalogue(migrated), from_schema)
