"""Pages of features of any collection in several formats, and single features.

The database makes each feature into text: five times faster than rows that become dictionaries and JSON.
The text stays as the database sends it, in UTF-8: to decode and encode it again takes half as long as to
receive it. Statements of pages are never prepared: the best plan for a box depends on its size.
"""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from itertools import islice
from typing import Any, Literal

import psycopg
from psycopg.types.string import ByteaBinaryLoader
from sqlalchemy import ColumnElement, Text, cast, func, select

from amers.app.db.constants import integer_constant, text_constant
from amers.app.db.engine import Connection, driver
from amers.app.db.features.collection import REFERENCE
from amers.app.db.features.crs import from_storage
from amers.app.db.features.query import (
    KEPT_STATEMENTS,
    Columns,
    Key,
    Layout,
    Selection,
    hot_page,
    page_parameters,
    page_select,
    sortable,
)
from amers.app.db.features.serialization import csv_text, feature_text, plain_value
from amers.app.db.schema import installation
from amers.app.db.statements import CopyOut, HotStatement, hot

ROWS_AT_ONCE = 2_000

TextFormat = Literal["geojson", "csv"]


@dataclass(frozen=True)
class Page:
    """Some features in a format.

    Attributes:
        body: the features without what stands around them.
        returned: their number.
        last: where the next page begins: the values that order features, of the last one; None when
            there are no more.
    """

    body: bytes
    returned: int
    last: Key | None


@dataclass
class Reading:
    """The outcome of reading many rows, complete when the reader is through.

    Attributes:
        returned, last: as in `Page`.
    """

    returned: int = 0
    last: Key | None = field(default=None)


def page(
    connection: Connection, selection: Selection, kind: TextFormat, after: Key | None, limit: int
) -> Page:
    """A page of features, in one piece.

    Args:
        kind: features separated by commas; lines of CSV without a header.
        after: `last` of the page before, None for the first.
        limit: most features.
    """
    rows = _rows(connection, selection, TEXT_COLUMNS[kind], after, limit)
    separator = b"," if kind == "geojson" else b"\r\n"
    body = separator.join([row[0] for row in rows[:limit]])
    last = _key(rows[limit - 1]) if len(rows) > limit else None
    return Page(body, min(len(rows), limit), last)


def stream_geojson(
    connection: Connection, selection: Selection, after: Key | None, limit: int, reading: Reading
) -> Iterator[bytes]:
    """Features separated by commas, in pieces of some thousand; `reading` is complete at the end."""
    statement = hot_page(selection, _geojson_columns, after)
    parameters = statement.parameters(page_parameters(selection, after, limit))
    with _text_as_sent(connection) as cursor:
        rows = cursor.stream(statement.sql, parameters, binary=True, size=ROWS_AT_ONCE)
        while piece := list(islice(rows, min(ROWS_AT_ONCE, limit - reading.returned))):
            separator = b",\n" if reading.returned else b""
            reading.returned += len(piece)
            if reading.returned == limit:
                reading.last = _key(piece[-1]) if list(rows) else None
            yield separator + b",\n".join([row[0] for row in piece])


def copy_csv(connection: Connection, selection: Selection, after: Key | None, limit: int) -> BytesIO:
    """A page and one row more, as CSV for `amers.services.formats.vector.feature_files`.

    Columns are the values that order features (a JSON text); longitude or east, latitude or north, and
    height of points, else the geometry as hexadecimal WKB; the key and the properties.
    """
    statement = hot(CopyOut(page_select(selection, _file_columns, after), "csv, header"))
    out = BytesIO()
    parameters = statement.parameters(page_parameters(selection, after, limit))
    with driver(connection).cursor() as cursor, cursor.copy(statement.sql, parameters) as copy:
        for piece in copy:
            out.write(piece)
    out.seek(0)
    return out


def keys(connection: Connection, selection: Selection, limit: int) -> list[Any]:
    """The keys of the selected features, in their order; one beyond the limit where there are more."""
    return [row[0] for row in _rows(connection, selection, _key_columns, None, limit)]


def find(connection: Connection, selection: Selection, reference: str) -> str | None:
    """One feature as GeoJSON, of the selected properties; None when the viewer can see none."""
    statement = _feature_statement(selection.layout)
    parameters = {**selection.viewer.parameters, "reference": reference}
    row = driver(connection).execute(statement.sql, statement.parameters(parameters)).fetchone()
    return None if row is None else str(row[0])


def page_secret(connection: Connection) -> bytes:
    """The secret with which the installation signs links to further pages."""
    return bytes(connection.execute(select(installation.c.page_secret)).scalar_one())


def _rows(
    connection: Connection, selection: Selection, columns: Columns, after: Key | None, limit: int
) -> Sequence[Sequence[Any]]:
    """The rows of a page and one row more, with texts as bytes.

    Row by row: one text of all features would be twice as long on the way, most of it spent on memory.
    """
    parameters = page_parameters(selection, after, limit)
    statement = hot_page(selection, columns, after)
    with _text_as_sent(connection) as cursor:
        cursor.execute(statement.sql, statement.parameters(parameters), prepare=False)
        return cursor.fetchall()


def _text_as_sent(connection: Connection) -> AbstractContextManager[psycopg.Cursor[Any]]:
    """A cursor whose columns of type text are bytes in UTF-8."""
    cursor = driver(connection).cursor(binary=True)
    cursor.adapters.register_loader("text", ByteaBinaryLoader)
    return cursor


def _key(row: Sequence[Any]) -> Key:
    """The values that order features, which follow the feature in its row."""
    return tuple(value.decode() if isinstance(value, bytes) else value for value in row[1:])


@lru_cache(KEPT_STATEMENTS)
def _feature_statement(layout: Layout) -> HotStatement:
    collection = layout.collection
    named = collection.named_by
    if named is None:
        named = cast(collection.key.expression, Text()) == REFERENCE
    statement = select(feature_text(layout)).select_from(collection.source)
    return hot(statement.where(collection.visible, named).limit(integer_constant(1)))


def _geojson_columns(layout: Layout) -> dict[str, ColumnElement[Any]]:
    return {"feature": feature_text(layout), **_link_values(layout)}


def _csv_columns(layout: Layout) -> dict[str, ColumnElement[Any]]:
    return {"line": csv_text(layout), **_link_values(layout)}


def _key_columns(layout: Layout) -> dict[str, ColumnElement[Any]]:
    return {"key": layout.collection.key.expression}


def _file_columns(layout: Layout) -> dict[str, ColumnElement[Any]]:
    order_values = (sortable(order.property) for order in layout.orders)
    geometry = from_storage(layout.collection.geometry, layout.crs)
    columns: dict[str, ColumnElement[Any]] = {"keys": func.json_build_array(*order_values)}
    if layout.collection.geometry_type == "Point":
        columns |= {"x": func.st_x(geometry), "y": func.st_y(geometry)}
        if layout.crs.has_height:
            columns["h"] = func.st_z(geometry)
    else:
        columns["wkb"] = func.encode(func.st_asbinary(geometry), text_constant("hex"))
    properties = (layout.collection.key, *layout.properties)
    return columns | {item.name: plain_value(item) for item in properties}


def _link_values(layout: Layout) -> dict[str, ColumnElement[Any]]:
    """The values that order features, as a link to the next page carries them."""
    properties = [order.property for order in layout.orders]
    return {
        f"last{place}": plain_value(item) if item.is_time else sortable(item)
        for place, item in enumerate(properties)
    }


TEXT_COLUMNS: dict[TextFormat, Columns] = {"geojson": _geojson_columns, "csv": _csv_columns}
