"""Features of any collection: pages of them in several formats, one by one.

Each feature is made into text by the database: five times faster than rows that become dictionaries and
JSON. Statements are never prepared: the best way to a box depends on its size.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from itertools import islice
from typing import Any, Literal

from psycopg.rows import tuple_row

from app.db.engine import Connection
from app.db.features.collection import Property
from app.db.features.crs import from_storage
from app.db.features.query import Key, Selection, chosen_rows, sortable, viewer_parameters
from app.db.features.serialization import csv_text, feature_text, plain_value

ROWS_AT_ONCE = 2_000

Text = Literal["geojson", "csv"]


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
    """A page and one row more, as CSV that `services.formats.vector.feature_files` makes into columns.

    Columns are the values that order features (a JSON text); longitude or east, latitude or north, and
    height of points, else the geometry as hexadecimal WKB; the key and the properties.
    """
    chosen, parameters = chosen_rows(selection, after, limit)
    crs = selection.crs
    geometry = from_storage(selection.collection.geometry, crs)
    if selection.collection.geometry_type == "Point":
        height = ", st_z(g) as h" if crs.has_height else ""
        position = f"st_x(g) as x, st_y(g) as y{height}"
    else:
        position = "encode(st_asbinary(g), 'hex') as wkb"
    columns = ", ".join(
        f"{plain_value(item)} as {_quoted(item.name)}"
        for item in (selection.collection.key, *selection.properties)
    )
    statement = f"""copy (select {keys_text(selection)} as keys, {position}, {columns}
        from ({chosen}) t, lateral (select {geometry} as g) geometry) to stdout (format csv, header)"""
    out = BytesIO()
    with connection.cursor() as cursor, cursor.copy(statement, parameters) as copy:
        for piece in copy:
            out.write(piece)
    out.seek(0)
    return out


def keys(connection: Connection, selection: Selection, limit: int) -> list[Any]:
    """The keys of the features selected, in their order; one beyond the limit where there are more."""
    chosen, parameters = chosen_rows(selection, None, limit)
    statement = f"select {selection.collection.key.expression} as key from ({chosen}) t"
    rows = connection.execute(statement, parameters, prepare=False).fetchall()
    return [row["key"] for row in rows]


def find(connection: Connection, selection: Selection, reference: str) -> str | None:
    """One feature as GeoJSON, of the properties selected; None when there is none for the viewer."""
    collection = selection.collection
    means = collection.found_by or f"{collection.key.expression}::text = %(key)s"
    row = connection.execute(
        f"""select {feature_text(selection)} as feature from {collection.source}
            where {collection.visible} and ({means}) limit 1""",
        {**viewer_parameters(selection.viewer), "key": reference},
    ).fetchone()
    return None if row is None else str(row["feature"])


def page_secret(connection: Connection) -> bytes:
    """What the installation signs the links to further pages with."""
    row = connection.execute("select page_secret from installation").fetchone()
    assert row is not None
    return bytes(row["page_secret"])


def _texts(
    selection: Selection, kind: Text, after: Key | None, limit: int
) -> tuple[str, dict[str, Any]]:
    """SELECT of a page and one row more: a feature as text, then the values that order it.

    Row by row: one text of all features would be twice as long on the way, most of it spent on memory.
    """
    chosen, parameters = chosen_rows(selection, after, limit)
    text = feature_text(selection) if kind == "geojson" else csv_text(selection)
    keys = ", ".join(key_value(item.property) for item in selection.orders)
    return f"select {text}, {keys} from ({chosen}) t", parameters


def key_value(item: Property) -> str:
    """A value that orders features as a link to the next page holds it."""
    return plain_value(item) if item.is_time else sortable(item)


def keys_text(selection: Selection) -> str:
    return f"json_build_array({', '.join(sortable(item.property) for item in selection.orders)})"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', "") + '"'
