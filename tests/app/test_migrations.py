"""The schema: made by migrations, once, in order, and back."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import psycopg
import pytest
from alembic.config import Config
from alembic.script import ScriptDirectory
from pydantic import SecretStr

from amers.app.config import Settings
from amers.app.db import engine, revisions
from amers.app.db.cluster import backup, embedded
from amers.app.db.revisions import SchemaStatus
from amers.app.errors import Conflict, InputError
from amers.app.usecases.tokens import create_token, list_tokens
from tests.statements import run_sql

TABLES = "select tablename from pg_tables where schemaname = 'public'"
OURS = {
    "token",
    "block",
    "image",
    "chip_file",
    "point",
    "view",
    "scene",
    "job",
    "registration",
    "measure",
}


def tables(dsn: str) -> set[str]:
    with psycopg.connect(dsn) as connection:
        return {name for (name,) in connection.execute(TABLES)}


def alembic(dsn: str) -> Config:
    config = Config()
    config.set_main_option("script_location", str(revisions.migrations_folder()))
    config.attributes["dsn"] = dsn
    return config


def test_an_empty_database_gets_the_tables_of_the_store_and_the_queue(empty_dsn):
    assert revisions.status(empty_dsn) == SchemaStatus(found=None, needed=revisions.newest_revision())
    revisions.upgrade(empty_dsn)
    assert revisions.status(empty_dsn).current
    assert tables(empty_dsn) >= OURS | {"procrastinate_jobs", "spatial_ref_sys"}


def test_whoever_opens_a_new_database_reads_as_a_reader_at_once(empty_dsn, monkeypatch, tmp_path):
    monkeypatch.setattr(embedded, "database", lambda settings: nullcontext(empty_dsn))
    with engine.opened(Settings(data_folder=tmp_path)) as database, database.reading() as connection:
        row = run_sql(connection, "select current_user as who").fetchone()
    assert row["who"] == engine.READER


def test_two_upgrades_at_once_do_the_work_of_one(empty_dsn):
    with ThreadPoolExecutor(2) as pool:
        done = [
            pool.submit(
                subprocess.run,
                [sys.executable, "-m", "amers", "db", "upgrade"],
                env=env,
                check=True,
            )
            for env in [{**os.environ, "AMERS_DATABASE_URL": empty_dsn}] * 2
        ]
    assert [future.result().returncode for future in done] == [0, 0]
    assert revisions.status(empty_dsn).current


def order_of(dsn: str) -> list[str]:
    """The revisions, the oldest first."""
    scripts = ScriptDirectory.from_config(alembic(dsn))
    return [one.revision for one in scripts.walk_revisions()][::-1]


def test_the_names_of_the_files_give_the_order_that_alembic_keeps(empty_dsn):
    scripts = ScriptDirectory.from_config(alembic(empty_dsn))
    assert scripts.get_current_head() == revisions.newest_revision()
    assert scripts.get_heads() == [revisions.newest_revision()]


def test_a_database_of_your_own_is_not_upgraded_behind_your_back(empty_dsn, tmp_path):
    settings = Settings(database_url=SecretStr(empty_dsn), data_folder=tmp_path)
    with pytest.raises(InputError, match="amers db upgrade"), engine.opened(settings):
        pass
    assert tables(empty_dsn) <= {"spatial_ref_sys"}


def test_a_database_of_a_newer_amers_is_left_alone(dsn):
    with engine.connect(dsn) as connection:
        run_sql(connection, "update alembic_version set version_num = '9999'")
    with pytest.raises(InputError, match="which this Amers does not know"):
        revisions.upgrade(dsn)


def test_a_database_that_does_not_answer_is_an_error_of_one_line(tmp_path):
    with pytest.raises(InputError, match="cannot be reached"):
        revisions.status(f"host={tmp_path} dbname=amers connect_timeout=1")


def test_reading_connections_can_neither_write_nor_take_too_long(dsn, tmp_path):
    settings = Settings(database_url=SecretStr(dsn), data_folder=tmp_path, read_timeout_seconds=0.1)
    with engine.opened(settings) as database:
        with pytest.raises(psycopg.errors.ReadOnlySqlTransaction), database.reading() as connection:
            run_sql(connection, "delete from token")
        with pytest.raises(psycopg.errors.QueryCanceled), database.reading() as connection:
            run_sql(connection, "select pg_sleep(5)")


def test_reading_connections_have_a_role_that_can_only_select(dsn, tmp_path):
    settings = Settings(database_url=SecretStr(dsn), data_folder=tmp_path)
    with engine.opened(settings) as database:
        with database.reading() as connection:
            assert run_sql(connection, "select current_user as me").fetchone()["me"] == engine.READER
            assert run_sql(connection, "select count(*) as n from audit").fetchone()["n"] == 0
        forbidden = (
            "select pg_read_file('/etc/passwd')",
            "copy (select 1) to program 'true'",
            "select lo_import('/etc/passwd')",
        )
        for statement in forbidden:
            with (
                pytest.raises(
                    (psycopg.errors.InsufficientPrivilege, psycopg.errors.ReadOnlySqlTransaction)
                ),
                database.reading() as connection,
            ):
                run_sql(connection, statement)
        with (
            database.reading() as connection,
            engine.driver(connection).transaction(force_rollback=True),
        ):
            run_sql(connection, "set transaction read write")
            with pytest.raises(psycopg.errors.InsufficientPrivilege):
                run_sql(connection, "delete from token")


def test_a_transaction_is_kept_whole_or_not_at_all(dsn, tmp_path):
    settings = Settings(database_url=SecretStr(dsn), data_folder=tmp_path)
    with engine.opened(settings) as database:
        with pytest.raises(InputError), database.transaction() as connection:
            [create_token(connection, name, ["read"]) for name in ("half", "")]
        with database.transaction() as connection:
            create_token(connection, "whole", ["read"])
        with database.reading() as connection:
            assert [token.name for token in list_tokens(connection)] == ["whole"]


def test_a_point_lies_in_the_range_of_its_block(connection):
    with pytest.raises(psycopg.errors.CheckViolation, match="point"):
        run_sql(
            connection,
            "insert into point values (5, 1, st_setsrid(st_makepoint(0, 0, 0), 4979),"
            " 1, 1, 1, 0, 0, 0, 2, 1, null, null, null, 1, 0, 2)",
        )


def test_a_backup_restores_into_an_empty_database(dsn, empty_dsn, tmp_path):
    with engine.connect(dsn) as connection:
        create_token(connection, "kept", ["read"])
    backup.dump(dsn, tmp_path / "amers.dump")
    backup.restore(empty_dsn, tmp_path / "amers.dump")
    assert revisions.status(empty_dsn).current
    with engine.connect(empty_dsn) as connection:
        assert [token.name for token in list_tokens(connection)] == ["kept"]


def test_a_backup_overwrites_nothing_and_a_restore_neither(dsn, tmp_path):
    file = tmp_path / "amers.dump"
    backup.dump(dsn, file)
    with pytest.raises(Conflict, match="exists"):
        backup.dump(dsn, file)
    with pytest.raises(Conflict, match="has tables already"):
        backup.restore(dsn, file)


def test_a_file_that_is_no_backup_restores_nothing(empty_dsn, tmp_path):
    (tmp_path / "noise").write_bytes(b"\x00noise" * 100)
    with pytest.raises(InputError, match="pg_restore"):
        backup.restore(empty_dsn, tmp_path / "noise")
    assert tables(empty_dsn) <= {"spatial_ref_sys"}
