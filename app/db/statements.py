"""Statements that are kept: named ones from the files of `app/db/sql`, and hot ones compiled once.

A file holds one statement after each line `-- name: NAME`. Parameters are written `:name`; a type is
given by `cast(:name as type)`, because `:name::type` is not recognised.

SQLAlchemy compiles a statement at its first execution and keeps the text; each execution still costs it
about 0.1 ms. A statement that answers a request of a millisecond is a `HotStatement`: its text goes
straight to the driver.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

from sqlalchemy import ClauseElement, Dialect, Select, Table, TextClause, text
from sqlalchemy.dialects import postgresql
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler

from amers.app.db.sql_files import sql_file

DIALECT: Dialect = postgresql.psycopg.dialect()  # type: ignore[no-untyped-call]
KEPT_STRUCTURES = 64
"""Compiled statements of users' filters that are kept."""
NAME = re.compile(r"^-- name: (\w+)$", re.MULTILINE)


@dataclass(frozen=True)
class HotStatement:
    """A statement as the driver takes it.

    Attributes:
        sql: with parameters in the driver's style, `%(name)s`.
        constants: values of parameters that the statement itself gives.
    """

    sql: bytes
    constants: Mapping[str, Any]

    def parameters(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """All parameters of one execution."""
        return {**self.constants, **values}


def hot(statement: ClauseElement) -> HotStatement:
    """Compile a statement for the driver; each `bindparam` becomes a parameter of that name."""
    compiled = statement.compile(dialect=DIALECT, compile_kwargs={"render_postcompile": True})
    constants = {name: value for name, value in compiled.params.items() if value is not None}
    return HotStatement(str(compiled).encode(), constants)


def hot_like(statement: Select[Any]) -> HotStatement:
    """`hot`, compiled once for all statements that differ only in the values of literals."""
    structure = _Structure(statement)
    compiled, sql = _compiled(structure)
    values = compiled.construct_params(extracted_parameters=structure.key.bindparams)
    return HotStatement(sql, {name: value for name, value in values.items() if value is not None})


class _Structure:
    """A statement; equal to every other of the same structure, as SQLAlchemy's own cache sees it."""

    def __init__(self, statement: Select[Any]) -> None:
        key = statement._generate_cache_key()
        assert key is not None
        self.statement, self.key = statement, key

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Structure) and self.key.key == other.key.key

    def __hash__(self) -> int:
        return hash(self.key.key)


@lru_cache(KEPT_STRUCTURES)
def _compiled(structure: _Structure) -> tuple[SQLCompiler, bytes]:
    compiled = structure.statement.compile(dialect=DIALECT, cache_key=structure.key)
    assert isinstance(compiled, SQLCompiler)
    return compiled, str(compiled).encode()


class CopyIn(ClauseElement):
    """COPY of rows in binary format into columns of a table."""

    def __init__(self, table: Table, columns: Iterable[str]) -> None:
        self.table = table
        self.columns = [table.c[name] for name in columns]


class CopyOut(ClauseElement):
    """COPY of the rows of a query, in a format of COPY such as `binary`."""

    def __init__(self, query: Select[Any], options: str) -> None:
        self.query = query
        self.options = options


@compiles(CopyIn)
def _copy_in(element: CopyIn, compiler: SQLCompiler, **_: Any) -> str:
    preparer = compiler.preparer
    columns = ", ".join(preparer.format_column(column) for column in element.columns)
    return f"COPY {preparer.format_table(element.table)} ({columns}) FROM STDIN (FORMAT BINARY)"


@compiles(CopyOut)
def _copy_out(element: CopyOut, compiler: SQLCompiler, **options: Any) -> str:
    query = compiler.process(element.query, **options)
    return f"COPY ({query}) TO STDOUT (FORMAT {element.options})"


def named(file: str, name: str) -> TextClause:
    """One statement of a file of `app/db/sql`."""
    return text(_statements(file)[name])


@cache
def _statements(file: str) -> dict[str, str]:
    before, *parts = NAME.split(sql_file(file))
    assert all(line.startswith("--") or not line.strip() for line in before.splitlines()), file
    return {name: statement.strip() for name, statement in zip(parts[::2], parts[1::2], strict=True)}
