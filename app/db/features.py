"""Features of any collection: pages of them in several formats, counts, one by one.

Each feature is made into text by the database: five times faster than rows that become dictionaries and
JSON. Statements are never prepared: the best way to a box depends on its size.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from io import BytesIO
from itertools import islice
from typing import Any, Literal

import psycopg
from psycopg.rows import tuple_row

from app.db.box import WORLD
from app.db.collections import Collection, Property, Viewer
from app.db.conditions import ANYTHING, Condition
from app.db.crs import Crs, from_storage, in_own_order
from app.db.engine import Connection

EXACT_COUNT = 10_000
COUNTING_MS = 1_000
"""Longest time spent on counting what a filter leaves; beyond, the number is estimated."""
DEGREE_DIGITS = 9
"""Decimals of a degree in replies: a tenth of a millimetre."""
METRE_DIGITS = 4
ROWS_AT_ONCE = 2_000

Text = Literal["geojson", "csv"]
Key = tuple[Any, ...]


@dataclass(frozen=True)
class Order:
    """Features in the order of a property."""

    property: Property
    descending: bool = False


@dataclass(frozen=True)
class Selection:
    """What is asked of a collection.

    Attributes:
        collection: asked.
        viewer: who asks.
        condition: that features meet.
        order: by these, then by the key.
        properties: of each feature, in this order.
        crs: of the reply.
    """

    collection: Collection
    viewer: Viewer
    crs: Crs
    properties: tuple[Property, ...]
    condition: Condition = ANYTHING
    order: tuple[Order, ...] = ()

    @property
    def orders(self) -> tuple[Order, ...]:
        """The order, made definite by the key."""
        return (*self.order, Order(self.collection.key))


@dataclass(frozen=True)
class Page:
    """Some features in a format.

    Attributes:
        body: without what stands around features.
        returned: how many.
        last: where the next page goes on: the values that order features, of the last one; None when
            there are no more.
    """

    body: bytes
    returned: int
    last: Key | None


@dataclass(frozen=True)
class Count:
    """How many features; an estimate beyond 10,000 unless `exact`."""

    number: int
    exact: bool


@dataclass
class Reading:
    """What a reader of many rows has learnt when it is through.

    Attributes:
        returned, last: as in `Page`.
    """

    returned: int = 0
    last: Key | None = field(default=None)


def page(
    connection: Connection, selection: Selection, kind: Text, after: Key | None, limit: int
) -> Page:
    """A page of features, in one piece.

    Args:
        kind: features separated by commas; lines of CSV without a header.
        after: `last` of the page before, None for the first.
        limit: most features.
    """
    with connection.cursor(row_factory=tuple_row) as cursor:
        cursor.execute(*_texts(selection, kind, after, limit), prepare=False)
        rows = cursor.fetchall()
    separator = "," if kind == "geojson" else "\r\n"
    body = separator.join([row[0] for row in rows[:limit]]).encode()
    last = rows[limit - 1][1:] if len(rows) > limit else None
    return Page(body, min(len(rows), limit), last)


def stream_geojson(
    connection: Connection, selection: Selection, after: Key | None, limit: int, reading: Reading
) -> Iterator[bytes]:
    """Features separated by commas, in pieces of some thousand; what was read is known at the end."""
    with connection.cursor(row_factory=tuple_row) as cursor:
        statement, parameters = _texts(selection, "geojson", after, limit)
        rows = cursor.stream(statement, parameters, size=ROWS_AT_ONCE)
        while piece := list(islice(rows, min(ROWS_AT_ONCE, limit - reading.returned))):
            separator = ",\n" if reading.returned else ""
            reading.returned += len(piece)
            if reading.returned == limit:
                reading.last = piece[-1][1:] if list(rows) else None
            yield (separator + ",\n".join([row[0] for row in piece])).encode()


def copy_csv(connection: Connection, selection: Selection, after: Key | None, limit: int) -> BytesIO:
    """A page and one row more, as CSV that `services.formats.feature_files` makes into columns.

    Columns are the values that order features (a JSON text); longitude or east, latitude or north, and
    height of points, else the geometry as hexadecimal WKB; the key and the properties.
    """
    chosen, parameters = _chosen(selection, after, limit)
    crs = selection.crs
    geometry = from_storage(selection.collection.geometry, crs)
    if selection.collection.geometry_type == "Point":
        height = ", st_z(g) as h" if crs.has_height else ""
        position = f"st_x(g) as x, st_y(g) as y{height}"
    else:
        position = "encode(st_asbinary(g), 'hex') as wkb"
    columns = ", ".join(
        f"{_plain(item)} as {_quoted(item.name)}"
        for item in (selection.collection.key, *selection.properties)
    )
    statement = f"""copy (select {_keys(selection)} as keys, {position}, {columns}
        from ({chosen}) t, lateral (select {geometry} as g) geometry) to stdout (format csv, header)"""
    out = BytesIO()
    with connection.cursor() as cursor, cursor.copy(statement, parameters) as copy:
        for piece in copy:
            out.write(piece)
    out.seek(0)
    return out


def keys(connection: Connection, selection: Selection, limit: int) -> list[Any]:
    """The keys of the features selected, in their order; one beyond the limit where there are more."""
    chosen, parameters = _chosen(selection, None, limit)
    statement = f"select {selection.collection.key.expression} as key from ({chosen}) t"
    rows = connection.execute(statement, parameters, prepare=False).fetchall()
    return [row["key"] for row in rows]


def count(connection: Connection, selection: Selection) -> Count:
    """How many features are selected: exact up to 10,000, an estimate beyond."""
    collection = selection.collection
    if selection.condition is ANYTHING and collection.total:
        row = connection.execute(collection.total, _of(selection.viewer)).fetchone()
        assert row is not None
        return Count(row["n"], exact=True)
    parameters = {**selection.condition.parameters, **_of(selection.viewer)}
    few = f"select 1 from {_from_where(selection)} limit {EXACT_COUNT + 1}"
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
        return _planned(connection, _from_where(selection), parameters)
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


def find(connection: Connection, selection: Selection, reference: str) -> str | None:
    """One feature as GeoJSON, of the properties selected; None when there is none for the viewer."""
    collection = selection.collection
    means = collection.found_by or f"{collection.key.expression}::text = %(key)s"
    row = connection.execute(
        f"""select {feature_text(selection)} as feature from {collection.source}
            where {collection.visible} and ({means}) limit 1""",
        {**_of(selection.viewer), "key": reference},
    ).fetchone()
    return None if row is None else str(row["feature"])


def extent(connection: Connection, collection: Collection, viewer: Viewer) -> tuple[float, ...] | None:
    """West, south, east, north of all that the viewer may see, None without any."""
    row = connection.execute(
        f"""select st_xmin(e) as w, st_ymin(e) as s, st_xmax(e) as e, st_ymax(e) as n
            from (select st_extent({collection.geometry}) as e from {collection.source}
                  where {collection.visible}) box""",
        _of(viewer),
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
        _of(viewer),
    ).fetchone()
    return (None, None) if row is None else (row["first"], row["last"])


def page_secret(connection: Connection) -> bytes:
    """What the installation signs the links to further pages with."""
    row = connection.execute("select page_secret from installation").fetchone()
    assert row is not None
    return bytes(row["page_secret"])


def feature_text(selection: Selection) -> str:
    """SQL of one feature as GeoJSON text; texts and dates are quoted by to_json, numbers are finite."""
    collection = selection.collection
    names = ",".join(f"{json.dumps(item.name)}:%%s" for item in selection.properties)
    digits = DEGREE_DIGITS if selection.crs.in_degrees else METRE_DIGITS
    geometry = in_own_order(from_storage(collection.geometry, selection.crs), selection.crs)
    values = [
        _json(collection.key),
        f"coalesce(st_asgeojson({geometry}, {digits}, 0), 'null')",
        *(_json(item) for item in selection.properties),
        *([collection.members] if collection.members else []),
    ]
    members = "%%s" if collection.members else ""
    pattern = f'{{"type":"Feature","id":%%s,"geometry":%%s,"properties":{{{names}}}{members}}}'
    return f"format('{pattern}', {', '.join(values)})"


def _chosen(selection: Selection, after: Key | None, limit: int) -> tuple[str, dict[str, Any]]:
    """SELECT of a page and one row more, in order."""
    collection, condition = selection.collection, selection.condition
    parameters = {**condition.parameters, **_of(selection.viewer), "limit": limit}
    if collection.everything and not selection.order and not condition.spatial:
        parameters["after"] = -1 if after is None else after[0]
        return collection.everything.replace("{condition}", condition.sql), parameters
    where = _from_where(selection)
    if after is not None:
        where += f" and {_beyond(selection.orders, after, parameters)}"
    order = ", ".join(
        f"{_sortable(item.property)} {'desc' if item.descending else 'asc'} nulls last"
        if item.property.nullable
        else f"{_sortable(item.property)} {'desc' if item.descending else 'asc'}"
        for item in selection.orders
    )
    return f"select t.* from {where} order by {order} limit %(limit)s + 1", parameters


def _from_where(selection: Selection) -> str:
    collection = selection.collection
    return f"{collection.source} where {collection.visible} and {selection.condition.sql}"


def _beyond(orders: Sequence[Order], after: Key, parameters: dict[str, Any]) -> str:
    """The condition that a row comes after the one of these values; unknown values come last."""
    first, rest = orders[0], orders[1:]
    sql, value, name = _sortable(first.property), after[0], f"after{len(orders)}"
    if value is None:
        return f"({sql} is null and {_beyond(rest, after[1:], parameters)})"
    parameters[name] = value
    bound = f"%({name})s::{_sort_type(first.property)}"
    further = f"{sql} {'<' if first.descending else '>'} {bound}"
    if not rest:
        return further
    if first.property.nullable:
        further = f"({further} or {sql} is null)"
    return f"({further} or ({sql} = {bound} and {_beyond(rest, after[1:], parameters)}))"


def _sort_type(item: Property) -> str:
    """The type in which values go to a link and come back the same."""
    return "double precision" if item.type == "real" else item.type


def _sortable(item: Property) -> str:
    return f"({item.expression})::double precision" if item.type == "real" else item.expression


def _key(item: Property) -> str:
    """A value that orders features as a link to the next page holds it."""
    return _plain(item) if item.is_time else _sortable(item)


def _keys(selection: Selection) -> str:
    return f"json_build_array({', '.join(_sortable(item.property) for item in selection.orders)})"


def _texts(
    selection: Selection, kind: Text, after: Key | None, limit: int
) -> tuple[str, dict[str, Any]]:
    """SELECT of a page and one row more: a feature as text, then the values that order it.

    Row by row: one text of all features would be twice as long on the way, most of it spent on memory.
    """
    chosen, parameters = _chosen(selection, after, limit)
    text = feature_text(selection) if kind == "geojson" else _csv_text(selection)
    keys = ", ".join(_key(item.property) for item in selection.orders)
    return f"select {text}, {keys} from ({chosen}) t", parameters


def csv_header(selection: Selection) -> str:
    """The names of the columns of CSV."""
    names = [selection.collection.key.name, *_position_names(selection)]
    return ",".join([*names, *(item.name for item in selection.properties)])


def _position_names(selection: Selection) -> tuple[str, ...]:
    if selection.collection.geometry_type != "Point":
        return ("wkt",)
    if not selection.crs.in_degrees:
        return ("east_m", "north_m")
    return ("lon_deg", "lat_deg", "height_m") if selection.crs.has_height else ("lon_deg", "lat_deg")


def _csv_text(selection: Selection) -> str:
    """SQL of a line of CSV; columns are named, so longitude is first whatever the reference system."""
    collection = selection.collection
    geometry = from_storage(collection.geometry, selection.crs)
    if collection.geometry_type == "Point":
        axes = ("st_x", "st_y", "st_z")[: len(_position_names(selection))]
        position = [f"{axis}({geometry})::text" for axis in axes]
    else:
        position = [f"'\"' || st_astext({geometry}, {DEGREE_DIGITS}) || '\"'"]
    values = [_csv(collection.key), *position, *(_csv(item) for item in selection.properties)]
    return f"concat_ws(',', {', '.join(values)})"


def _json(item: Property) -> str:
    sql = item.expression
    if item.type == "boolean":
        sql = f"({sql})::text"
    elif not item.is_number:
        sql = f"to_json({sql})::text"
    return f"coalesce(({sql})::text, 'null')" if item.nullable else sql


def _csv(item: Property) -> str:
    sql = f"({_plain(item)})::text"
    if item.type == "text":
        sql = f"'\"' || replace({sql}, '\"', '\"\"') || '\"'"
    return f"coalesce({sql}, '')" if item.nullable else sql


def _plain(item: Property) -> str:
    """A value of the few types that files of all formats have: dates are text in ISO 8601."""
    if item.is_time:
        return f"(to_json({item.expression}) #>> '{{}}')"
    return item.expression


def _quoted(name: str) -> str:
    return '"' + name.replace('"', "") + '"'


def _of(viewer: Viewer) -> dict[str, Any]:
    return {"viewer": viewer.token, "admin": viewer.is_admin}
