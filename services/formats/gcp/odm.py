"""Marked points in the `gcp_list.txt` of OpenDroneMap.

Source: OpenDroneMap, "Ground Control Points", and `opendm/gcp.py`, which adds half a pixel to convert to
positions from the image centre: the centre of the first pixel is (0, 0).
"""

import math
import re

import numpy as np
from pyproj import CRS

from amers.services.errors import FormatError
from amers.services.formats.gcp.comments import (
    agreed_heights,
    check_axes,
    comment_lines,
    earth_crs,
    read_comments,
)
from amers.services.formats.gcp.marked_points import (
    Ground,
    Heights,
    MarkedPoints,
    horizontal_unit_m,
    marked_points,
    to_wgs84,
)
from amers.services.formats.gcp.record import Record
from amers.services.formats.gcp.text_lines import (
    content_lines,
    coordinate_array,
    format_mark,
    parse_numbers,
)
from amers.services.statements import Subject

_UTM = re.compile(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS]?)", re.IGNORECASE)
_DEFINITION = re.compile(r"EPSG:\d+(?:\+\S+)?|\+(?:proj|init)\s*=.*", re.IGNORECASE)
_NAMES = ["geo_x", "geo_y", "geo_z", "im_x", "im_y"]
_IMAGE_ENDING = re.compile(r"\.(?:jpe?g|tiff?|png|jp2|img|ntf|nitf|dng|heic|webp|bmp)$", re.IGNORECASE)
_CHECK = "CHK-"
"""Prefix of the names of check points."""


def is_gcp_list(text: str) -> bool:
    """Whether the first line of a text, after comments, is a reference system alone."""
    first = next((line for _, line in content_lines(text, "#", "")), "")
    return _UTM.fullmatch(first) is not None or _DEFINITION.fullmatch(first) is not None


def format_gcp_list(points: MarkedPoints) -> str:
    """The active points and the check points as a `gcp_list.txt`, in longitude and latitude.

    ODM does not convert heights: here they are above the WGS 84 ellipsoid, "nan" where unknown. Spaces
    in names become underscores, because a space separates fields.
    """
    lines = ["EPSG:4326", "# heights are metres above the WGS 84 ellipsoid"]
    used = points.take(points.active | points.check)
    for i in range(len(used)):
        mark = format_mark(used.lon_lat_h[i], used.line_sample[i])
        image = re.sub(r"\s", "_", str(used.image[i])) or "image"
        name = re.sub(r"\s", "_", str(used.id[i]))
        lines.append(f"{mark} {image} {_CHECK if used.check[i] else ''}{name}")
    return "\n".join(lines) + "\n"


def parse_gcp_list(
    text: str, heights: Heights | None = None, source: str = "gcp_list.txt"
) -> MarkedPoints:
    """The marked points of a `gcp_list.txt`: a reference system, then one mark on each line.

    Points without a name are distinguished by their ground coordinates, as in ODM. Heights have the unit
    of a projected reference system, such as feet.

    Args:
        text: contents of the file; spaces or tabs separate fields.
        heights: datum of the heights where the reference system has none: "ellipsoid" or a vertical
            reference system.
        source: its name, for messages.

    Raises:
        FormatError: a line has another form.
        VerticalDatumError: neither the file nor the caller states the datum of the heights.
    """
    lines = list(content_lines(text, "#", source))
    if not lines:
        raise FormatError(f"{source}: expected a reference system in the first line, found nothing")
    crs = _crs(lines[0][1], source)
    unit_m = (
        horizontal_unit_m(crs) if len(crs.axis_info) < 3 else crs.axis_info[2].unit_conversion_factor
    )
    comments = read_comments(comment_lines(text, "#"), source, unit_m)
    if comments.crs is not None and comments.crs != crs:
        raise FormatError(
            f"{source}: {comments.crs.name} stated in a comment, {crs.name} in the first line; expected "
            "one reference system: remove the comment, or correct the first line"
        )
    record = Record(source, list(comments.statements))
    zone = _UTM.fullmatch(lines[0][1])
    if zone is not None and not zone[2]:
        record.assumed(Subject.HORIZONTAL_DATUM, f"{crs.name}, the northern one", "first line")
    ids, coordinates, pixels, images = [], [], [], []
    unnamed: dict[tuple[str, ...], str] = {}
    for where, line in lines[1:]:
        fields = _fields(line)
        if len(fields) < 6:
            raise FormatError(
                f"{where}: expected {', '.join(_NAMES)}, image_name and optionally gcp_name, "
                f"found {len(fields)} fields"
            )
        x, y, column, row = parse_numbers(fields[:2] + fields[3:5], _NAMES[:2] + _NAMES[3:], where)
        name = unnamed.setdefault(tuple(fields[:3]), str(len(unnamed) + 1))
        ids.append(fields[6] if len(fields) > 6 else name)
        coordinates.append((x, y, _height(fields[2], where)))
        pixels.append((row, column))
        images.append(fields[5])
        if fields[7:]:
            record.not_used(Subject.IDENTITY, " ".join(fields[7:])[:60], where.rpartition(", ")[2])
    check = [name.upper().startswith(_CHECK) for name in ids]
    ground = _ground(coordinates, crs, agreed_heights(comments.heights, heights, source), record)
    if any(check):
        record.used(Subject.VALIDITY, f"{sum(check)} check points", f"names with {_CHECK}")
    record.assumed(Subject.PIXEL_ORIGIN, "the centre of the first pixel is 0, 0")
    return marked_points(
        [name[len(_CHECK) :] if held_out else name for name, held_out in zip(ids, check, strict=True)],
        ground,
        pixels,
        statements=tuple(record.statements),
        image=images,
        check=check,
    )


def _fields(line: str) -> list[str]:
    """The fields of a mark; the name of an image may have spaces, up to its ending."""
    fields = line.split("\t") if line.count("\t") >= 5 else line.split()
    fields = [field.strip() for field in fields]
    ends = [place for place, field in enumerate(fields) if place >= 5 and _IMAGE_ENDING.search(field)]
    if ends:
        fields[5 : ends[0] + 1] = [" ".join(fields[5 : ends[0] + 1])]
    return fields


def _height(field: str, where: str) -> float:
    return math.nan if field.lower() == "nan" else parse_numbers([field], ["geo_z"], where)[0]


def _ground(
    coordinates: list[tuple[float, float, float]], crs: CRS, heights: Heights | None, record: Record
) -> Ground:
    """Points in WGS 84; points without a height have none here, and need no vertical datum."""
    points = coordinate_array(coordinates)
    check_axes(points, crs, record.file)
    missing = np.isnan(points[:, 2])
    if len(crs.axis_info) < 3:
        points[:, 2] *= horizontal_unit_m(crs)
        if not missing.all():
            unit = crs.axis_info[0].unit_name if crs.is_projected else "metre"
            record.assumed(Subject.UNIT, unit, "heights", "the unit of the reference system")
    return to_wgs84(points, crs, heights, record.file)


def _crs(line: str, source: str) -> CRS:
    """The reference system of the first line: a code, a PROJ string, or "WGS84 UTM" with a zone."""
    utm = _UTM.fullmatch(line)
    if utm is not None and 1 <= int(utm[1]) <= 60:
        return CRS.from_epsg((32700 if utm[2].upper() == "S" else 32600) + int(utm[1]))
    return earth_crs(line, f"{source}, first line")
