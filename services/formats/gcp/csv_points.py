"""Ground points in CSV files, whose columns have the names below or are mapped to them by the caller."""

import csv
import io
import math
import re
from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from amers.services.errors import FormatError, InputError
from amers.services.formats.gcp.marked_points import (
    Ground,
    Heights,
    MarkedPoints,
    marked_points,
    parse_crs,
    to_wgs84,
)
from amers.services.formats.gcp.text_lines import check_lon_lat, sequential_ids
from amers.services.formats.text_files import parse_number
from amers.services.types import Array

COLUMNS = [
    "id",
    "lon",
    "lat",
    "x",
    "y",
    "height_m",
    "sigma_east_m",
    "sigma_north_m",
    "sigma_horizontal_m",
    "sigma_up_m",
    "image",
    "line",
    "sample",
    "sigma_px",
]
"""Names of the columns. x and y, easting first, replace lon and lat in another reference system;
`sigma_horizontal_m` stands for both horizontal coordinates. Other columns are ignored."""
PIXEL_ORIGINS = {"centre": 0.0, "corner": 0.5, "centre-1": 1.0, "corner-1": 1.5}
"""Line and sample of the centre of the first pixel, by the names of conventions: the centre is (0, 0),
the corner is (0, 0), the centre is (1, 1), the corner is (1, 1)."""
_ORIGIN, _CRS = "pixel-origin", "crs"
"""What a line before the names may state: `# pixel-origin=corner crs=EPSG:32633`."""
_STATEMENT = re.compile(r"#\s*(?:(?:pixel-origin|crs)=\S+\s*)+")
_POSITIONS = ({"lon", "lat"}, {"x", "y"})
_DELIMITERS = ",;\t"


@dataclass(frozen=True)
class CsvLayout:
    """What a caller states about a CSV file.

    Attributes:
        columns: name of the file's column for names of `COLUMNS`; the others have their own name.
        crs: reference system of x and y, a code or a definition, where the file states none.
    """

    columns: dict[str, str]
    crs: str | None = None


def parse_columns(text: str) -> dict[str, str]:
    """The columns of a text such as "lon=LONG_DD,lat=LAT_DD,height_m=H".

    Raises:
        InputError: a part has another form, or a name is not one of `COLUMNS`.
    """
    columns: dict[str, str] = {}
    for part in text.split(","):
        name, equals, column = (word.strip() for word in part.partition("="))
        if not equals or not column or name not in COLUMNS or name in columns:
            raise InputError(
                f"columns: {part[:60]!r} given; expected NAME=COLUMN of the file, each NAME once, from "
                f"{', '.join(COLUMNS)}"
            )
        columns[name] = column
    return columns


def is_csv(text: str, layout: CsvLayout) -> bool:
    """Whether the first line of a text names columns of a position."""
    names = _header(text)[1]
    return any({layout.columns.get(n, n) for n in position} <= set(names) for position in _POSITIONS)


def parse_csv(
    text: str, layout: CsvLayout, heights: Heights | None = None, source: str = "CSV file"
) -> MarkedPoints:
    """The points of a CSV file with a line of column names; an empty field is an unknown value.

    A line before the names may state the origin of pixels and the reference system of x and y. Positions
    in images are read where it states their origin.

    Args:
        text: contents of the file; commas, semicolons or tabs separate fields.
        layout: what the caller states about the file.
        heights: datum of the heights, which the file does not state.
        source: its name, for messages.

    Raises:
        FormatError: a column is missing, or a line has another form.
        InputError: neither file nor caller state the reference system of x and y, or both do.
        VerticalDatumError: the caller does not state the datum of the heights.
    """
    statements, names = _first_lines(text)
    delimiter, header = _header(text)
    places = _places(header, layout, source)
    on_map = "x" in places
    corner_px = _corner_px(places, statements.get(_ORIGIN), source)
    crs = _crs(statements.get(_CRS), layout.crs, source, on_map=on_map)
    lines = csv.reader(io.StringIO(text), delimiter=delimiter, strict=True)
    rows: list[dict[str, str]] = []
    wheres: list[str] = []
    try:
        for _ in range(names):
            next(lines)
        for fields in lines:
            where = f"{source}, line {lines.line_num}"
            if not any(field.strip() for field in fields):
                continue
            if len(fields) != len(header):
                raise FormatError(
                    f"{where}: expected {len(header)} fields, as many as columns, found {len(fields)}"
                )
            rows.append({name: fields[place].strip() for name, place in places.items()})
            wheres.append(where)
    except csv.Error as error:
        raise FormatError(f"{source}, line {lines.line_num}: expected CSV: {error}") from None
    numbers = {
        name: np.array(
            [_number(row[name], name, where) for row, where in zip(rows, wheres, strict=True)]
        )
        for name in places
        if name not in ("id", "image")
    }
    return marked_points(
        [_name(row["id"], where) for row, where in zip(rows, wheres, strict=True)]
        if "id" in places
        else sequential_ids([(0.0, 0.0)] * len(rows)),
        _ground(numbers, crs, heights, wheres, source, on_map=on_map),
        np.column_stack([_column(numbers, name, rows) for name in ("line", "sample")]) - corner_px,
        sigma_m=_sigmas_m(numbers, rows, source),
        image=[row.get("image", "") for row in rows],
        sigma_px=_column(numbers, "sigma_px", rows),
    )


