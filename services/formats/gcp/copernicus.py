"""Ground points of the Copernicus Sentinel-2 GCP database, JSON converted from XML.

Numbers are strings, the text of an element with attributes is `#text`, and a list of one element is the
element itself. The Copernicus Data Space serves it as one gzipped tar for each tile (collection
sentinel-2-gri-l1c-gcp), with the document and, in the folder `L1C_chips`, the chips. Source: software
that downloads and reads it; its specification is not public. No file of it was available.
"""

import re
from typing import Any

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.elevation.heights import unit_m
from amers.services.formats.gcp.map_check import checked_zone
from amers.services.formats.gcp.marked_points import (
    WGS84_3D,
    Heights,
    MarkedPoints,
    marked_points,
    to_wgs84,
)
from amers.services.formats.gcp.record import Record
from amers.services.formats.gcp.text_lines import check_lon_lat, coordinate_array
from amers.services.formats.text_files import load_json, parse_number
from amers.services.statements import Subject

COPERNICUS_KEY = "GCP_DB"
"""The only member of the document."""
_PIXEL_M = 10.0
"""Ground sampling of the chips of the database."""


def parse_copernicus(
    text: str, heights: Heights | None = None, source: str = "Copernicus GCP database"
) -> MarkedPoints:
    """The ground points of a file of the database, which have no marks.

    A point that the file repeats is read once.

    Args:
        text: contents of the file.
        heights: datum of `Altimetry`, which the file does not state.
        source: its name, for messages.

    Raises:
        FormatError: the document or a point has another form, or the position of a point on its map is
            not that of its longitude and latitude.
        VerticalDatumError: the caller does not state the datum of the heights.
    """
    points: dict[str, tuple[float, float, float]] = {}
    for count, gcp in enumerate(_gcps(text, source), start=1):
        where = f"{source}, GCP {count}"
        name, position = _point(gcp, where)
        if points.setdefault(name, position) != position:
            raise FormatError(
                f"{where}: ID {name} has longitude, latitude and height {position}, and before "
                f"{points[name]}; expected one position for each ID"
            )
    ground = to_wgs84(coordinate_array(list(points.values())), WGS84_3D.to_2d(), heights, source)
    record = Record(source)
    record.assumed(Subject.HORIZONTAL_DATUM, "WGS 84", "Longitude, Latitude")
    record.used(Subject.ORDER, "X, Y in EPSG", "", "compared with longitude and latitude")
    record.used(Subject.UNIT, "metres", "Altimetry")
    if '"Quality_Indicators"' in text:
        record.not_used(Subject.ACCURACY, "Quality_Indicators")
    return marked_points(
        list(points), ground, np.full((len(points), 2), np.nan), tuple(record.statements)
    )


def copernicus_chips(text: str, source: str = "Copernicus GCP database") -> list[tuple[str, int, str]]:
    """The chips of a file of the database: ID of the point, number of the measure, name of the file.

    A measure without a name has the chip `{ID}_00.TIF`, as in the software that reads the database. A
    chip that the file repeats is listed once.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: the document or a point has another form.
    """
    chips: dict[tuple[str, str], int] = {}
    for count, gcp in enumerate(_gcps(text, source), start=1):
        name, _ = _point(gcp, f"{source}, GCP {count}")
        measures = gcp.get("GRI_List")
        measures = measures.get("GRI_Measure") if isinstance(measures, dict) else None
        for number, measure in enumerate(measures if isinstance(measures, list) else [measures]):
            chips.setdefault((name, _chip_file(measure) or f"{name}_00.TIF"), number)
    return [(name, number, file) for (name, file), number in chips.items()]


def _chip_file(measure: Any) -> str:
    """The name of the chip of a measure, in an element or in two of the same name; "" for none."""
    chips = measure.get("Chips") if isinstance(measure, dict) else None
    node = chips.get("Chip_File") if isinstance(chips, dict) else None
    if isinstance(node, dict) and "Chip_File" in node:
        node = node["Chip_File"]
    return _text(node)


def _gcps(text: str, source: str) -> list[Any]:
    document = load_json(text, source)
    root = document.get(COPERNICUS_KEY) if isinstance(document, dict) else None
    if not isinstance(root, dict) or "GCP" not in root:
        raise FormatError(f"{source}: expected {COPERNICUS_KEY} with a list GCP")
    return root["GCP"] if isinstance(root["GCP"], list) else [root["GCP"]]


def _point(gcp: Any, where: str) -> tuple[str, tuple[float, float, float]]:
    """ID, and longitude, latitude and height."""
    info = gcp.get("GCP_Info") if isinstance(gcp, dict) else None
    if not isinstance(info, dict):
        raise FormatError(f"{where}: expected a GCP_Info")
    name = _text(gcp.get("ID"))
    if not name:
        raise FormatError(f"{where}: ID: expected a name, found {gcp.get('ID')!r}")
    lon, lat, height_m, x, y = (
        parse_number(_text(info.get(key)), key, f"{where}, ID {name}")
        for key in ("Longitude", "Latitude", "Altimetry", "X", "Y")
    )
    check_lon_lat(lon, lat, f"{where}, ID {name}")
    altimetry = info.get("Altimetry")
    unit = altimetry.get("@unit", "m") if isinstance(altimetry, dict) else "m"
    height_m *= unit_m(str(unit), f"{where}, ID {name}", "Altimetry")
    epsg = _text(info.get("EPSG")).upper().removeprefix("EPSG:")
    if re.fullmatch(r"32[67](0[1-9]|[1-5]\d|60)", epsg) is None:
        raise FormatError(
            f"{where}, ID {name}: EPSG: expected the code of a UTM zone of WGS 84, such as 32633, "
            f"found {epsg[:20]!r}"
        )
    checked_zone((lon, lat), (x, y), f"EPSG:{epsg}", _PIXEL_M, f"{where}, ID {name}")
    return name, (lon, lat, height_m)


def _text(node: Any) -> str:
    """The text of an element: a string, a number, or an object with `#text`."""
    value = node.get("#text") if isinstance(node, dict) else node
    return "" if value is None or isinstance(value, (dict, list, bool)) else str(value).strip()
