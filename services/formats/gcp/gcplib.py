"""Ground points of the GCP library of Landsat (USGS GCPLib), a text file for each path and row.

`#` header lines, a line `BEGIN`, a line with the number of records, then one record a line with 20
fields separated by blanks. The header announces projection x before projection y; the software of the
USGS writes and reads y before x. Source: the writer and the reader of the USGS Image Assessment System.

The structure is that of this software, to the byte. No file of the USGS itself was available.
"""

import re
from dataclasses import dataclass
from datetime import date

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.gcp.map_check import checked_zone
from amers.services.formats.gcp.marked_points import (
    WGS84_3D,
    Heights,
    MarkedPoints,
    marked_points,
    to_wgs84,
)
from amers.services.formats.gcp.record import Record
from amers.services.formats.gcp.text_lines import (
    check_lon_lat,
    content_lines,
    coordinate_array,
    parse_numbers,
)
from amers.services.statements import Subject

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


@dataclass(frozen=True)
class GcplibRecord:
    """One record: a ground point and a chip of it.

    Attributes:
        where: file and line, for messages.
        words: the fields by their names.
        numbers: those that are numbers.
        crs: code of the UTM zone of the chip; None for other maps.
        acquired_on: date of the image of the chip.
    """

    where: str
    words: dict[str, str]
    numbers: dict[str, float]
    crs: str | None
    acquired_on: date


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
    records = gcplib_records(text, source)
    places = [[r.numbers[key] for key in ("longitude", "latitude", "elevation")] for r in records]
    coordinates = coordinate_array([(lon, lat, height_m) for lon, lat, height_m in places])
    ground = to_wgs84(coordinates, WGS84_3D.to_2d(), heights, source)
    ids = [record.words["point_id"] for record in records]
    found = Record(source)
    found.assumed(Subject.HORIZONTAL_DATUM, "WGS 84", "latitude, longitude")
    found.assumed(Subject.UNIT, "metres", "elevation")
    if records:
        note = "compared with latitude and longitude"
        found.used(Subject.ORDER, "projection y before projection x", "", note)
        found.not_used(Subject.EPOCH, str(records[0].acquired_on), "date", "of the image of the chip")
        kinds = ", ".join(sorted({record.words["absolute_or_relative"] for record in records}))
        found.not_used(Subject.ACCURACY, kinds, "absolute_or_relative")
    return marked_points(ids, ground, np.full((len(ids), 2), np.nan), tuple(found.statements))


def gcplib_records(text: str, source: str = "GCPLib") -> list[GcplibRecord]:
    """The records of a GCPLib.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: as for `parse_gcplib`.
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
    return [_record(line, where) for where, line in records]


def _record(line: str, where: str) -> GcplibRecord:
    fields = line.split()
    if len(fields) != len(_FIELDS):
        raise FormatError(
            f"{where}: expected the {len(_FIELDS)} fields {' '.join(_FIELDS)}, found {len(fields)}"
        )
    words = dict(zip(_FIELDS, fields, strict=True))
    numbers = dict(zip(_NUMBERS, parse_numbers(fields[2:13], _NUMBERS, where), strict=True))
    acquired_on = _date(words["date"], where)
    if words["absolute_or_relative"] not in ("ABS", "REL"):
        raise FormatError(
            f"{where}: absolute_or_relative: expected ABS or REL, "
            f"found {words['absolute_or_relative'][:20]!r}"
        )
    lon, lat = numbers["longitude"], numbers["latitude"]
    check_lon_lat(lon, lat, where)
    code = _utm_code(words, where)
    if code is not None:
        xy = numbers["projection_x"], numbers["projection_y"]
        tolerance_m = max(abs(numbers["pixel_size_x"]), abs(numbers["pixel_size_y"]))
        code = checked_zone((lon, lat), xy, code, tolerance_m, where)
    return GcplibRecord(where, words, numbers, code, acquired_on)


def _date(text: str, where: str) -> date:
    """The date of a record; refuses what is none."""
    month_day_year = re.fullmatch(r"(\d{1,2})-(\d{1,2})-(\d{4})", text)
    try:
        if month_day_year is None:
            raise ValueError
        month, day, year = (int(part) for part in month_day_year.groups())
        return date(year, month, day)
    except ValueError:
        raise FormatError(
            f"{where}: date: expected month-day-year, such as 07-14-1999, found {text[:20]!r}"
        ) from None


def _utm_code(record: dict[str, str], where: str) -> str | None:
    """The code of the UTM zone of a record, negative zones south of the equator; None for other maps."""
    if re.fullmatch(r"-?\d+", record["zone"]) is None:
        raise FormatError(f"{where}: zone: expected a whole number, found {record['zone'][:20]!r}")
    zone = int(record["zone"])
    if record["projection"] != "UTM" or not 1 <= abs(zone) <= 60:
        return None
    return f"EPSG:{(32600 if zone > 0 else 32700) + abs(zone)}"