def _first_lines(text: str) -> tuple[dict[str, str], int]:
    """What a line before the names of the columns states, and the number of the line of names."""
    first = text.partition("\n")[0].rstrip("\r")
    if _STATEMENT.fullmatch(first) is None:
        return {}, 1
    return dict(word.split("=", 1) for word in first.lstrip("#").split()), 2


def _header(text: str) -> tuple[str, list[str]]:
    """The delimiter of the line of names, and its fields."""
    lines = text.split("\n", 2)
    names = lines[_first_lines(text)[1] - 1].rstrip("\r") if len(lines) > 1 else text
    delimiter = max(_DELIMITERS, key=names.count)
    try:
        return delimiter, [name.strip() for name in next(csv.reader([names], delimiter=delimiter), [])]
    except csv.Error:
        return delimiter, []


def _places(header: list[str], layout: CsvLayout, source: str) -> dict[str, int]:
    """The place of each known column in a line."""
    places: dict[str, int] = {}
    for name in COLUMNS:
        column = layout.columns.get(name, name)
        if header.count(column) > 1:
            raise FormatError(
                f"{source}, names of the columns: found {header.count(column)} columns {column!r}, "
                "expected one"
            )
        if column in header:
            places[name] = header.index(column)
        elif name in layout.columns:
            raise FormatError(
                f"{source}, names of the columns: expected a column {column!r} for {name}, found "
                f"{', '.join(header)[:200]}"
            )
    given = [position for position in _POSITIONS if position & set(places)]
    if len(given) != 1 or not given[0] <= set(places):
        raise FormatError(
            f"{source}, names of the columns: expected the columns lon and lat, or x and y, found "
            f"{', '.join(header)[:200]}; name them (--columns lon=COLUMN,lat=COLUMN)"
        )
    return places


def _corner_px(places: dict[str, int], origin: str | None, source: str) -> float:
    """Line and sample of the centre of the first pixel; NaN where the file does not state its origin."""
    if ("line" in places) != ("sample" in places):
        raise FormatError(f"{source}: expected both columns line and sample, or none of them")
    if origin is None:
        return math.nan
    if origin not in PIXEL_ORIGINS:
        raise FormatError(
            f"{source}, line 1: {_ORIGIN}: expected one of {', '.join(PIXEL_ORIGINS)}, found "
            f"{origin[:20]!r}"
        )
    return PIXEL_ORIGINS[origin]


def _crs(of_file: str | None, of_caller: str | None, source: str, *, on_map: bool) -> CRS:
    definitions = [text for text in (of_file, of_caller) if text is not None]
    if not on_map:
        if definitions:
            raise InputError(
                f"{source}: {definitions[0][:40]} given as reference system of x and y, but the file "
                "has lon and lat, degrees of WGS 84; leave --crs out, or name the columns x and y"
            )
        return CRS.from_epsg(4326)
    if len(definitions) != 1:
        found = " and ".join(text[:40] for text in definitions) or "none"
        raise InputError(
            f"{source}: expected one reference system of x and y, found {found}; state it (--crs), "
            f"such as EPSG:32633, or in a first line '# {_CRS}=EPSG:32633'"
        )
    return parse_crs(definitions[0], source).to_2d()


def _number(field: str, name: str, where: str) -> float:
    return math.nan if field == "" else parse_number(field, name, where)


def _name(field: str, where: str) -> str:
    if not field:
        raise FormatError(f"{where}: id: expected a name, found nothing")
    return field


def _column(numbers: dict[str, Array], name: str, rows: list[dict[str, str]]) -> Array:
    """The numbers of a column; NaN where the file has no such column."""
    return numbers.get(name, np.full(len(rows), np.nan))


def _sigmas_m(numbers: dict[str, Array], rows: list[dict[str, str]], source: str) -> Array:
    """Sigmas (n, 3) east, north, up."""
    sigmas = [_column(numbers, f"sigma_{axis}_m", rows) for axis in ("east", "north", "up")]
    if "sigma_horizontal_m" in numbers:
        if {"sigma_east_m", "sigma_north_m"} & set(numbers):
            raise FormatError(
                f"{source}, names of the columns: expected sigma_horizontal_m, or sigma_east_m and "
                "sigma_north_m, found both"
            )
        sigmas[:2] = [numbers["sigma_horizontal_m"]] * 2
    return np.column_stack(sigmas)


def _ground(
    numbers: dict[str, Array],
    crs: CRS,
    heights: Heights | None,
    wheres: list[str],
    source: str,
    *,
    on_map: bool,
) -> Ground:
    """Points in WGS 84; points without a height need no vertical datum."""
    names = ("x", "y") if on_map else ("lon", "lat")
    height_m = numbers.get("height_m", np.full(len(wheres), np.nan))
    for x, y, where in zip(numbers[names[0]], numbers[names[1]], wheres, strict=True):
        if math.isnan(x) or math.isnan(y):
            raise FormatError(f"{where}: expected {names[0]} and {names[1]}, found an empty field")
        if not on_map:
            check_lon_lat(x, y, where)
    points = np.column_stack([numbers[names[0]], numbers[names[1]], height_m])
    return to_wgs84(points, crs, heights, source)
