"""Marked points in text files: ASP `.gcp`, QGIS `.points`, ENVI `.pts`."""

import csv
import math
import re

import numpy as np
from pyproj import CRS

from services.errors import FormatError, InputError
from services.formats.gcp.marked_points import (
    ELLIPSOID,
    WGS84_3D,
    MarkedPoints,
    marked_points,
    parse_crs,
    to_wgs84,
)
from services.formats.gcp.text_lines import (
    content_lines,
    coordinate_array,
    format_deg,
    format_m,
    format_mark,
    format_px,
    parse_numbers,
    sequential_ids,
)

QGIS_CORNER_PX = 0.5
"""QGIS, like GDAL, counts pixels from the corner of the first one."""
ENVI_CORNER_PX = 1.5
"""The corner of the first pixel is (1, 1) in ENVI, hence its centre (1.5, 1.5)."""

_QGIS_COLUMNS = ["mapX", "mapY", "sourceX", "sourceY"]
_ENVI_WGS84 = r"WGS[- ]?84"
_ENVI_UTM = re.compile(rf"UTM\s*,\s*(\d+)\s*,\s*(North|South)\s*,\s*{_ENVI_WGS84}\b", re.IGNORECASE)
_ENVI_GEOGRAPHIC = re.compile(rf"Geographic Lat/Lon\s*,\s*{_ENVI_WGS84}\b", re.IGNORECASE)


def format_asp_gcp(points: MarkedPoints) -> str:
    """The active points as an ASP `.gcp`, heights above the WGS 84 ellipsoid.

    With `--use-lon-lat-height-gcp-error` ASP reads the three sigmas on the ground as those of latitude,
    longitude and height. It counts pixels from the centre of the first one. All marks of a point are on
    one line. Spaces in names become underscores, because a space separates fields.

    Raises:
        InputError: a sigma is unknown, which ASP does not allow.
    """
    lines = [
        "# id lat lon height sigma_lat sigma_lon sigma_height [image column row sigma sigma] ...",
        "# bundle_adjust --datum WGS_1984 --use-lon-lat-height-gcp-error",
    ]
    used = points.take(points.active & ~points.check)
    for rows in _rows_of_each_point(used):
        i = rows[0]
        lon, lat, height_m = used.lon_lat_h[i]
        east_m, north_m, up_m = (_positive(value, "sigma_m", used.id[i]) for value in used.sigma_m[i])
        ground = f"{format_deg(lat)} {format_deg(lon)} {format_m(height_m)}"
        point = f"{used.id[i]} {ground} {format_m(north_m)} {format_m(east_m)} {format_m(up_m)}"
        for k in rows:
            line, sample = used.line_sample[k]
            sigma = format_px(_positive(used.sigma_px[k], "sigma_px", used.id[k]))
            image = re.sub(r"[\s,]", "_", str(used.image[k])) or "image"
            point += f" {image} {format_px(sample)} {format_px(line)} {sigma} {sigma}"
        lines.append(point)
    return "\n".join(lines) + "\n"


def parse_asp_gcp(text: str, heights: str | None = None, source: str = "GCP file") -> MarkedPoints:
    """The marked points of an ASP `.gcp`: one point on each line, with all its marks.

    Args:
        text: contents of the file; spaces or commas separate fields.
        heights: datum of the heights, which the file never states: "ellipsoid" (of WGS 84) or a vertical
            reference system.
        source: its name, for messages.

    Raises:
        FormatError: a line has another form.
        VerticalDatumError: the caller does not state the datum of the heights.
    """
    ids, coordinates, sigmas_m, images, pixels, sigmas_px = [], [], [], [], [], []
    for where, line in content_lines(text, "#", source):
        fields = line.replace(",", " ").split()
        if len(fields) < 12 or (len(fields) - 7) % 5:
            raise FormatError(
                f"{where}: expected id, lat, lon, height, 3 sigmas, then name, column, row and 2 sigmas "
                f"for each image, found {len(fields)} fields"
            )
        lat, lon, height_m, north_m, east_m, up_m = parse_numbers(
            fields[1:7], ["lat", "lon", "height", "sigma_lat", "sigma_lon", "sigma_height"], where
        )
        for start in range(7, len(fields), 5):
            column, row, sigma_column, sigma_row = parse_numbers(
                fields[start + 1 : start + 5], ["column", "row", "sigma_column", "sigma_row"], where
            )
            ids.append(fields[0])
            coordinates.append((lon, lat, height_m))
            sigmas_m.append((east_m, north_m, up_m))
            images.append(fields[start])
            pixels.append((row, column))
            sigmas_px.append(math.sqrt((sigma_column**2 + sigma_row**2) / 2.0))
    ground = to_wgs84(coordinate_array(coordinates), WGS84_3D.to_2d(), heights, source)
    return marked_points(ids, ground, pixels, sigma_m=sigmas_m, image=images, sigma_px=sigmas_px)


