"""Outages: each kind has one row, and replies say what failed and whether to try again."""

import errno
from typing import Any
from uuid import uuid4

import psycopg
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from psycopg import sql

from amers.app.api import error_responses
from amers.app.db import engine
from amers.app.errors import InputError, StorageOutage
from amers.app.outages import BY_STATE, MISSING, NO_ANSWER, READ_ONLY, Outage, outage_of


def refused(dsn: str, statement: sql.Composable) -> psycopg.Error:
    """What the server says to a statement."""
    with pytest.raises(psycopg.Error) as raised, psycopg.connect(dsn) as connection:
        connection.execute(statement)
    return raised.value


@pytest.mark.parametrize("state", sorted(BY_STATE))
def test_each_error_of_the_server_is_the_outage_of_its_code(dsn: str, state: str):
    error = refused(
        dsn,
        sql.SQL("do {}").format(f"begin raise exception 'a table' using errcode = '{state}'; end"),
    )
    found = outage_of(error)
    assert found is not None
    expected = BY_STATE[state]
    assert (found.status, found.again) == (expected.status, expected.again)
    assert found.reason == expected.reason + (" (a table)" if expected.quotes else "")


def test_what_is_behind_an_error_tells_of_the_outage_but_not_behind_one_of_amers():
    lost = psycopg.OperationalError("server closed the connection unexpectedly")

    def caused(error: Exception, cause: BaseException) -> Exception:
        error.__cause__ = cause
        return error

    found = outage_of(caused(RuntimeError("of a library"), lost))
    assert found is not None
    assert "lost" in found.reason
    assert outage_of(caused(InputError("the address is wrong"), lost)) is None
    assert outage_of(psycopg.DataError("a value")) is None
    assert outage_of(psycopg.ProgrammingError("cannot adapt type")) is None
    first, second = ValueError("a"), ValueError("b")
    first.__cause__, second.__cause__ = second, first
    assert outage_of(first) is None


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("connection failed: FATAL:  the database system is starting up", "does not accept connections"),
        ("connection failed: FATAL:  sorry, too many clients already", "no more connections"),
        ("connection failed: session is read-only", "no server that takes writes"),
        ("connection failed: Connection refused", "nothing listens"),
        ("something new p@ss", NO_ANSWER.reason),
    ],
)
def test_a_failed_connection_is_told_in_words_of_amers(words: str, reason: str):
    found = outage_of(psycopg.OperationalError(words))
    assert found is not None
    assert reason in found.reason
    assert "p@ss" not in found.reason


def reply_to(error: Exception) -> Any:
    app = FastAPI()
    error_responses.install(app)

    @app.get("/failing")
    def fail() -> None:
        raise error

    with TestClient(app, raise_server_exceptions=False) as client:
        return client.get("/failing")


@pytest.mark.parametrize(
    ("error", "status", "again"),
    [
        (psycopg.errors.ReadOnlySqlTransaction("x"), 503, True),
        (psycopg.errors.AdminShutdown("x"), 503, True),
        (psycopg.errors.DiskFull("x"), 507, True),
        (psycopg.errors.QueryCanceled("x"), 503, False),
        (psycopg.errors.InsufficientPrivilege("permission denied for table point"), 503, False),
        (psycopg.errors.UndefinedTable("no table point"), 503, False),
        (psycopg.InterfaceError("the connection is closed"), 503, True),
        (engine.PoolTimeout("no connection was free within 10 s"), 503, True),
        (OSError(errno.ENOSPC, "no space"), 507, True),
        (StorageOutage("the storage"), 503, True),
        (psycopg.errors.DivisionByZero("a bug"), 500, False),
        (psycopg.errors.SyntaxError("a bug"), 500, False),
        (OSError(errno.ENOTDIR, "a bug"), 500, False),
    ],
)
def test_the_reply_to_an_outage_says_whether_to_try_again(error: Exception, status: int, again: bool):
    reply = reply_to(error)
    assert reply.status_code == status, reply.text
    assert ("Retry-After" in reply.headers) == again
    found = outage_of(error)
    if found is not None:
        assert found.reason in reply.json()["detail"]
        assert (found.status, found.again) == (status, again)


def test_a_database_that_takes_no_writes_is_recognised(dsn: str):
    with psycopg.connect(dsn, autocommit=True) as connection:
        connection.execute("set default_transaction_read_only = on")
        with pytest.raises(psycopg.Error) as raised:
            connection.execute("delete from point")
    assert outage_of(raised.value) == READ_ONLY


def test_a_role_without_rights_and_a_missing_table_are_named(dsn: str):
    absent = outage_of(refused(dsn, sql.SQL("select from {}").format(sql.Identifier(uuid4().hex))))
    assert isinstance(absent, Outage)
    assert absent.reason.startswith(MISSING.reason)
    assert "does not exist" in absent.reason
