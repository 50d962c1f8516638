"""Ground points of the GCP library of Landsat (USGS GCPLib), a text file for each path and row.

`#` header lines, a line `BEGIN`, a line with the number of records, then one record a line with 20
fields separated by blanks. The header announces projection x before projection y; the software of the
USGS writes and reads y before x. Source: the writer and the reader of the USGS Image Assessment System.

The structure is that of this software. No real file was available to try it on.
"""

import re
from datetime import date

import numpy as np

from services.errors import FormatError
from services.formats.gcp.map_check import check_map_position
from services.formats.gcp.marked_points import (
    WGS84_3D,
    Heights,
    MarkedPoints,
    marked_points,
    to_wgs84,
)
from services.formats.gcp.text_lines import check_lon_lat, content_lines, coordinate_array, parse_numbers

_FIELDS = [
    "point_id",
    "chip_name",
    "reference_line",
    "reference_sample",
    "latitude",
    "longitude",
    "projection_y",
    "projection_x",
    "elevation",
    "pixel_size_x",
    "pixel_size_y",
    "chip_size_lines",
    "chip_size_samples",
    "source",
    "chip_type",
    "projection",
    "zone",
    "date",
    "absolute_or_relative",
    "data_type",
]
_NUMBERS = _FIELDS[2:13]
_BEGIN = "BEGIN"


def is_gcplib(text: str) -> bool:
    """Whether a text has the line `BEGIN` after its comments."""
    return next((line for _, line in content_lines(text, "#", "")), "") == _BEGIN


def parse_gcplib(text: str, heights: Heights | None = None, source: str = "GCPLib") -> MarkedPoints:
    """The ground points of a GCPLib, which have no marks: its pixels are those of its own chips.

    Latitude and longitude are taken as those of WGS 84.

    Args:
        text: contents of the file.
        heights: datum of the elevations, which the file does not state.
        source: its name, for messages.

    Raises:
        FormatError: a record has another form, its position on the map is not that of its latitude and
            longitude, or their number is not the stated one.
        VerticalDatumError: the caller does not state the datum of the heights.
    """
    lines = list(content_lines(text, "#", source))
    if not lines or lines[0][1] != _BEGIN:
        raise FormatError(f"{source}: expected a line {_BEGIN} after the comments")
    if len(lines) < 2 or re.fullmatch(r"\d+", lines[1][1]) is None:
        found = lines[1][1][:40] if len(lines) > 1 else "nothing"
        raise FormatError(f"{source}: expected the number of records after {_BEGIN}, found {found!r}")
    records = lines[2:]
    if len(records) != int(lines[1][1]):
        raise FormatError(
            f"{source}: {lines[1][1]} records stated, {len(records)} found: the file is cut or has "
            "records that its own software would ignore; mend the number or the file"
        )
    ids, coordinates = [], []
    for where, line in records:
        fields = line.split()
        if len(fields) != len(_FIELDS):
            raise FormatError(
                f"{where}: expected the {len(_FIELDS)} fields {' '.join(_FIELDS)}, found {len(fields)}"
            )
        record = dict(zip(_FIELDS, fields, strict=True))
        numbers = dict(zip(_NUMBERS, parse_numbers(fields[2:13], _NUMBERS, where), strict=True))
        _check_words(record, where)
        lon, lat = numbers["longitude"], numbers["latitude"]
        check_lon_lat(lon, lat, where)
        code = _utm_code(record, where)
        if code is not None:
            xy = numbers["projection_x"], numbers["projection_y"]
            tolerance_m = max(abs(numbers["pixel_size_x"]), abs(numbers["pixel_size_y"]))
            check_map_position((lon, lat), xy, code, tolerance_m, where)
        ids.append(record["point_id"])
        coordinates.append((lon, lat, numbers["elevation"]))
    ground = to_wgs84(coordinate_array(coordinates), WGS84_3D.to_2d(), heights, source)
    return marked_points(ids, ground, np.full((len(ids), 2), np.nan))


def _check_words(record: dict[str, str], where: str) -> None:
    """Refuse a date or a kind of reference that no record has."""
    month_day_year = re.fullmatch(r"(\d{1,2})-(\d{1,2})-(\d{4})", record["date"])
    try:
        if month_day_year is None:
            raise ValueError
        month, day, year = (int(part) for part in month_day_year.groups())
        date(year, month, day)
    except ValueError:
        raise FormatError(
            f"{where}: date: expected month-day-year, such as 07-14-1999, found {record['date'][:20]!r}"
        ) from None
    if record["absolute_or_relative"] not in ("ABS", "REL"):
        raise FormatError(
            f"{where}: absolute_or_relative: expected ABS or REL, "
            f"found {record['absolute_or_relative'][:20]!r}"
        )


def _utm_code(record: dict[str, str], where: str) -> str | None:
    """The code of the UTM zone of a record, negative zones south of the equator; None for other maps."""
    if re.fullmatch(r"-?\d+", record["zone"]) is None:
        raise FormatError(f"{where}: zone: expected a whole number, found {record['zone'][:20]!r}")
    zone = int(record["zone"])
    if record["projection"] != "UTM" or not 1 <= abs(zone) <= 60:
        return None
    return f"EPSG:{(32600 if zone > 0 else 32700) + abs(zone)}"
