"""Engines: errors, full pools and connections that died while nobody used them."""

from uuid import uuid4

import psycopg
import pytest
from sqlalchemy import QueuePool, func, select, text

from amers.app.api.deps import UPLOADS_AT_ONCE, threads_for, turns_for, upload_turns
from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.engine import Database
from amers.app.db.schema import block, token
from amers.app.usecases.tokens import create_token
from tests.documents import ROOT
from tests.statements import run_sql


def test_errors_of_statements_are_those_of_the_driver(database: Database):
    with pytest.raises(psycopg.errors.DivisionByZero), database.reading() as connection:
        connection.execute(text("select 1 / 0"))
    with pytest.raises(psycopg.errors.NotNullViolation), database.transaction() as connection:
        connection.execute(token.insert().values(id=uuid4(), name="nobody"))


def test_a_caller_gives_up_when_no_connection_is_free_in_time(
    dsn: str, settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(engine, "POOL_TIMEOUT_S", 0.1)
    one = settings.model_copy(update={"pool_size": 1})
    with (
        engine.pooled(dsn, one) as database,
        database.reading(),
        pytest.raises(engine.PoolTimeout, match="no connection was free"),
        database.reading(),
    ):
        pass


@pytest.mark.parametrize("pool_size", [1, 8, 100])
def test_uploads_that_all_arrive_slowly_leave_a_thread_for_each_connection(
    dsn: str, settings: Settings, pool_size: int
):
    sized = settings.model_copy(update={"pool_size": pool_size})
    with engine.pooled(dsn, sized) as database:
        pools = [one.pool for one in (database.reader, database.writer)]
        assert all(isinstance(pool, QueuePool) for pool in pools)
        connections = sum(pool.size() for pool in pools)
    assert threads_for(sized) == UPLOADS_AT_ONCE + connections


OPERATIONS = " ".join((ROOT / "docs" / "operations.md").read_text().split())


@pytest.mark.parametrize("pool_size", [1, 2, 3, 4, 5, 7, 8, 9, 100])
def test_requests_take_three_quarters_of_the_connections_and_one_caller_half(pool_size: int):
    """As the manual says, in whole connections, and each caller has one at least."""
    turns = turns_for(Settings(pool_size=pool_size))
    assert 1 <= turns.most_per_caller <= turns.most <= pool_size
    assert 0.0 <= turns.most - 0.75 * pool_size < 1.0
    assert -1.0 < turns.most_per_caller - 0.5 * pool_size <= 0.5
    assert f"waits for up to {turns.patience_s:g} s, and is then asked to retry" in OPERATIONS


def test_uploads_have_the_turns_of_the_manual_and_do_not_wait_for_them():
    turns = upload_turns()
    assert f"{turns.most} in all and {turns.most_per_caller} for one caller" in OPERATIONS
    assert turns.patience_s == 0.0


def test_connections_that_died_in_the_pool_are_replaced_unseen(dsn: str, database: Database):
    for context in (database.reading, database.transaction):
        with context() as connection:
            connection.execute(select(block.c.number))
    with psycopg.connect(dsn, autocommit=True) as other:
        other.execute(
            "select pg_terminate_backend(pid, 10000) from pg_stat_activity"
            " where datname = current_database() and usename = current_user and pid <> pg_backend_pid()"
        )
    for context in (database.reading, database.transaction):
        with context() as connection:
            assert connection.scalar(select(func.count()).select_from(block)) == 0


def test_a_request_that_reads_can_do_nothing_else_and_not_for_long(dsn: str, settings: Settings):
    hasty = settings.model_copy(update={"read_timeout_seconds": 0.1})
    with engine.pooled(dsn, hasty) as database:
        with pytest.raises(psycopg.errors.ReadOnlySqlTransaction), database.reading() as connection:
            connection.execute(text("create temporary table t (n int)"))
        with pytest.raises(psycopg.errors.QueryCanceled), database.reading() as connection:
            connection.execute(text("select pg_sleep(3)"))
        with database.transaction() as connection:
            connection.execute(text("select pg_sleep(0.3)"))


def test_a_snapshot_sees_nothing_that_others_commit_meanwhile(dsn: str, database: Database):
    tokens = select(func.count()).select_from(token)
    with database.snapshot() as snapshot:
        assert snapshot.scalar(tokens) == 0
        with engine.connect(dsn) as other:
            create_token(other, "meanwhile", ["read"])
        assert snapshot.scalar(tokens) == 0
        with pytest.raises(psycopg.errors.ReadOnlySqlTransaction):
            create_token(snapshot, "of a snapshot", ["read"])
    with database.snapshot() as snapshot:
        assert snapshot.scalar(tokens) == 1


def test_a_limit_on_waiting_for_locks_ends_with_its_transaction(dsn: str, settings: Settings):
    setting = select(func.current_setting("lock_timeout"))
    with engine.pooled(dsn, settings.model_copy(update={"pool_size": 1})) as database:
        with database.transaction() as connection:
            engine.limit_lock_wait(connection, 2.5)
            assert connection.scalar(setting) == "2500ms"
        with database.transaction() as connection:
            assert connection.scalar(setting) == "1min", "every session has a limit"


def test_statements_of_the_driver_and_expressions_share_one_transaction(dsn: str):
    with engine.connect(dsn) as connection:
        create_token(connection, "kept", ["read"])
        connection.commit()
        run_sql(connection, "update token set name = 'changed'")
    with engine.connect(dsn) as connection:
        assert connection.scalar(select(token.c.name)) == "changed"
        run_sql(connection, "update token set name = 'forgotten'")
        connection.rollback()
    with engine.connect(dsn) as connection:
        assert connection.scalar(select(token.c.name)) == "changed"


def test_a_transaction_records_who_is_behind_it_until_it_ends(database: Database):
    setting = select(func.current_setting("amers.actor_name", True))
    with database.transaction() as connection:
        assert connection.scalar(setting)
    with database.reading() as connection:
        assert not connection.scalar(setting)
