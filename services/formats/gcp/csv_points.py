"""Ground points in CSV files with the column names below, or with names mapped by the caller."""

import math
import re
from dataclasses import dataclass, replace

import numpy as np
from pyproj import CRS

from amers.services.errors import (
    FormatError,
    InputError,
    MissingStatements,
    VerticalDatumError,
    refuse_unstated,
)
from amers.services.formats.gcp.comments import (
    Comments,
    agreed_heights,
    check_axes,
    earth_crs,
    read_comments,
)
from amers.services.formats.gcp.csv_columns import ABOVE_SEA, Head, chosen_height, read_head
from amers.services.formats.gcp.csv_numbers import has_decimal_comma, parse_field
from amers.services.formats.gcp.csv_statements import TakenAs, record_unused
from amers.services.formats.gcp.csv_table import CsvHead, CsvRow, csv_head, csv_rows
from amers.services.formats.gcp.marked_points import (
    ELLIPSOID,
    Ground,
    Heights,
    MarkedPoints,
    horizontal_unit_m,
    marked_points,
    no_datum,
    to_wgs84,
)
from amers.services.formats.gcp.record import Record
from amers.services.formats.gcp.text_lines import check_lon_lat, sequential_ids
from amers.services.statements import Subject
from amers.services.types import Array, BoolArray

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
`sigma_horizontal_m` stands for both horizontal coordinates. Words of surveyors are understood, too, see
`read_head`. Other columns are named as not used."""
PIXEL_ORIGINS = {"centre": 0.0, "corner": 0.5, "centre-1": 1.0, "corner-1": 1.5}
"""Line and sample of the centre of the first pixel, by the names of conventions: the centre is (0, 0),
the corner is (0, 0), the centre is (1, 1), the corner is (1, 1)."""
_ORIGIN = re.compile(r"\bpixel-origin\s*[=:]\s*(\S+)", re.IGNORECASE)
"""What a line before the names may state: `# pixel-origin=corner crs=EPSG:32633 heights=EGM96`."""
_POSITIONS = ({"lon", "lat"}, {"x", "y"})
_MARK = {"line", "sample"}
_POSITION_NAMES = ("lon", "lat", "x", "y")
_FLAGS = {"1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}


@dataclass(frozen=True)
class CsvLayout:
    """What a caller states about a CSV file.

    Attributes:
        columns: name of the file's column for names of `COLUMNS`; the others have their own name.
        crs: reference system of x and y, a code or a definition, where the file states none.
        may_lack_ground: whether marks may come without a position on the ground, in any or all rows.
    """

    columns: dict[str, str]
    crs: str | None = None
    may_lack_ground: bool = False


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
    """Whether the first line of a text, after comments, names the columns that it has to have."""
    return _names_position(csv_head(text, lambda names: _names_position(names, layout)).names, layout)


def _names_position(names: list[str], layout: CsvLayout) -> bool:
    known = {_value_of(name, layout).name for name in names}
    return any(position <= known for position in _positions(layout))


def _positions(layout: CsvLayout) -> tuple[set[str], ...]:
    """The columns of which a file has to have one set."""
    return (*_POSITIONS, _MARK) if layout.may_lack_ground else _POSITIONS


def lacks_pixel_origin(text: str, layout: CsvLayout) -> bool:
    """Whether a text has columns of marks, but does not state the origin of its pixels."""
    head = csv_head(text, lambda names: _names_position(names, layout))
    stated = any(_ORIGIN.search(line) for _, line in head.comments)
    return not stated and {"line", "sample"} <= {_value_of(name, layout).name for name in head.names}


def parse_csv(
    text: str, layout: CsvLayout, heights: Heights | None = None, source: str = "CSV file"
) -> MarkedPoints:
    """The points of a CSV file with a line of column names; an empty field is an unknown value.

    Comments before the names may state the origin of pixels, the reference system and the datum of the
    heights. Positions in images are read where they state their origin. A head may state the unit and
    the datum of heights.

    Args:
        text: contents of the file; commas, semicolons or tabs separate fields.
        layout: what the caller states about the file.
        heights: datum of the heights, where the file does not state it.
        source: its name, for messages.

    Raises:
        FormatError: a column is missing or not understood, or a line has another form.
        InputError: neither file nor caller state the reference system of x and y, or both do.
        VerticalDatumError: neither the file nor the caller states the datum of the heights, or they
            differ.
        MissingStatements: several of these are missing.
    """
    head = csv_head(text, lambda names: _names_position(names, layout))
    comments = read_comments(head.comments, source)
    record = Record(source, list(comments.statements))
    columns = _columns(head.names, layout, comments, heights, source)
    rows = csv_rows(text, head, source)
    numbers = _numbers(rows, columns)
    datum = _datum(columns, numbers, comments, heights, record)
    crs = _crs(columns, comments, layout, record)
    states_datum = datum is not None or np.isnan(numbers.get("height_m", np.full(1, np.nan))).all()
    missing: list[InputError] = [] if states_datum else [no_datum(source)]
    refuse_unstated(missing if crs is not None else [*missing, _no_crs(source)])
    assert crs is not None
    sigmas = ", ".join(head.text for name, head in columns.heads.items() if name.startswith("sigma_"))
    if sigmas:
        record.used(Subject.ACCURACY, sigmas, "columns")
    active, check = (_flags(rows, columns, name, record) for name in ("active", "check"))
    taken = TakenAs(str(datum), crs, is_stated=columns.on_map or layout.crs is not None)
    record_unused(rows, columns.unused, taken, record)
    _check_units(columns, crs, record)
    points = _ground(numbers, columns, crs, datum, rows)
    corner_px = _corner_px(columns, head, record)
    return marked_points(
        [_name(row.fields[columns.places["id"]], row.where) for row in rows]
        if "id" in columns.places
        else sequential_ids([(0.0, 0.0)] * len(rows)),
        points,
        np.column_stack([_column(numbers, name, rows) for name in ("line", "sample")]) - corner_px,
        statements=tuple(record.statements),
        sigma_m=_sigmas_m(numbers, rows, source),
        image=[row.fields[columns.places["image"]] if "image" in columns.places else "" for row in rows],
        sigma_px=_column(numbers, "sigma_px", rows),
        active=active,
        check=check,
    )


@dataclass(frozen=True)
class _Columns:
    """The columns of a file: heads and places of the columns that are read, and the other heads.

    Rows may lack ground where the layout of the caller allows it.
    """

    source: str
    heads: dict[str, Head]
    places: dict[str, int]
    unused: list[tuple[int, Head]]
    may_lack_ground: bool

    @property
    def on_map(self) -> bool:
        return "x" in self.places

    @property
    def has_ground(self) -> bool:
        return not self.places.keys().isdisjoint(_POSITION_NAMES)


def _value_of(text: str, layout: CsvLayout) -> Head:
    """The head of a column; the caller, the documents, or its words name its value."""
    head = read_head(text)
    mapped = {column: name for name, column in layout.columns.items()}
    if text in mapped:
        return replace(head, name=mapped[text])
    if text in COLUMNS and text != "height_m":
        return replace(head, name=text if text not in layout.columns else None)
    return head


def _columns(
    header: list[str], layout: CsvLayout, comments: Comments, heights: Heights | None, source: str
) -> _Columns:
    """The columns of a file, by their heads."""
    where = f"{source}, names of the columns"
    for name, column in layout.columns.items():
        if column not in header:
            raise FormatError(
                f"{where}: expected a column {column!r} for {name}, found {', '.join(header)[:200]}"
            )
    heads = [_value_of(text, layout) for text in header]
    places: dict[str, int] = {}
    for name in (*(name for name in COLUMNS if name != "height_m"), "active", "check"):
        of_name = [place for place, head in enumerate(heads) if head.name == name]
        exact = [place for place in of_name if header[place] in (name, layout.columns.get(name))]
        if len(exact) > 1 or (name in ("lon", "lat", "x", "y") and not exact and len(of_name) > 1):
            found = [header[place] for place in exact or of_name]
            raise FormatError(f"{where}: found {len(found)} columns {found[0]!r}, expected one")
        if of_name:
            places[name] = (exact or of_name)[0]
    is_projected = layout.crs is not None or (comments.crs is not None and comments.crs.is_projected)
    given = _position_of(set(places), layout, is_projected=is_projected)
    if given is None:
        raise FormatError(
            f"{where}: expected the columns lon and lat, or x and y, found "
            f"{', '.join(header)[:200]}; name them (--columns lon=COLUMN,lat=COLUMN)"
        )
    height = _height_place(heads, header, layout, comments.heights or heights, source)
    if height is not None:
        places["height_m"] = height
    for name in {"lon", "lat", "x", "y"} - given:
        places.pop(name, None)
    unused = [(place, head) for place, head in enumerate(heads) if place not in places.values()]
    named = {name: heads[place] for name, place in places.items()}
    return _Columns(source, named, places, unused, layout.may_lack_ground)


def _position_of(names: set[str], layout: CsvLayout, *, is_projected: bool) -> set[str] | None:
    """The columns of the position on the ground; empty where marks have none; None where they miss."""
    given = [position for position in _POSITIONS if position <= names]
    if given:
        return given[-1] if is_projected else given[0]
    return set() if layout.may_lack_ground and names >= _MARK else None


def _height_place(
    heads: list[Head], header: list[str], layout: CsvLayout, heights: Heights | None, source: str
) -> int | None:
    """The place of the column of heights: that of the caller, `height_m`, or the one by its words."""
    mapped = layout.columns.get("height_m")
    exact = [place for place, text in enumerate(header) if text == (mapped or "height_m")]
    if len(exact) > 1:
        raise FormatError(
            f"{source}, names of the columns: found {len(exact)} columns {header[exact[0]]!r}, "
            "expected one"
        )
    if exact:
        return exact[0]
    return chosen_height(heads, None if heights is None else str(heights).lower(), source)


def _numbers(rows: list[CsvRow], columns: _Columns) -> dict[str, Array]:
    """The numbers (n,) of each column in metres, degrees and pixels, NaN for empty fields."""
    places = {
        name: place
        for name, place in columns.places.items()
        if name not in ("id", "image", "active", "check")
    }
    comma = any(has_decimal_comma(row.fields[place]) for row in rows for place in places.values())
    factor = {
        name: 1.0 if name in _POSITION_NAMES else columns.heads[name].unit_m or 1.0 for name in places
    }
    return {
        name: factor[name]
        * np.array([parse_field(row.fields[place], name, row.where, comma=comma) for row in rows])
        for name, place in places.items()
    }


def _datum(
    columns: _Columns,
    numbers: dict[str, Array],
    comments: Comments,
    heights: Heights | None,
    record: Record,
) -> Heights | None:
    """The datum of the heights that file or caller state; None where neither does."""
    head = columns.heads.get("height_m")
    if head is None:
        return ELLIPSOID
    where = f"column {head.text}"
    of_file = comments.heights
    if head.datum not in (None, ABOVE_SEA):
        of_file = str(agreed_heights(of_file, head.datum, f"{columns.source}, {where}"))
        record.used(Subject.VERTICAL_DATUM, str(head.datum), where)
    datum = agreed_heights(of_file, heights, f"{columns.source}, {where}")
    if head.datum == ABOVE_SEA:
        if datum == ELLIPSOID:
            raise VerticalDatumError(
                f"{columns.source}, {where}: heights above sea level by its name, ellipsoid given; "
                "state their geoid (--vertical EGM96, or --geoid)"
            )
        record.used(Subject.VERTICAL_DATUM, ABOVE_SEA, where)
    return datum


def _no_crs(source: str) -> MissingStatements:
    return MissingStatements(
        [
            f"{source}: expected one reference system of x and y, found none; state it (--crs), such as "
            "EPSG:32633, or in a first line '# crs=EPSG:32633'"
        ]
    )


def _crs(columns: _Columns, comments: Comments, layout: CsvLayout, record: Record) -> CRS | None:
    """The reference system of the positions; None where none is stated of x and y."""
    source = columns.source
    of_caller = None if layout.crs is None else earth_crs(layout.crs, f"{source}: --crs")
    if of_caller is not None and comments.crs is not None:
        raise InputError(
            f"{source}: expected one reference system of x and y, found {comments.crs.to_string()[:40]} "
            f"and {layout.crs}; leave --crs out"
        )
    crs = of_caller or comments.crs
    if crs is not None and len(crs.axis_info) > 2:
        vertical = crs.sub_crs_list[1].name if crs.is_compound else "the ellipsoid"
        note = "the datum of heights is that of --vertical or of their column"
        record.not_used(Subject.VERTICAL_DATUM, vertical, "reference system", note)
    if columns.on_map:
        return crs if crs is None else crs.to_2d()
    if not columns.has_ground:
        return CRS.from_epsg(4326)
    if crs is None:
        record.assumed(Subject.HORIZONTAL_DATUM, "WGS 84", "", "--crs states another")
        return CRS.from_epsg(4326)
    if not crs.is_geographic:
        raise InputError(
            f"{source}: {crs.to_string()[:40]} given as reference system of x and y, but the file "
            "has lon and lat, degrees of WGS 84; leave --crs out, or name the columns x and y"
        )
    return crs.to_2d()


def _flags(rows: list[CsvRow], columns: _Columns, name: str, record: Record) -> BoolArray:
    """Which rows (n,) a column of yes and no names; of another column, none is left out."""
    default = name == "active"
    if name not in columns.places:
        return np.full(len(rows), default)
    fields = [row.fields[columns.places[name]].lower() for row in rows]
    where = f"column {columns.heads[name].text}"
    if not set(fields) <= set(_FLAGS):
        record.not_used(Subject.VALIDITY, sorted(set(fields))[0][:40], where, "expected 1 or 0")
        return np.full(len(rows), default)
    flags = np.array([_FLAGS[field] for field in fields], dtype=np.bool_)
    record.used(Subject.VALIDITY, f"{int(flags.sum())} of {len(flags)}", where)
    return flags


def _corner_px(columns: _Columns, head: CsvHead, record: Record) -> float:
    """Line and sample of the centre of the first pixel; NaN where the file does not state its origin."""
    if ("line" in columns.places) != ("sample" in columns.places):
        raise FormatError(f"{columns.source}: expected both columns line and sample, or none of them")
    stated = [(count, match[1]) for count, line in head.comments if (match := _ORIGIN.search(line))]
    if not stated:
        if "line" in columns.places:
            record.not_used(
                Subject.PIXEL_ORIGIN,
                "none",
                "columns line, sample",
                "a first line '# pixel-origin=centre'",
            )
        return math.nan
    count, origin = stated[-1]
    if origin not in PIXEL_ORIGINS:
        raise FormatError(
            f"{columns.source}, line {count}: pixel-origin: expected one of {', '.join(PIXEL_ORIGINS)}, "
            f"found {origin[:20]!r}"
        )
    record.used(Subject.PIXEL_ORIGIN, origin, f"line {count}")
    return PIXEL_ORIGINS[origin]


def _name(field: str, where: str) -> str:
    if not field:
        raise FormatError(f"{where}: id: expected a name, found nothing")
    return field


def _column(numbers: dict[str, Array], name: str, rows: list[CsvRow]) -> Array:
    """The numbers of a column; NaN where the file has no such column."""
    return numbers.get(name, np.full(len(rows), np.nan))


def _sigmas_m(numbers: dict[str, Array], rows: list[CsvRow], source: str) -> Array:
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


def _check_units(columns: _Columns, crs: CRS, record: Record) -> None:
    """Refuse units of x and y other than those of their system, and heights whose unit is open."""
    unit_m = horizontal_unit_m(crs)
    for name in ("x", "y"):
        head = columns.heads.get(name)
        if head is not None and head.unit_m is not None and abs(head.unit_m / unit_m - 1.0) > 1e-5:
            raise FormatError(
                f"{columns.source}, column {head.text}: {head.unit_m:g} m is its unit, but {crs.name} "
                f"has {crs.axis_info[0].unit_name}; state the reference system in that unit (--crs)"
            )
        if head is not None and head.unit_m is not None:
            record.used(Subject.UNIT, str(crs.axis_info[0].unit_name), f"column {head.text}")
    if columns.on_map:
        north_first = crs.axis_info[0].direction == "north"
        note = "the axes of the system are north, east" if north_first else ""
        record.assumed(Subject.ORDER, "x is east, y is north", "columns x, y", note)
    height = columns.heads.get("height_m")
    if height is None:
        return
    if height.unit_m is not None:
        record.used(Subject.UNIT, f"{height.unit_m:.8g} m", f"column {height.text}")
    elif height.name == "height" and columns.on_map and unit_m != 1.0:
        raise FormatError(
            f"{columns.source}, column {height.text}: the unit of the heights is not stated, and that "
            f"of {crs.name} is {crs.axis_info[0].unit_name}: name the column with its unit, such as "
            f"{height.text}_m or {height.text}_ft"
        )
    else:
        record.assumed(Subject.UNIT, "metres", f"column {height.text}")


def _ground(
    numbers: dict[str, Array],
    columns: _Columns,
    crs: CRS,
    heights: Heights | None,
    rows: list[CsvRow],
) -> Ground:
    """Points in WGS 84; points without a height need no vertical datum. NaN where ground may lack."""
    names = ("x", "y") if columns.on_map else ("lon", "lat")
    height_m = _column(numbers, "height_m", rows)
    xy = np.column_stack([_column(numbers, name, rows) for name in names])
    lacking = np.asarray(np.isnan(xy).all(axis=1) & columns.may_lack_ground)
    for (x, y), row, is_lacking in zip(xy.tolist(), rows, lacking.tolist(), strict=True):
        if is_lacking:
            continue
        if math.isnan(x) or math.isnan(y):
            raise FormatError(f"{row.where}: expected {names[0]} and {names[1]}, found an empty field")
        if not columns.on_map:
            check_lon_lat(x, y, row.where)
    points = np.column_stack([xy, height_m])[~lacking]
    lon_lat_h = np.full((len(rows), 3), np.nan)
    if lacking.all():
        return Ground(lon_lat_h, 0.0, ())
    check_axes(points, crs, columns.source)
    ground = to_wgs84(points, crs, heights, columns.source)
    lon_lat_h[~lacking] = ground.lon_lat_h
    return replace(ground, lon_lat_h=lon_lat_h)
