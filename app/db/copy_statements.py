"""COPY statements: the rows of a SELECT, or of a table, as a stream of bytes."""

from typing import Any, Literal

from sqlalchemy import Column, Select
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.expression import ClauseElement, Executable

from app.db.statements import HotStatement, hot

CopyFormat = Literal["binary", "csv"]
FORMATS: dict[CopyFormat, str] = {"binary": "(FORMAT binary)", "csv": "(FORMAT csv, HEADER)"}


class _CopyTo(Executable, ClauseElement):
    inherit_cache = False

    def __init__(self, statement: Select[Any], format: CopyFormat) -> None:
        self.statement = statement
        self.format = format


class _CopyFrom(Executable, ClauseElement):
    inherit_cache = False

    def __init__(self, columns: tuple[Column[Any], ...], format: CopyFormat) -> None:
        self.columns = columns
        self.format = format


def copy_to_stdout(statement: Select[Any], format: CopyFormat) -> HotStatement:
    """COPY of the rows of a SELECT to the client; of CSV with a header."""
    return hot(_CopyTo(statement, format))


def copy_from_stdin(*columns: Column[Any], format: CopyFormat = "binary") -> HotStatement:
    """COPY of rows from the client into columns of a table."""
    return hot(_CopyFrom(columns, format))


@compiles(_CopyTo)
def _compile_copy_to(element: _CopyTo, compiler: SQLCompiler, **options: Any) -> str:
    rows = compiler.process(element.statement, **options)
    return f"COPY ({rows}) TO STDOUT {FORMATS[element.format]}"


@compiles(_CopyFrom)
def _compile_copy_from(element: _CopyFrom, compiler: SQLCompiler, **options: Any) -> str:
    table = compiler.preparer.format_table(element.columns[0].table)
    names = ", ".join(compiler.preparer.format_column(column) for column in element.columns)
    return f"COPY {table} ({names}) FROM STDIN {FORMATS[element.format]}"
