"""Marked points in text files: ASP `.gcp`, QGIS `.points`, ENVI `.pts`."""

import csv
import math
import re
from itertools import islice

import numpy as np
from pyproj import CRS

from amers.services.errors import FormatError, InputError
from amers.services.formats.gcp.marked_points import (
    WGS84_3D,
    Heights,
    MarkedPoints,
    marked_points,
    parse_crs,
    to_wgs84,
)
from amers.services.formats.gcp.text_lines import (
    check_lon_lat,
    content_lines,
    coordinate_array,
    format_deg,
    format_m,
    format_mark,
    format_px,
    parse_numbers,
    sequential_ids,
)
from amers.services.formats.text_files import NUMBER_PATTERN
from amers.services.geodesy import ecef_from_east_north_up

QGIS_CORNER_PX = 0.5
"""QGIS, like GDAL, counts pixels from the corner of the first one."""
ENVI_CORNER_PX = 1.5
"""The corner of the first pixel is (1, 1) in ENVI, hence its centre (1.5, 1.5)."""

ECEF, LAT_LON_HEIGHT = "ecef", "lat-lon-height"
"""Axes of the sigmas on the ground of an ASP `.gcp`."""
_ASP_FIXED_M = 1e-9
"""ASP writes sigmas of 1e-10 m for points that its adjustment keeps fixed."""

_QGIS_COLUMNS = ["mapX", "mapY", "sourceX", "sourceY"]
_OLDER_QGIS_COLUMNS = ["mapX", "mapY", "pixelX", "pixelY"]
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


def is_asp_gcp(text: str) -> bool:
    """Whether the first lines of a text, after comments, have fields as a point of ASP has."""
    for _, line in islice(content_lines(text, "#", ""), 5):
        fields = line.replace(",", " ").split()
        numbers = [re.fullmatch(NUMBER_PATTERN, field) is not None for field in fields]
        if len(fields) >= 12 and all(numbers[1:7]) and not numbers[7] and all(numbers[8:12]):
            return True
    return False


def parse_asp_gcp(
    text: str, heights: Heights | None = None, source: str = "GCP file", sigmas: str | None = None
) -> MarkedPoints:
    """The marked points of an ASP `.gcp`: one point on each line, with all its marks.

    The three sigmas are those of x, y, z of ECEF, unless ASP is called with
    `--use-lon-lat-height-gcp-error`. A comment with that option in the file counts as a statement. Equal
    sigmas mean the same in both. Sigmas of 1e-10 m mark fixed points, not an accuracy: they are unknown.

    Args:
        text: contents of the file; spaces or commas separate fields.
        heights: datum of the heights, which the file never states.
        source: its name, for messages.
        sigmas: axes of the sigmas, where the file does not state them: "ecef" or "lat-lon-height"; when
            they are not stated, sigmas that differ are unknown.

    Raises:
        FormatError: a line has another form.
        VerticalDatumError: the caller does not state the datum of the heights.
    """
    if sigmas is None and re.search(r"^#.*--use-lon-lat-height-gcp-error", text, re.MULTILINE):
        sigmas = LAT_LON_HEIGHT
    ids, coordinates, sigmas_m, images, pixels, sigmas_px = [], [], [], [], [], []
    for where, line in content_lines(text, "#", source):
        fields = line.replace(",", " ").split()
        if len(fields) < 12 or (len(fields) - 7) % 5:
            raise FormatError(
                f"{where}: expected id, lat, lon, height, 3 sigmas, then name, column, row and 2 sigmas "
                f"for each image, found {len(fields)} fields"
            )
        lat, lon, height_m, *of_ground_m = parse_numbers(
            fields[1:7], ["lat", "lon", "height", "sigma_1", "sigma_2", "sigma_3"], where
        )
        check_lon_lat(lon, lat, where)
        if min(of_ground_m) <= 0.0:
            raise FormatError(
                f"{where}: sigmas on the ground: expected positive metres, found {' '.join(fields[4:7])}"
            )
        of_point_m = _east_north_up_sigmas(of_ground_m, lon, lat, sigmas)
        for start in range(7, len(fields), 5):
            column, row, sigma_column, sigma_row = parse_numbers(
                fields[start + 1 : start + 5], ["column", "row", "sigma_column", "sigma_row"], where
            )
            ids.append(fields[0])
            coordinates.append((lon, lat, height_m))
            sigmas_m.append(of_point_m)
            images.append(fields[start])
            pixels.append((row, column))
            sigmas_px.append(math.sqrt((sigma_column**2 + sigma_row**2) / 2.0))
    ground = to_wgs84(coordinate_array(coordinates), WGS84_3D.to_2d(), heights, source)
    return marked_points(ids, ground, pixels, sigma_m=sigmas_m, image=images, sigma_px=sigmas_px)


