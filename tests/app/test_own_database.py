"""A database of the operator's own: an ordinary role backs up, restores and upgrades it."""

import os
import shutil
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import psycopg
import pytest
from psycopg.conninfo import conninfo_to_dict

from amers.app.config import Settings
from amers.app.db import engine, revisions
from amers.app.db.cluster import backup as archive
from amers.app.db.cluster import programs
from amers.app.errors import Conflict, InputError
from amers.app.storage import Storage
from amers.app.usecases import storage_identity
from amers.app.usecases.backups.make import make_backup
from amers.app.usecases.backups.manifest import ARCHIVE
from amers.app.usecases.backups.restore import restore_backup
from amers.app.usecases.installation import Installation
from tests.app.full_storage import Full, contents, run_service
from tests.app.operators_server import PASSWORD, OperatorsServer, running_server
from tests.app.test_schema import catalogue, differences
from tests.command_line import Done, amers_here
from tests.run_folders import place_of_databases, run_folder

pytestmark = [pytest.mark.database, pytest.mark.long]

SERVERS_OWN = ("--format=custom", "--no-owner", "--no-privileges")
"""Options with which former versions made their archives: with everything that the role can read."""


@pytest.fixture(scope="module")
def server() -> Iterator[OperatorsServer]:
    with run_folder(place_of_databases()) as folder, running_server(folder) as server:
        yield server


@pytest.fixture(scope="module")
def kept(server: OperatorsServer, tmp_path_factory: pytest.TempPathFactory) -> Full:
    """An installation on a database of an ordinary role, with files of every family."""
    folder = tmp_path_factory.mktemp("kept")
    dsn = server.make_database()
    revisions.upgrade(dsn)
    settings = Settings(database_url=dsn, data_folder=folder / "data")
    run_service(settings, folder, 1)
    files = contents(Storage(settings.data_folder / "storage"))
    return Full(dsn, settings, {key: file for key, file in files.items() if "/" in key})


@pytest.fixture(scope="module")
def backup(kept: Full, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("backups") / "monday"
    back_up(kept, folder)
    return folder


def back_up(kept: Full, folder: Path) -> None:
    storage = Storage(kept.settings.data_folder / "storage")
    with engine.opened(kept.settings) as database:
        make_backup(Installation(database, storage, kept.settings), folder)


def database_of(dsn: str) -> str:
    return str(conninfo_to_dict(dsn)["dbname"])


def role_of(dsn: str) -> str:
    return str(conninfo_to_dict(dsn)["user"])


def amers(dsn: str, folder: Path, *words: str | Path) -> Done:
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("AMERS_")}
    settings = {"AMERS_DATABASE_URL": dsn, "AMERS_DATA_FOLDER": str(folder)}
    return amers_here(words, inherited | settings)


def of_an_owner(connection: psycopg.Connection[tuple[Any, ...]]) -> dict[str, str]:
    """The catalogue of a database, whoever owns it."""
    role = connection.info.user
    return {name: str(what).replace(role, "owner") for name, what in catalogue(connection).items()}


def assert_same_rows(server: OperatorsServer, one: str, other: str) -> None:
    tables = "select relname from pg_class where relnamespace = 'public'::regnamespace and relkind = 'r'"
    owned = f"{tables} and relname not in ('spatial_ref_sys', 'uptime') order by 1"
    names = [name for (name,) in server.rows(one, owned)]
    assert [name for (name,) in server.rows(other, owned)] == names
    assert len(names) > 20
    for name in names:
        rows = f"select (to_jsonb(t) - 'storage_generation')::text from public.{name} t"
        assert sorted(server.rows(one, rows)) == sorted(server.rows(other, rows)), name


def test_an_ordinary_role_restores_what_it_backed_up_under_another_name_and_owner(
    server: OperatorsServer, kept: Full, backup: Path, tmp_path: Path
):
    dsn = server.make_database()
    assert database_of(dsn) != database_of(kept.dsn)
    assert role_of(dsn) != role_of(kept.dsn)
    restored = amers(dsn, tmp_path / "data", "db", "restore", backup, "--json")
    assert restored.returncode == 0, restored.stderr
    assert_same_rows(server, kept.dsn, dsn)
    ((owners,),) = server.rows(
        dsn,
        "select array_agg(distinct pg_get_userbyid(relowner)::text) from pg_class where relkind = 'r'"
        " and relnamespace = 'public'::regnamespace and relname <> 'spatial_ref_sys'",
    )
    assert owners == [role_of(dsn)]
    storage = Storage(tmp_path / "data" / "storage")
    assert contents(storage) == kept.files
    settings = Settings(database_url=dsn, data_folder=tmp_path / "data")
    with engine.opened(settings) as database, database.reading() as connection:
        assert storage_identity.mismatch(connection, storage) is None
    run_service(settings, tmp_path, 2)
    back_up(Full(dsn, settings, {}), tmp_path / "tuesday")


