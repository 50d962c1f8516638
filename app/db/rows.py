"""Rows as dataclasses: the fields of a dataclass are the column list of its statements."""

from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import Any, TypeVar

from sqlalchemy import ARRAY, ColumnElement, CursorResult, Label, Table, any_, literal

T = TypeVar("T")


def columns_of(row_type: type, table: Table, **expressions: ColumnElement[Any]) -> list[Label[Any]]:
    """A column for each field of a row dataclass, in their order and labelled with their names.

    Args:
        table: has a column for each field that is not an expression.
        expressions: fields that are calculated.

    Raises:
        KeyError: a field is no column; modules call this when they are imported.
    """
    return [
        (expressions[field.name] if field.name in expressions else table.c[field.name]).label(field.name)
        for field in fields(row_type)
    ]


def first(row_type: type[T], result: CursorResult[Any]) -> T | None:
    """The first row of a result as a dataclass, None without any."""
    row = result.first()
    return None if row is None else row_type(**row._mapping)


def only(row_type: type[T], result: CursorResult[Any]) -> T:
    """The row of a result that has exactly one."""
    return row_type(**result.one()._mapping)


def every(row_type: type[T], result: Iterable[Any]) -> list[T]:
    """All rows of a result as dataclasses."""
    return [row_type(**row._mapping) for row in result]


def among(column: ColumnElement[Any], values: Sequence[Any]) -> ColumnElement[bool]:
    """Whether a column has one of many values; they are one parameter, an array."""
    return column == any_(literal(list(values), ARRAY(column.type)))