def _east_north_up_sigmas(
    sigmas_m: list[float], lon: float, lat: float, axes: str | None
) -> tuple[float, float, float]:
    """Sigmas east, north, up of the three sigmas of an ASP point; NaN where their axes are unknown."""
    first_m, second_m, third_m = sigmas_m
    if max(sigmas_m) <= _ASP_FIXED_M:
        return math.nan, math.nan, math.nan
    if first_m == second_m == third_m:
        return first_m, first_m, first_m
    if axes == LAT_LON_HEIGHT:
        return second_m, first_m, third_m
    if axes == ECEF:
        to_east_north_up = ecef_from_east_north_up(np.array([lon, lat, 0.0])).T
        east_m, north_m, up_m = np.sqrt(to_east_north_up**2 @ np.array(sigmas_m) ** 2)
        return float(east_m), float(north_m), float(up_m)
    return math.nan, math.nan, math.nan


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


def is_qgis_points(text: str) -> bool:
    """Whether the first line of a text, after comments, has the columns of QGIS."""
    first = next((line for _, line in content_lines(text, "#", "")), "")
    return first.split(",")[:4] in (_QGIS_COLUMNS, _OLDER_QGIS_COLUMNS)


def parse_qgis_points(text: str, source: str = "points file") -> MarkedPoints:
    """The marked points of a QGIS `.points` of a raw image, which has no heights, names or sigmas.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: a line has another form, or the file does not state its reference system.
    """
    lines = list(content_lines(text, "#", source))
    columns = lines[0][1].split(",")[:4] if lines else []
    if columns not in (_QGIS_COLUMNS, _OLDER_QGIS_COLUMNS):
        raise FormatError(f"{source}: expected a line that starts with {','.join(_QGIS_COLUMNS)}")
    header = re.match(r"#CRS: *(\S.*)", text)
    if header is None:
        raise FormatError(
            f"{source}: the file does not state its reference system, as those of older versions of "
            "QGIS; add it as a first line such as '#CRS: EPSG:32633'"
        )
    crs = parse_crs(header[1].strip(), source)
    coordinates, pixels, active = [], [], []
    for where, line in lines[1:]:
        fields = next(csv.reader([line]))
        if len(fields) < 5:
            raise FormatError(f"{where}: expected at least 5 fields, found {len(fields)}")
        x, y, column, minus_row = parse_numbers(fields[:4], _QGIS_COLUMNS, where)
        coordinates.append((x, y, math.nan))
        pixels.append((-minus_row - QGIS_CORNER_PX, column - QGIS_CORNER_PX))
        active.append(fields[4].strip() != "0")
    ground = to_wgs84(coordinate_array(coordinates), crs.to_2d(), None, source)
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


def is_envi_pts(text: str) -> bool:
    """Whether a text has a comment of ENVI with its projection."""
    return re.search(r"^;\s*projection info\s*=", text, re.MULTILINE) is not None


def parse_envi_pts(
    text: str, heights: Heights | None = None, source: str = "ENVI points"
) -> MarkedPoints:
    """The marked points of an ENVI `.pts`, in longitude and latitude or UTM of WGS 84.

    Points of images on a map have no elevation.

    Args:
        text: contents of the file.
        heights: datum of the heights, which the file never states; those of ENVI's rigorous
            orthorectification are orthometric.
        source: its name, for messages.

    Raises:
        FormatError: a line has another form, or the projection is not supported.
        VerticalDatumError: the caller does not state the datum of the heights.
    """
    crs = _envi_crs(text, source)
    names = ["map x", "map y", "elevation", "image x", "image y"]
    if re.search(r"^;\s*Map\s*\(\s*x\s*,\s*y\s*\)", text, re.MULTILINE | re.IGNORECASE):
        names.remove("elevation")
    coordinates, pixels = [], []
    for where, line in content_lines(text, ";", source):
        fields = line.split()
        if len(fields) != len(names):
            raise FormatError(f"{where}: expected {', '.join(names)}, found {len(fields)} fields")
        values = dict(zip(names, parse_numbers(fields, names, where), strict=True))
        coordinates.append((values["map x"], values["map y"], values.get("elevation", math.nan)))
        pixels.append((values["image y"] - ENVI_CORNER_PX, values["image x"] - ENVI_CORNER_PX))
    points = coordinate_array(coordinates)
    ground = to_wgs84(points, crs, heights, source)
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