@pytest.mark.thorough
def test_an_archive_of_a_former_version_is_restored_without_what_belongs_to_the_server(
    server: OperatorsServer, kept: Full, tmp_path: Path
):
    """It has PostGIS, reference systems of the operator, publications, comments."""
    name, file = database_of(kept.dsn), tmp_path / "former.dump"
    server.run(
        name,
        "insert into spatial_ref_sys values (990001, 'operator', 1, 'LOCAL_CS[\"x\"]', '+proj=longlat')",
        "create publication everything for all tables",
        "create extension fuzzystrmatch",
    )
    try:
        programs.run_program(kept.dsn, "pg_dump", *SERVERS_OWN, f"--file={file}")
    finally:
        server.run(
            name,
            "drop publication everything",
            "drop extension fuzzystrmatch",
            "delete from spatial_ref_sys where srid = 990001",
        )
    dsn = server.make_database()
    restored = amers(dsn, tmp_path / "data", "db", "restore", file)
    assert restored.returncode == 0, restored.stderr
    assert_same_rows(server, kept.dsn, dsn)
    assert server.rows(dsn, "select count(*) from spatial_ref_sys where srid = 990001") == [(0,)]


def test_reference_systems_that_an_operator_added_are_told_unless_they_are_there(
    server: OperatorsServer, kept: Full, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    add = (
        "insert into spatial_ref_sys values (990001, 'operator', 1, 'LOCAL_CS[\"x\"]', '+proj=longlat')"
    )
    server.run(database_of(kept.dsn), add)
    try:
        archive.dump(kept.dsn, tmp_path / "a.dump")
    finally:
        server.run(database_of(kept.dsn), "delete from spatial_ref_sys where srid = 990001")
    without, having = server.make_database(), server.make_database()
    server.run(database_of(having), add)
    archive.restore(having, tmp_path / "a.dump")
    assert "reference systems" not in caplog.text
    archive.restore(without, tmp_path / "a.dump")
    assert "SRID 990001" in caplog.text


@pytest.mark.thorough
def test_what_others_keep_in_the_database_is_neither_read_nor_restored(
    server: OperatorsServer, kept: Full, tmp_path: Path
):
    server.run(database_of(kept.dsn), "create schema closed", "create table closed.thing (id int)")
    try:
        archive.dump(kept.dsn, tmp_path / "a.dump")
    finally:
        server.run(database_of(kept.dsn), "drop schema closed cascade")
    dsn = server.make_database()
    archive.restore(dsn, tmp_path / "a.dump")
    assert server.rows(dsn, "select to_regnamespace('closed')") == [(None,)]


@pytest.mark.thorough
def test_postgis_in_a_schema_of_its_own_is_backed_up_and_restored(
    server: OperatorsServer, tmp_path: Path
):
    one, other = server.make_database("extensions"), server.make_database("extensions")
    revisions.upgrade(one)
    settings = Settings(database_url=one, data_folder=tmp_path / "data")
    run_service(settings, tmp_path, 1)
    archive.dump(one, tmp_path / "a.dump")
    archive.restore(other, tmp_path / "a.dump")
    assert_same_rows(server, one, other)


@pytest.mark.thorough
def test_tables_in_a_schema_of_their_own_are_backed_up_and_restored(
    server: OperatorsServer, tmp_path: Path
):
    one, other = server.make_database(), server.make_database()
    role = role_of(one)
    server.run(
        database_of(one),
        "create schema {schema} authorization {role}",
        "alter role {role} set search_path = {schema}, public",
        schema="Of Amers",
        role=role,
    )
    revisions.upgrade(one)
    archive.dump(one, tmp_path / "a.dump")
    archive.restore(other, tmp_path / "a.dump")
    revisions.upgrade(other)
    where = "select relnamespace::regnamespace::text from pg_class where relname = 'installation'"
    assert server.rows(one, where) == server.rows(other, where) == [('"Of Amers"',)]


@pytest.mark.thorough
def test_postgis_in_another_schema_than_that_of_the_archive_is_refused_with_statements(
    server: OperatorsServer, backup: Path, tmp_path: Path
):
    dsn = server.make_database("extensions")
    refused = amers(dsn, tmp_path / "data", "db", "restore", backup)
    assert refused.returncode == 2
    assert "create extension postgis schema public" in refused.stderr
    assert not (tmp_path / "data" / "storage").exists(), "nothing is restored"
    statements = refused.stderr.partition("run `")[2].partition("`")[0].split("; ")
    server.run(database_of(dsn), *statements)
    again = amers(dsn, tmp_path / "data", "db", "restore", backup)
    assert again.returncode == 0, again.stderr


@pytest.mark.thorough
@pytest.mark.parametrize("words", [("upgrade",), ("restore", "BACKUP")])
def test_a_database_without_postgis_is_refused_with_the_statement_that_helps(
    words: tuple[str, ...], server: OperatorsServer, backup: Path, tmp_path: Path
):
    dsn = server.make_database(None)
    command = [backup if word == "BACKUP" else word for word in words]
    refused = amers(dsn, tmp_path / "data", "db", *command)
    assert refused.returncode == 2
    assert "let a superuser run `create extension postgis`" in refused.stderr
    assert not (tmp_path / "data" / "storage").exists(), "nothing is restored"
    server.run(database_of(dsn), "create extension postgis")
    again = amers(dsn, tmp_path / "data", "db", *command)
    assert again.returncode == 0, again.stderr


@pytest.mark.thorough
@pytest.mark.parametrize("words", [("upgrade",), ("restore", "BACKUP")])
def test_a_role_that_may_not_make_tables_is_told_which_statement_lets_it(
    words: tuple[str, ...], server: OperatorsServer, backup: Path, tmp_path: Path
):
    dsn = server.make_database()
    server.run(
        "postgres", "alter database {name} owner to {owner}", name=database_of(dsn), owner="postgres"
    )
    command = [backup if word == "BACKUP" else word for word in words]
    refused = amers(dsn, tmp_path / "data", "db", *command)
    assert refused.returncode == 2
    statement = refused.stderr.partition("run `")[2].partition("`")[0]
    server.run("postgres", statement)
    again = amers(dsn, tmp_path / "data", "db", *command)
    assert again.returncode == 0, again.stderr


@pytest.mark.thorough
def test_a_role_without_the_reading_role_is_told_the_statements_and_reads_as_it_afterwards(
    server: OperatorsServer, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    dsn = server.make_database()
    assert amers(dsn, tmp_path / "data", "db", "upgrade").returncode == 0
    create, grant, upgrade = caplog.text.split("`")[1::2]
    assert upgrade == "amers db upgrade"
    try:
        server.run("postgres", create, grant)
        caplog.clear()
        assert amers(dsn, tmp_path / "data", "db", "upgrade").returncode == 0
        assert "amers_reader" not in caplog.text
        settings = Settings(database_url=dsn, data_folder=tmp_path / "data")
        with engine.opened(settings) as database, database.reading() as connection:
            role = connection.exec_driver_sql("select current_user::text").scalar()
        assert role == "amers_reader"
    finally:
        server.run(database_of(dsn), "drop owned by amers_reader", "drop role amers_reader")


def test_a_database_with_tables_of_anybody_is_left_as_it_is(
    server: OperatorsServer, backup: Path, tmp_path: Path
):
    dsn = server.make_database()
    server.run(database_of(dsn), "create table public.somebodys as select 1 as id")
    refused = amers(dsn, tmp_path / "data", "db", "restore", backup)
    assert (refused.returncode, "(somebodys)" in refused.stderr) == (2, True), refused.stderr
    assert not (tmp_path / "data" / "storage").exists()
    with pytest.raises(Conflict, match="somebodys"):
        archive.restore(dsn, backup / ARCHIVE)


@pytest.mark.thorough
def test_a_restore_that_fails_half_way_leaves_the_database_empty_and_the_next_one_completes_it(
    server: OperatorsServer, kept: Full, backup: Path, tmp_path: Path
):
    """Something that the superuser made stands in the way of one of the last entries."""
    dsn = server.make_database()
    server.run(
        database_of(dsn), "create function public.keep_density() returns int language sql as 'select 1'"
    )
    failed = amers(dsn, tmp_path / "data", "db", "restore", backup)
    assert failed.returncode == 2
    assert "nothing was restored into the database" in failed.stderr
    assert "keep_density" in failed.stderr
    assert not archive.has_tables(dsn)
    server.run(database_of(dsn), "drop function public.keep_density()")
    restore_backup(dsn, Storage(tmp_path / "data" / "storage"), backup)
    assert_same_rows(server, kept.dsn, dsn)


def test_the_password_is_on_no_command_line_and_a_file_of_passwords_serves_all_programs(
    server: OperatorsServer, kept: Full, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    seen = []
    run = subprocess.run

    def watch(command, **options):
        seen.extend(map(str, command))
        return run(command, **options)

    monkeypatch.setattr(programs.subprocess, "run", watch)
    archive.dump(kept.dsn, tmp_path / "a.dump")
    assert seen
    assert not any(PASSWORD in word or "password=" in word for word in seen)
    passwords = tmp_path / "passwords"
    escaped = PASSWORD.replace("\\", "\\\\").replace(":", "\\:")
    passwords.write_text(f"127.0.0.1:{server.port}:*:*:{escaped}\n")
    passwords.chmod(stat.S_IRUSR | stat.S_IWUSR)
    monkeypatch.setenv("PGPASSFILE", str(passwords))
    bare = server.dsn(database_of(kept.dsn), role_of(kept.dsn), None)
    archive.dump(bare, tmp_path / "b.dump")
    assert (tmp_path / "b.dump").stat().st_size > 0


def test_a_file_has_the_password_as_it_is(server: OperatorsServer, kept: Full, tmp_path: Path):
    file, address = tmp_path / "password", f"postgresql://{role_of(kept.dsn)}@127.0.0.1:{server.port}"
    url = f"{address}/{quote(database_of(kept.dsn))}"
    settings = {"AMERS_DATABASE_URL": url, "AMERS_DATABASE_PASSWORD_FILE": str(file)}
    environment = {name: value for name, value in os.environ.items() if not name.startswith("AMERS_")}
    for content in (PASSWORD, f"{PASSWORD}\n", f"{PASSWORD}\r\n"):
        file.write_bytes(content.encode())
        told = amers_here(["db", "status"], environment | settings)
        assert told.returncode == 0, told.stderr
    for content in ("", "\n", f"{PASSWORD}\n{PASSWORD}", "\xff"):
        file.write_bytes(content.encode("latin-1"))
        refused = amers_here(["db", "status"], environment | settings)
        assert refused.returncode == 2
        assert "AMERS_DATABASE_PASSWORD_FILE" in refused.stderr
        assert PASSWORD[:4] not in refused.stderr
    file.unlink()
    refused = amers_here(["db", "status"], environment | settings)
    assert "No such file" in refused.stderr


def test_a_client_that_is_older_than_the_server_is_refused_before_it_is_run(
    kept: Full, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    older = tmp_path / "bin" / "pg_dump"
    older.parent.mkdir()
    older.write_text("#!/bin/sh\necho 'pg_dump (PostgreSQL) 13.4'\n")
    older.chmod(0o755)
    monkeypatch.setattr(programs, "USUAL_FOLDERS", ())
    monkeypatch.setenv("PATH", str(older.parent))
    with pytest.raises(InputError, match="only version 13 of it is here: install it"):
        archive.dump(kept.dsn, tmp_path / "a.dump")
    older.unlink()
    with pytest.raises(InputError, match="it is not here: install it"):
        archive.dump(kept.dsn, tmp_path / "a.dump")


def test_of_several_clients_that_of_the_servers_version_is_taken(
    kept: Full, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A newer pg_restore sets parameters that the server does not know."""
    newer = tmp_path / "bin" / "pg_restore"
    newer.parent.mkdir()
    newer.write_text("#!/bin/sh\necho 'pg_restore (PostgreSQL) 99.1'\n")
    newer.chmod(0o755)
    monkeypatch.setenv("PATH", f"{newer.parent}:{os.environ['PATH']}")
    assert programs._find_program(kept.dsn, "pg_restore").parent != newer.parent
    monkeypatch.setattr(programs, "USUAL_FOLDERS", ())
    assert programs._find_program(kept.dsn, "pg_restore") == newer


@pytest.mark.thorough
def test_a_backup_beside_a_long_change_of_the_schema_gives_up_with_a_sentence(
    kept: Full, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(archive, "LOCK_WAIT", "100ms")
    with engine.connect(kept.dsn) as changing:
        changing.exec_driver_sql("lock table point in access exclusive mode")
        with pytest.raises(InputError, match="another command changes the tables"):
            archive.dump(kept.dsn, tmp_path / "a.dump")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.thorough
def test_the_migrated_store_of_an_ordinary_role_has_the_schema_of_every_other_one(
    server: OperatorsServer, kept: Full, backup: Path
):
    restored = server.make_database()
    archive.restore(restored, backup / ARCHIVE)
    with psycopg.connect(restored) as found, psycopg.connect(kept.dsn) as expected:
        assert differences(of_an_owner(found), of_an_owner(expected)) == {}


@pytest.mark.parametrize("damage", ["changed", "missing", "surplus"])
def test_the_exit_status_of_a_verification_tells_a_damaged_backup(
    damage: str, kept: Full, backup: Path, tmp_path: Path
):
    copy = tmp_path / "copy"
    shutil.copytree(backup, copy)
    assert amers(kept.dsn, tmp_path, "db", "verify-backup", copy).returncode == 0
    file = next(path for path in (copy / "storage" / "scenes").rglob("*") if path.is_file())
    if damage == "changed":
        content = bytearray(file.read_bytes())
        content[-1] ^= 1
        file.write_bytes(content)
    elif damage == "missing":
        file.unlink()
    else:
        file.with_name("surplus").write_bytes(b"x")
    verified = amers(kept.dsn, tmp_path, "db", "verify-backup", copy)
    assert verified.returncode == 2
    assert damage in verified.stdout + verified.stderr
