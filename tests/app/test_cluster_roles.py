"""The role that commands connect with to the private cluster, and how it takes over older clusters."""

import gzip
from pathlib import Path
from typing import Any
from uuid import uuid4

import psycopg
import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine, revisions
from amers.app.db.cluster import embedded
from amers.app.db.cluster.embedded import CREATE_DATABASE, DATABASE, ROLE, SUPERUSER, Cluster
from amers.app.db.sql_files import sql_file
from amers.app.errors import InputError
from amers.app.main import create_app
from amers.app.usecases.tokens import create_token
from tests.app.test_schema import catalogue, differences

OLD_DUMP = Path(__file__).parents[1] / "golden" / "releases" / "0002.sql.gz"
FORBIDDEN = (
    "create role intruder",
    "create database intruder",
    f"alter role {ROLE} superuser",
    f"grant {SUPERUSER} to {ROLE}",
    f"set role {SUPERUSER}",
    f"set session authorization {SUPERUSER}",
    "alter system set fsync = off",
    "set session_replication_role = replica",
    "select pg_read_file('/etc/passwd')",
    "select pg_ls_dir('/')",
    "select lo_import('/etc/passwd')",
    "create temporary table line (t text); copy line from '/etc/passwd'",
    "create temporary table line (t text); copy line from program 'id'",
    "copy (select 1) to '/tmp/amers-intruder'",
    "copy (select 1) to program 'true'",
    "load '/usr/lib/intruder.so'",
    "create function getpid() returns int language c as 'libc.so.6', 'getpid'",
    "create function plus() returns int language internal as 'int4pl'",
    "update pg_authid set rolsuper = true",
)
# Indexes, rows and arrays have the owner of their table or type.
OWNERS = """
with ours as (
    select 'pg_class'::regclass as catalogue, oid, relowner as owner from pg_class
    where relnamespace = 'public'::regnamespace and relkind not in ('i', 'c')
    union all
    select 'pg_proc'::regclass, oid, proowner from pg_proc
    where pronamespace = 'public'::regnamespace
    union all
    select 'pg_type'::regclass, t.oid, typowner from pg_type t left join pg_class c on c.oid = typrelid
    where typnamespace = 'public'::regnamespace and (typtype in ('d', 'e', 'r') or relkind = 'c')
)
select distinct catalogue::text, pg_get_userbyid(owner)::text from ours
where not exists (select from pg_depend where classid = catalogue and objid = ours.oid and deptype = 'e')
"""
# A row that a start writes again gets another transaction number.
WRITTEN = """
select 'pg_class', oid, xmin::text from pg_class where relnamespace = 'public'::regnamespace
union all select 'pg_proc', oid, xmin::text from pg_proc where pronamespace = 'public'::regnamespace
union all select 'pg_database', oid, xmin::text from pg_database
union all select 'pg_authid', oid, xmin::text from pg_authid
union all select 'pg_auth_members', roleid, xmin::text from pg_auth_members
union all select 'pg_default_acl', oid, xmin::text from pg_default_acl
order by 1, 2
"""


def rows(dsn: str, statement: str) -> list[tuple[Any, ...]]:
    with psycopg.connect(dsn) as connection:
        return connection.execute(statement.encode()).fetchall()


def owners(dsn: str) -> set[tuple[Any, ...]]:
    """Who owns what in schema public that belongs to no extension: (catalogue, role)."""
    return set(rows(dsn, OWNERS))


def make_older(cluster: Cluster) -> None:
    """Leave a cluster in use as Amers left it before it had a role: a superuser owns and does all."""
    with psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as connection:
        connection.execute("drop database amers")
        connection.execute("drop role amers_app, amers_reader")
        connection.execute(CREATE_DATABASE)
    with psycopg.connect(cluster.dsn(DATABASE, SUPERUSER)) as connection:
        connection.execute(gzip.decompress(OLD_DUMP.read_bytes()))
    with psycopg.connect(cluster.dsn(DATABASE, SUPERUSER)) as connection:
        connection.execute(sql_file("grants.sql").encode())
    admit_superuser_only(cluster)


def admit_superuser_only(cluster: Cluster) -> None:
    """Let a running server admit whom it admits when an Amers without roles has started it."""
    people = cluster.data / "pg_ident.conf"
    lines = people.read_text().splitlines(keepends=True)
    people.write_text("".join(line for line in lines if ROLE not in line))
    with psycopg.connect(cluster.dsn("postgres", SUPERUSER)) as connection:
        connection.execute("select pg_reload_conf()")
    with pytest.raises(psycopg.OperationalError, match="Peer authentication"):
        psycopg.connect(cluster.dsn(DATABASE))