def format_qgis_points(points: MarkedPoints) -> str:
    """The points as a `.points` of the QGIS georeferencer: longitude and latitude of WGS 84, no heights.

    Inactive points and check points are written but not enabled. `dX`, `dY` are computed minus
    observed with lines counted upwards, as in QGIS.
    """
    rows = ["mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"]
    enabled = points.active & ~points.check
    for i in range(len(points)):
        lon, lat, _ = points.lon_lat_h[i]
        line, sample = points.line_sample[i] + QGIS_CORNER_PX
        d_line, d_sample = np.nan_to_num(points.residual_px[i])
        values = [
            format_deg(lon),
            format_deg(lat),
            format_px(sample),
            format_px(-line),
            str(int(enabled[i])),
        ]
        values += [format_px(-d_sample), format_px(d_line), format_px(math.hypot(d_line, d_sample))]
        rows.append(",".join(values))
    wkt = CRS.from_epsg(4326).to_wkt()
    return f"#CRS: {wkt}\n" + "\n".join(rows) + "\n"


def parse_qgis_points(text: str, source: str = "points file") -> MarkedPoints:
    """The marked points of a QGIS `.points` of a raw image, which has no heights, names or sigmas.

    Args:
        text: contents of the file; without `#CRS` its map coordinates are longitude and latitude.
        source: its name, for messages.

    Raises:
        FormatError: a line has another form.
    """
    header = re.match(r"#CRS: *(.*)", text)
    crs = parse_crs(header[1].strip(), source) if header and header[1].strip() else CRS.from_epsg(4326)
    lines = list(content_lines(text, "#", source))
    if not lines or lines[0][1].split(",")[:4] != _QGIS_COLUMNS:
        raise FormatError(f"{source}: expected a line that starts with {','.join(_QGIS_COLUMNS)}")
    coordinates, pixels, active = [], [], []
    for where, line in lines[1:]:
        fields = next(csv.reader([line]))
        if len(fields) < 5:
            raise FormatError(f"{where}: expected at least 5 fields, found {len(fields)}")
        x, y, column, minus_row = parse_numbers(fields[:4], _QGIS_COLUMNS, where)
        coordinates.append((x, y, 0.0))
        pixels.append((-minus_row - QGIS_CORNER_PX, column - QGIS_CORNER_PX))
        active.append(fields[4].strip() != "0")
    ground = to_wgs84(coordinate_array(coordinates), crs.to_2d(), ELLIPSOID, source)
    ground[:, 2] = np.nan
    return marked_points(sequential_ids(pixels), ground, pixels, active=active)


def format_envi_pts(points: MarkedPoints) -> str:
    """The active points as an ENVI `.pts` for its RPC tools, heights above the ellipsoid."""
    lines = [
        "; ENVI Orthorectification Ground Control Points File",
        "; projection info = {Geographic Lat/Lon, WGS-84, units=Degrees}",
        "; elevations are metres above the WGS 84 ellipsoid",
        "; Map (x,y,elev), Image (x,y)",
        ";",
    ]
    used = points.take(points.active & ~points.check)
    for i in range(len(used)):
        lines.append(format_mark(used.lon_lat_h[i], used.line_sample[i] + ENVI_CORNER_PX))
    return "\n".join(lines) + "\n"


def parse_envi_pts(text: str, heights: str | None = None, source: str = "ENVI points") -> MarkedPoints:
    """The marked points of an ENVI `.pts` with elevations, in longitude and latitude or UTM of WGS 84.

    Args:
        text: contents of the file.
        heights: datum of the heights, which the file never states: "ellipsoid" or a vertical reference
            system.
        source: its name, for messages.

    Raises:
        FormatError: a line has another form, or the projection is not supported.
        VerticalDatumError: the caller does not state the datum of the heights.
    """
    crs = _envi_crs(text, source)
    coordinates, pixels = [], []
    for where, line in content_lines(text, ";", source):
        fields = line.split()
        if len(fields) != 5:
            raise FormatError(
                f"{where}: expected map x, y, elevation, image x, y, found {len(fields)} fields"
            )
        x, y, height_m, column, row = parse_numbers(
            fields, ["map x", "map y", "elevation", "image x", "image y"], where
        )
        coordinates.append((x, y, height_m))
        pixels.append((row - ENVI_CORNER_PX, column - ENVI_CORNER_PX))
    ground = to_wgs84(coordinate_array(coordinates), crs, heights, source)
    return marked_points(sequential_ids(pixels), ground, pixels)


def _envi_crs(text: str, source: str) -> CRS:
    info = re.search(r"^;\s*projection info\s*=\s*\{([^}\n]*)\}", text, re.MULTILINE)
    projection = info[1].strip() if info else ""
    utm = _ENVI_UTM.match(projection)
    if utm is not None and 1 <= int(utm[1]) <= 60:
        return CRS.from_epsg((32600 if utm[2].lower() == "north" else 32700) + int(utm[1]))
    if _ENVI_GEOGRAPHIC.match(projection):
        return CRS.from_epsg(4326)
    raise FormatError(
        f"{source}: projection info: expected Geographic Lat/Lon or UTM with WGS-84, "
        f"found {projection[:60] or 'none'!r}"
    )


def _rows_of_each_point(points: MarkedPoints) -> list[list[int]]:
    """The rows of each point, in the order of first occurrence."""
    rows: dict[str, list[int]] = {}
    for i, point in enumerate(points.id.tolist()):
        rows.setdefault(point, []).append(i)
    return list(rows.values())


def _positive(value: float, name: str, point: str) -> float:
    """The value, or an InputError when it is not positive."""
    if not value > 0.0:
        state = "unknown" if math.isnan(value) else f"{value:g}"
        raise InputError(f"point {point}: {name} is {state}; an ASP file needs positive sigmas")
    return float(value)
