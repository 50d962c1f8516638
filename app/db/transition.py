"""SQLAlchemy's connection that still takes the driver's SQL, until all modules are converted."""

from contextlib import AbstractContextManager
from typing import Any, TypeVar, overload

import psycopg
import sqlalchemy
from psycopg.rows import DictRow, RowFactory, dict_row
from psycopg.sql import SQL, Composed
from sqlalchemy import CursorResult, Executable

T = TypeVar("T")
Query = str | bytes | SQL | Composed

DriverConnection = psycopg.Connection[tuple[Any, ...]]


class Connection(sqlalchemy.Connection):
    """A connection of SQLAlchemy; text goes to the driver and gives rows as mappings."""

    @overload
    def execute(
        self, statement: Executable, parameters: Any = None, **options: Any
    ) -> CursorResult[Any]: ...
    @overload
    def execute(
        self, statement: Query, parameters: Any = None, **options: Any
    ) -> psycopg.Cursor[DictRow]: ...
    def execute(self, statement: Any, parameters: Any = None, **options: Any) -> Any:
        """Execute an expression, or the driver's SQL."""
        if isinstance(statement, (str, bytes, SQL, Composed)):
            cursor = driver(self).cursor(row_factory=dict_row)
            return cursor.execute(statement, parameters, **options)
        return super().execute(statement, parameters, **options)

    @overload
    def cursor(self) -> psycopg.Cursor[DictRow]: ...
    @overload
    def cursor(self, *, row_factory: RowFactory[T]) -> psycopg.Cursor[T]: ...
    def cursor(self, *, row_factory: Any = dict_row) -> Any:
        """A cursor of the driver."""
        return driver(self).cursor(row_factory=row_factory)

    def transaction(self, **options: Any) -> AbstractContextManager[Any]:
        """A transaction of the driver in this one."""
        return driver(self).transaction(**options)


def driver(connection: sqlalchemy.Connection) -> DriverConnection:
    """The driver's own connection, for COPY, streams and hot statements, in the same transaction."""
    if not connection.in_transaction():
        connection.begin()
    wrapped: DriverConnection | None = connection.connection.driver_connection
    assert wrapped is not None
    return wrapped
