"""The number, the extent and the period of the selected features: exact, or estimated."""

from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from typing import Any

import psycopg
from sqlalchemy import ColumnElement, Select, func, select
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.expression import ClauseElement, Executable
from sqlalchemy.types import NullType

from amers.app.db.constants import integer_constant, text_constant
from amers.app.db.engine import Connection, driver
from amers.app.db.features.bbox import WORLD
from amers.app.db.features.collection import Collection, Viewer
from amers.app.db.features.predicates import ANYTHING, BoxShape, height_predicate
from amers.app.db.features.query import KEPT_STATEMENTS, Selection, select_visible
from amers.app.db.statements import HotStatement, hot, hot_like

EXACT_COUNT = 10_000
COUNTING_MS = 1_000
"""Time limit for counting what a filter leaves; beyond it, the number is estimated."""
LIMIT_TIME = hot(
    select(
        func.set_config(
            text_constant("statement_timeout"), text_constant(str(COUNTING_MS)), text_constant("true")
        )
    )
)


@dataclass(frozen=True)
class Count:
    """A number of features; an estimate beyond 10,000 unless `exact`."""

    number: int
    exact: bool


class _Explain(Executable, ClauseElement):
    """EXPLAIN of a statement: its plan as JSON."""

    inherit_cache = False

    def __init__(self, statement: Select[Any]) -> None:
        self.statement = statement


@compiles(_Explain)
def _compile_explain(element: _Explain, compiler: SQLCompiler, **options: Any) -> str:
    return f"EXPLAIN (FORMAT json) {compiler.process(element.statement, **options)}"


def count(connection: Connection, selection: Selection, least: int = 0) -> Count:
    """The number of selected features: exact up to 10,000, an estimate beyond.

    Args:
        least: so many are known to be selected; beyond 10,000 nothing is counted again.
    """
    collection = selection.collection
    if selection.condition is ANYTHING and collection.total is not None:
        total = connection.execute(collection.total, selection.viewer.parameters).scalar_one()
        return Count(int(total), exact=True)
    if least <= EXACT_COUNT:
        try:
            with driver(connection).transaction():
                driver(connection).execute(LIMIT_TIME.sql, LIMIT_TIME.constants)
                number = _count_few(connection, selection)
            if number <= EXACT_COUNT:
                return Count(number, exact=True)
            least = EXACT_COUNT + 1
        except psycopg.errors.QueryCanceled:
            least = max(1, least)
    return Count(max(least, _estimate(connection, selection)), exact=False)


def _count_few(connection: Connection, selection: Selection) -> int:
    """The number of selected features, at most one more than is counted exactly."""
    predicate = selection.condition.non_bbox_predicate
    if predicate is None:
        statement = _few_statement(selection.collection, selection.box_shape)
    else:
        few = select_visible(selection.collection, selection.box_shape, integer_constant(1))
        statement = hot_like(_counted(few.where(predicate).limit(integer_constant(EXACT_COUNT + 1))))
    with driver(connection).cursor() as cursor:
        cursor.execute(statement.sql, statement.parameters(selection.parameters), prepare=False)
        row = cursor.fetchone()
    assert row is not None
    return int(row[0])


@lru_cache(KEPT_STATEMENTS)
def _few_statement(collection: Collection, box: BoxShape | None) -> HotStatement:
    few = select_visible(collection, box, integer_constant(1))
    return hot(_counted(few.limit(integer_constant(EXACT_COUNT + 1))))


def _counted(few: Select[Any]) -> Select[Any]:
    return select(func.count()).select_from(few.subquery("few"))


def _estimate(connection: Connection, selection: Selection) -> int:
    """About how many features are selected.

    Where cells are counted, from the cells for the box, and from the statistics of the planner on all
    rows for the other conditions.
    """
    collection, condition = selection.collection, selection.condition
    one, parameters = integer_constant(1), selection.parameters
    if collection.estimate_in_box is None:
        statement = select_visible(collection, selection.box_shape, one)
        if condition.non_bbox_predicate is not None:
            statement = statement.where(condition.non_bbox_predicate)
        return _planned(connection, statement, parameters)
    number = collection.estimate_in_box(connection, condition.box or WORLD)
    predicates: list[ColumnElement[bool]] = []
    if selection.box_shape is not None and selection.box_shape.bounds_height:
        predicates.append(height_predicate(collection))
    if condition.non_bbox_predicate is not None:
        predicates.append(condition.non_bbox_predicate)
    if not predicates:
        return number
    every_row = select(one).select_from(collection.source)
    meeting = _planned(connection, every_row.where(*predicates), parameters)
    return round(number * meeting / max(1, _planned(connection, every_row, {})))


def _planned(connection: Connection, statement: Select[Any], parameters: dict[str, Any]) -> int:
    """The number of rows that the planner expects."""
    explain = hot(_Explain(statement))
    with driver(connection).cursor() as cursor:
        cursor.execute(explain.sql, explain.parameters(parameters), prepare=False)
        plan = cursor.fetchone()
    assert plan is not None
    return int(plan[0][0]["Plan"]["Plan Rows"])


def extent(connection: Connection, collection: Collection, viewer: Viewer) -> tuple[float, ...] | None:
    """West, south, east, north of all that the viewer may see, None without any."""
    whole = func.st_extent(collection.geometry, type_=NullType())
    box = select_visible(collection, None, whole.label("extent")).subquery("box")
    sides = (func.st_xmin, func.st_ymin, func.st_xmax, func.st_ymax)
    statement = select(*(side(box.c.extent) for side in sides))
    row = connection.execute(statement, viewer.parameters).one()
    return None if row[0] is None else tuple(row)


def period(
    connection: Connection, collection: Collection, viewer: Viewer
) -> tuple[datetime | None, datetime | None]:
    """The first and the last time of all that the viewer may see; None without any."""
    assert collection.interval is not None
    start, end = (collection.columns[name].expression for name in collection.interval)
    statement = select_visible(collection, None, func.min(start), func.max(end))
    rows: list[Any] = list(connection.execute(statement, viewer.parameters))
    return rows[0][0], rows[0][1]
