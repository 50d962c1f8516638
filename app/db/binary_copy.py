"""PostgreSQL's binary COPY of whole arrays, in both directions: ten times faster than row by row.

Source: PostgreSQL documentation, COPY, "Binary Format"; PostGIS, "EWKB".
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from uuid import UUID

import numpy as np
import numpy.typing as npt
from sqlalchemy import Table

from amers.app.db.engine import Connection, driver
from amers.app.db.statements import CopyIn, hot
from amers.services.types import Array, IntArray

HEADER = b"PGCOPY\n\xff\r\n\0" + b"\0" * 8
TRAILER = b"\xff\xff"
ROWS_AT_ONCE = 20_000
_EPOCH = np.datetime64("2000-01-01", "D")
_SRID_POINT_Z = np.array([1 | 0x80000000 | 0x20000000, 4979], dtype="<u4")

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Column:
    """One column in the binary format.

    Attributes:
        data: (n, w) bytes, padded to the longest value.
        length: (n,) bytes that count in each row; -1 for NULL.
    """

    data: Bytes
    length: IntArray


def numbers(values: npt.NDArray[np.generic], kind: str) -> Column:
    """A column of numbers; `kind` is a NumPy type of the width of the column: i2, i4, i8, f4, f8."""
    data = np.ascontiguousarray(values, dtype=f">{kind}").view(np.uint8).reshape(len(values), -1)
    return Column(data, np.full(len(values), data.shape[1]))


def dates(days: npt.NDArray[np.datetime64]) -> Column:
    """A column of dates, NULL for NaT."""
    missing = np.isnat(days)
    since = np.where(missing, 0, (days - _EPOCH).astype(np.int64))
    column = numbers(since, "i4")
    return Column(column.data, np.where(missing, -1, column.length))


def reals(values: npt.NDArray[np.generic], kind: str) -> Column:
    """A column of real numbers, NULL for NaN."""
    column = numbers(values, kind)
    return Column(column.data, np.where(np.isnan(values), -1, column.length))


def uuids(value: UUID, rows: int) -> Column:
    """A column that holds one UUID in every row."""
    return Column(np.tile(np.frombuffer(value.bytes, np.uint8), (rows, 1)), np.full(rows, 16))


def texts(values: npt.NDArray[np.object_]) -> Column:
    """A column of texts, NULL for None."""
    encoded = [b"" if value is None else str(value).encode() for value in values]
    length = np.array([len(value) for value in encoded], dtype=np.int64)
    width = max(1, int(length.max(initial=0)))
    data = np.frombuffer(b"".join(value.ljust(width) for value in encoded), dtype=np.uint8)
    missing = np.array([value is None for value in values], dtype=np.bool_)
    return Column(data.reshape(len(values), width), np.where(missing, -1, length))


def points_z(lon_lat_h: Array) -> Column:
    """A column of PostGIS points, PointZ in EPSG:4979."""
    data = np.empty((len(lon_lat_h), 33), dtype=np.uint8)
    data[:, 0] = 1
    data[:, 1:9] = _SRID_POINT_Z.view(np.uint8)
    data[:, 9:] = np.ascontiguousarray(lon_lat_h, dtype="<f8").view(np.uint8).reshape(-1, 24)
    return Column(data, np.full(len(lon_lat_h), 33))


def insert_rows(connection: Connection, table: Table, columns: Mapping[str, Column]) -> None:
    """Insert rows into a table; the columns are given by name."""
    statement = hot(CopyIn(table, columns))
    with driver(connection).cursor() as cursor, cursor.copy(statement.sql) as copy:
        for piece, _ in copy_pieces(list(columns.values())):
            copy.write(piece)


def copy_pieces(columns: Sequence[Column]) -> Iterator[tuple[bytes, int]]:
    """The bytes of a COPY FROM of these columns, in pieces, and how many rows each piece holds."""
    total = len(columns[0].length)
    yield HEADER, 0
    for start in range(0, total, ROWS_AT_ONCE):
        part = slice(start, start + ROWS_AT_ONCE)
        rows = [Column(column.data[part], column.length[part]) for column in columns]
        yield _rows(rows), len(rows[0].length)
    yield TRAILER, 0


def _rows(columns: Sequence[Column]) -> bytes:
    n = len(columns[0].length)
    pieces = [np.tile(np.array([len(columns)], dtype=">i2").view(np.uint8), (n, 1))]
    in_row = [np.ones((n, 2), dtype=np.bool_)]
    for column in columns:
        pieces.append(column.length.astype(">i4").view(np.uint8).reshape(n, 4))
        pieces.append(column.data)
        in_row.append(np.ones((n, 4), dtype=np.bool_))
        in_row.append(np.arange(column.data.shape[1]) < column.length[:, None])
    rows, mask = np.concatenate(pieces, axis=1), np.concatenate(in_row, axis=1)
    return rows.tobytes() if mask.all() else rows[mask].tobytes()


def parse_copy(data: bytes, kinds: Sequence[tuple[str, str]]) -> npt.NDArray[np.void]:
    """The rows of a COPY TO whose columns are numbers, none of them NULL.

    Args:
        data: all of it.
        kinds: name and kind (as in `numbers`) of each column.

    Returns:
        A structured array with a field for each column, big-endian.
    """
    fields: list[tuple[str, str]] = [("", ">i2")]
    for name, kind in kinds:
        fields += [(f"length of {name}", ">i4"), (name, f">{kind}")]
    layout = np.dtype([(name or "columns", kind) for name, kind in fields])
    body = len(data) - len(HEADER) - len(TRAILER)
    if body % layout.itemsize:
        raise ValueError(
            f"{body} bytes are not rows of {layout.itemsize}: a value is NULL or of another type"
        )
    return np.frombuffer(data, layout, count=body // layout.itemsize, offset=len(HEADER))
