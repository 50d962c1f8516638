"""Statements from files, statements compiled once, and rows as dataclasses."""

import re
from dataclasses import dataclass
from pathlib import Path

import pytest
from sqlalchemy import bindparam, func, select

from amers.app.db.engine import driver
from amers.app.db.rows import among, columns_of
from amers.app.db.schema import block
from amers.app.db.statements import CopyIn, hot, named

APP = Path(__file__).parents[2] / "app"


def test_every_named_statement_of_the_files_is_used_once():
    files = sorted((APP / "db" / "sql").glob("*.sql"))
    there = [
        (file.name, name)
        for file in files
        for name in re.findall(r"^-- name: (\w+)$", file.read_text(), re.MULTILINE)
    ]
    used = [
        use
        for path in sorted(APP.rglob("*.py"))
        for use in re.findall(r"\bnamed\(\s*\"([a-z_]+\.sql)\",\s*\"(\w+)\"", path.read_text())
    ]
    assert sorted(used) == sorted(there)


def test_a_statement_that_no_file_has_is_refused():
    with pytest.raises(KeyError, match="nothing"):
        named("jobs.sql", "nothing")


def test_a_hot_statement_takes_its_own_constants_and_the_values_of_the_call(connection):
    statement = hot(
        select(block.c.number).where(block.c.state == "staged", block.c.id == bindparam("id"))
    )
    assert set(statement.constants.values()) == {"staged"}
    rows = driver(connection).execute(statement.sql, statement.parameters({"id": "none"})).fetchall()
    assert rows == []


def test_a_copy_names_the_columns_of_its_table_and_no_others():
    assert hot(CopyIn(block, ["number", "id"])).sql == (
        b"COPY block (number, id) FROM STDIN (FORMAT BINARY)"
    )
    with pytest.raises(KeyError):
        CopyIn(block, ["nothing"])


@dataclass(frozen=True)
class Named:
    """A row with a column of its own."""

    relname: str
    length: int


def test_a_field_without_a_column_is_refused_when_the_columns_are_listed():
    with pytest.raises(KeyError, match="relname"):
        columns_of(Named, block, length=func.length(block.c.id))


def test_among_sends_many_values_as_one_parameter(connection):
    many = list(range(100_000))
    statement = select(block.c.number).where(among(block.c.number, many))
    assert connection.execute(statement).all() == []