def test_the_role_of_commands_has_no_power_beyond_its_database(dsn: str):
    ((*powers,),) = rows(
        dsn,
        "select rolsuper, rolcreaterole, rolcreatedb, rolreplication, rolbypassrls from pg_roles"
        " where rolname = current_user",
    )
    assert powers == [False] * 5
    memberships = rows(
        dsn, "select rolname from pg_roles where pg_has_role(current_user, oid, 'member')"
    )
    assert {role for (role,) in memberships} == {ROLE, "amers_reader", "pg_database_owner"}


@pytest.mark.parametrize("statement", FORBIDDEN)
def test_the_role_of_commands_cannot_leave_its_database(statement: str, dsn: str):
    with (
        psycopg.connect(dsn, autocommit=True) as connection,
        pytest.raises(psycopg.errors.InsufficientPrivilege),
    ):
        connection.execute(statement.encode())


def test_the_role_of_commands_owns_all_of_the_store(dsn: str):
    assert owners(dsn) == {(name, ROLE) for name in ("pg_class", "pg_proc", "pg_type")}


@pytest.mark.thorough
@pytest.mark.parametrize("state", ["running", "stopped"])
def test_an_older_cluster_is_taken_over_once_and_serves_its_points(
    state: str, open_folder: Path, tmp_path: Path, dsn: str
):
    cluster = Cluster(open_folder / uuid4().hex[:8], durable=False)
    with cluster.lease():
        make_older(cluster)
        assert owners(cluster.dsn(DATABASE, SUPERUSER)) == {
            (name, SUPERUSER) for name in ("pg_class", "pg_proc", "pg_type")
        }
        if state == "running":
            check_taken_over(cluster, tmp_path, dsn)
    if state == "stopped":
        check_taken_over(cluster, tmp_path, dsn)


def check_taken_over(cluster: Cluster, folder: Path, new: str) -> None:
    with cluster.lease() as dsn:
        assert rows(dsn, "select current_user::text") == [(ROLE,)]
        assert owners(dsn) == {(name, ROLE) for name in ("pg_class", "pg_proc", "pg_type")}
        assert revisions.status(dsn).found == "0002"
        settings = Settings(database_url=dsn, data_folder=folder)
        revisions.upgrade(dsn)
        with psycopg.connect(dsn) as found, psycopg.connect(new) as expected:
            assert differences(catalogue(found), catalogue(expected)) == {}
        with engine.connect(dsn) as connection:
            secret = create_token(connection, "reader", ["read"]).secret
        with TestClient(create_app(settings)) as client:
            page = client.get(
                "/collections/points/items?limit=100", headers={"Authorization": f"Bearer {secret}"}
            )
        assert len(page.json()["features"]) == 11, page.text
        written = rows(cluster.dsn(DATABASE, SUPERUSER), WRITTEN)
        people = (cluster.data / "pg_ident.conf").stat().st_mtime_ns
        with cluster.lease() as again:
            assert again == dsn
        assert rows(cluster.dsn(DATABASE, SUPERUSER), WRITTEN) == written
        assert (cluster.data / "pg_ident.conf").stat().st_mtime_ns == people
    with cluster.lease():
        assert rows(cluster.dsn(DATABASE, SUPERUSER), WRITTEN) == written


@pytest.mark.thorough
def test_a_takeover_is_whole_or_refused_and_a_server_of_a_former_amers_admits_the_role(
    open_folder: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(embedded, "LOCK_SECONDS", 0.2)
    cluster = Cluster(open_folder / uuid4().hex[:8], durable=False)
    with cluster.lease():
        make_older(cluster)
        superuser = cluster.dsn(DATABASE, SUPERUSER)
        with psycopg.connect(superuser) as former:
            former.execute("select count(*) from point")
            with (
                pytest.raises(InputError, match="a command of a former Amers uses them"),
                cluster.lease(),
            ):
                pass
        assert {owner for _, owner in owners(superuser)} == {SUPERUSER}
        with cluster.lease() as dsn:
            assert {owner for _, owner in owners(dsn)} == {ROLE}
        admit_superuser_only(cluster)
        with cluster.lease() as dsn:
            assert rows(dsn, "select count(*) from point") != [(0,)]
