"""Plain SQL on a connection of the store, for what no function of the store does."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import psycopg
from psycopg.rows import DictRow, dict_row

from amers.app.db.engine import Connection, driver


def run_sql(
    connection: Connection, statement: str, parameters: Sequence[Any] | Mapping[str, Any] | None = None
) -> psycopg.Cursor[DictRow]:
    """Execute the driver's SQL in the transaction of a connection; rows are mappings."""
    return driver(connection).cursor(row_factory=dict_row).execute(statement.encode(), parameters)


def run_in(
    begun: AbstractContextManager[Connection],
    statement: str,
    parameters: Sequence[Any] | Mapping[str, Any] | None = None,
) -> list[DictRow]:
    """The rows of the driver's SQL, in a transaction that is begun for it."""
    with begun as connection:
        cursor = run_sql(connection, statement, parameters)
        return cursor.fetchall() if cursor.description else []
