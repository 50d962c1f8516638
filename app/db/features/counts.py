"""How many features are selected, where they lie and when they were: exact, or about."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any

import psycopg

from app.db.engine import Connection
from app.db.features.bbox import WORLD
from app.db.features.collection import Collection, Viewer
from app.db.features.predicates import ANYTHING
from app.db.features.query import Selection, from_where, viewer_parameters

EXACT_COUNT = 10_000
COUNTING_MS = 1_000
"""Longest time spent on counting what a filter leaves; beyond, the number is estimated."""


@dataclass(frozen=True)
class Count:
    """How many features; an estimate beyond 10,000 unless `exact`."""

    number: int
    exact: bool


def count(connection: Connection, selection: Selection) -> Count:
    """How many features are selected: exact up to 10,000, an estimate beyond."""
    collection = selection.collection
    if selection.condition is ANYTHING and collection.total:
        row = connection.execute(collection.total, viewer_parameters(selection.viewer)).fetchone()
        assert row is not None
        return Count(row["n"], exact=True)
    parameters = {**selection.condition.parameters, **viewer_parameters(selection.viewer)}
    few = f"select 1 from {from_where(selection)} limit {EXACT_COUNT + 1}"
    try:
        with connection.transaction():
            connection.execute(f"set local statement_timeout = {COUNTING_MS}")
            row = connection.execute(
                f"select count(*) as n from ({few}) few", parameters, prepare=False
            ).fetchone()
        assert row is not None
        if row["n"] <= EXACT_COUNT:
            return Count(row["n"], exact=True)
        least = EXACT_COUNT + 1
    except psycopg.errors.QueryCanceled:
        least = 1
    return Count(max(least, _estimate(connection, selection, parameters)), exact=False)


def _estimate(connection: Connection, selection: Selection, parameters: dict[str, Any]) -> int:
    """About how many features are selected.

    Where counts are kept, by them for the box, and by what the planner knows of all rows for the rest.
    """
    collection, condition = selection.collection, selection.condition
    if collection.in_box is None:
        return _planned(connection, from_where(selection), parameters)
    number = collection.in_box(connection, condition.box or WORLD)
    if not condition.beside:
        return number
    meeting = _planned(connection, f"{collection.source} where {condition.beside}", parameters)
    return round(number * meeting / max(1, _planned(connection, collection.source, parameters)))


def _planned(connection: Connection, source: str, parameters: dict[str, Any]) -> int:
    """How many rows the planner expects."""
    plan = connection.execute(
        f"explain (format json) select 1 from {source}", parameters, prepare=False
    ).fetchone()
    assert plan is not None
    return int(plan["QUERY PLAN"][0]["Plan"]["Plan Rows"])


def extent(connection: Connection, collection: Collection, viewer: Viewer) -> tuple[float, ...] | None:
    """West, south, east, north of all that the viewer may see, None without any."""
    row = connection.execute(
        f"""select st_xmin(e) as w, st_ymin(e) as s, st_xmax(e) as e, st_ymax(e) as n
            from (select st_extent({collection.geometry}) as e from {collection.source}
                  where {collection.visible}) box""",
        viewer_parameters(viewer),
    ).fetchone()
    return None if row is None or row["w"] is None else (row["w"], row["s"], row["e"], row["n"])


def period(
    connection: Connection, collection: Collection, viewer: Viewer
) -> tuple[datetime | None, datetime | None]:
    """The first and the last time of all that the viewer may see; None without any."""
    assert collection.interval is not None
    start, end = (collection.queryables[name].expression for name in collection.interval)
    row = connection.execute(
        f"select min({start}) as first, max({end}) as last"
        f" from {collection.source} where {collection.visible}",
        viewer_parameters(viewer),
    ).fetchone()
    return (None, None) if row is None else (row["first"], row["last"])
