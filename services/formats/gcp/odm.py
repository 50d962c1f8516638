"""Marked points as OpenDroneMap has them: `gcp_list.txt`.

Source: OpenDroneMap, "Ground Control Points", and `opendm/gcp.py`, which adds half a pixel before it
counts from the middle of an image: the centre of the first pixel is (0, 0).
"""

import math
import re

import numpy as np
from pyproj import CRS

from services.errors import FormatError
from services.formats.gcp.marked_points import (
    ELLIPSOID,
    MarkedPoints,
    crs_from,
    ground_from,
    marked_points,
)
from services.formats.gcp.text_lines import coordinate_array, format_mark, lines_of, numbers_of

_UTM = re.compile(r"WGS84\s+UTM\s+(\d{1,2})\s*([NS]?)", re.IGNORECASE)
_NAMES = ["geo_x", "geo_y", "geo_z", "im_x", "im_y"]
_CHECK = "CHK-"
"""What the names of check points begin with."""


def format_gcp_list(points: MarkedPoints) -> str:
    """The active points and the check points as a `gcp_list.txt`, in longitude and latitude.

    ODM takes heights as they are: here they are above the WGS 84 ellipsoid, "nan" where unknown. Blanks
    in names, which would end them, become underscores.
    """
    lines = ["EPSG:4326", "# heights are metres above the WGS 84 ellipsoid"]
    used = points.take(points.active | points.check)
    for i in range(len(used)):
        mark = format_mark(used.lon_lat_h[i], used.line_sample[i])
        image = re.sub(r"\s", "_", str(used.image[i])) or "image"
        name = re.sub(r"\s", "_", str(used.id[i]))
        lines.append(f"{mark} {image} {_CHECK if used.check[i] else ''}{name}")
    return "\n".join(lines) + "\n"


def parse_gcp_list(text: str, heights: str | None = None, source: str = "gcp_list.txt") -> MarkedPoints:
    """Read a `gcp_list.txt`: its reference system, then one mark a line, blanks or tabs between fields.

    Points without a name are told apart by their ground coordinates, as ODM does it.

    Args:
        text: contents of the file.
        heights: above what, where the reference system has none: "ellipsoid" or a vertical one.
        source: its name, for the messages.

    Raises:
        FormatError: when a line is not of that form.
        VerticalDatumError: when nobody says what the heights are above.
    """
    said = list(lines_of(text, "#", source))
    if not said:
        raise FormatError(f"{source}: expected a reference system in the first line, found nothing")
    crs = _crs(said[0][1], source)
    ids, coordinates, pixels, images = [], [], [], []
    unnamed: dict[tuple[str, ...], str] = {}
    for where, line in said[1:]:
        fields = line.split()
        if len(fields) < 6:
            raise FormatError(
                f"{where}: expected {', '.join(_NAMES)}, image_name and perhaps gcp_name, "
                f"found {len(fields)} fields"
            )
        x, y, column, row = numbers_of(fields[:2] + fields[3:5], _NAMES[:2] + _NAMES[3:], where)
        name = unnamed.setdefault(tuple(fields[:3]), str(len(unnamed) + 1))
        ids.append(fields[6] if len(fields) > 6 else name)
        coordinates.append((x, y, _height(fields[2], where)))
        pixels.append((row, column))
        images.append(fields[5])
    check = [name.upper().startswith(_CHECK) for name in ids]
    return marked_points(
        [name[len(_CHECK) :] if held_out else name for name, held_out in zip(ids, check, strict=True)],
        _ground(coordinates, crs, heights, source),
        pixels,
        image=images,
        check=check,
    )


def _height(field: str, where: str) -> float:
    return math.nan if field.lower() == "nan" else numbers_of([field], ["geo_z"], where)[0]


def _ground(
    coordinates: list[tuple[float, float, float]], crs: CRS, heights: str | None, source: str
) -> np.ndarray:
    """Points on the ellipsoid; those without a height keep none, and ask for no datum of it."""
    given = coordinate_array(coordinates)
    missing = np.isnan(given[:, 2])
    above = ELLIPSOID if missing.all() else heights
    ground = ground_from(np.nan_to_num(given, nan=0.0), crs, above, source)
    ground[missing, 2] = np.nan
    return ground


def _crs(line: str, source: str) -> CRS:
    """The reference system of the first line: a code, a PROJ string, or "WGS84 UTM" with its zone."""
    utm = _UTM.fullmatch(line)
    if utm is not None and 1 <= int(utm[1]) <= 60:
        return CRS.from_epsg((32700 if utm[2].upper() == "S" else 32600) + int(utm[1]))
    return crs_from(line, source)
