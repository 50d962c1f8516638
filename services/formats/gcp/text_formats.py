"""Marked points in text files: ASP `.gcp`, QGIS `.points`, ENVI `.pts`."""

import csv
import math
import re
from itertools import islice

import numpy as np
from pyproj import CRS

from amers.services.errors import FormatError, InputError
from amers.services.formats.gcp.comments import (
    agreed_heights,
    check_axes,
    comment_lines,
    read_comments,
)
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
    format_deg,
    format_m,
    format_mark,
    format_px,
    parse_numbers,
    sequential_ids,
)
from amers.services.formats.text_files import NUMBER_PATTERN
from amers.services.geodesy import ecef_from_east_north_up
from amers.services.statements import Subject

QGIS_CORNER_PX = 0.5
"""QGIS, like GDAL, counts pixels from the corner of the first one."""
_ABOVE_IMAGE_PX = 200_000.0
"""No mark of QGIS lies so far above its image: it is a map coordinate."""
ENVI_CORNER_PX = 1.5
"""The corner of the first pixel is (1, 1) in ENVI, hence its centre (1.5, 1.5)."""

ECEF, LAT_LON_HEIGHT = "ecef", "lat-lon-height"
"""Axes of the sigmas on the ground of an ASP `.gcp`."""
_ASP_FIXED_M = 1e-9
"""ASP writes sigmas of 1e-10 m for points that its adjustment keeps fixed."""

_QGIS_COLUMNS = ["mapX", "mapY", "sourceX", "sourceY"]
_OLDER_QGIS_COLUMNS = ["mapX", "mapY", "pixelX", "pixelY"]
_ENVI_WGS84 = r"WGS[- ]?84"
_ENVI_UTM = re.compile(
    rf"UTM\s*,\s*(\d+)\s*,\s*(North|South)\s*,\s*{_ENVI_WGS84}\s*(?:,\s*units\s*=\s*(\S+))?",
    re.IGNORECASE,
)
_ENVI_GEOGRAPHIC = re.compile(
    rf"Geographic Lat/Lon\s*,\s*{_ENVI_WGS84}\s*(?:,\s*units\s*=\s*(\S+))?", re.IGNORECASE
)


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
        fields = _asp_fields(line)
        numbers = [re.fullmatch(NUMBER_PATTERN, field) is not None for field in fields]
        if len(fields) >= 12 and all(numbers[1:7]) and not numbers[7] and all(numbers[8:12]):
            return True
    return False


def _asp_fields(line: str) -> list[str]:
    """The fields of a point, without a comment after them."""
    return re.split(r"\s#", line, maxsplit=1)[0].replace(",", " ").split()


def parse_asp_gcp(
    text: str, heights: Heights | None = None, source: str = "GCP file", sigmas: str | None = None
) -> MarkedPoints:
    """The marked points of an ASP `.gcp`: one point on each line, with all its marks.

    A comment may state the datum: `# WKT: GEOGCS[...]`, or `--datum`; without one it is WGS 84. The
    three sigmas are those of x, y, z of ECEF, unless ASP is called with the option
    `--use-lon-lat-height-gcp-error`; a comment with it counts as a statement. Equal sigmas mean the same
    in both. Sigmas of 1e-10 m mark fixed points, not an accuracy: they are unknown.

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
    record = Record(source)
    crs, datum = _asp_datum(text, heights, source, record)
    ids, coordinates, sigmas_m, images, pixels, sigmas_px = [], [], [], [], [], []
    of_ground = []
    for where, line in content_lines(text, "#", source):
        fields = _asp_fields(line)
        if len(fields) < 7 or (len(fields) - 7) % 5:
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
        of_ground.append(of_ground_m)
        of_point_m = _east_north_up_sigmas(of_ground_m, lon, lat, sigmas)
        for image, row, column, sigma_px in _asp_marks(fields[7:], where):
            ids.append(fields[0])
            coordinates.append((lon, lat, height_m))
            sigmas_m.append(of_point_m)
            images.append(image)
            pixels.append((row, column))
            sigmas_px.append(sigma_px)
    points = coordinate_array(coordinates)
    check_axes(points, crs, source)
    ground = to_wgs84(points, crs.to_2d(), datum, source)
    record.assumed(Subject.UNIT, "metres", "heights and sigmas")
    record.assumed(Subject.PIXEL_ORIGIN, "the centre of the first pixel is 0, 0")
    of_sigmas = np.array(sigmas_m)
    if len(ids) and np.isnan(of_sigmas).all():
        note = "their axes are not stated: --sigma-axes"
        if all(max(of_point) <= _ASP_FIXED_M for of_point in of_ground):
            note = "points that ASP keeps fixed"
        record.not_used(Subject.ACCURACY, "sigmas on the ground", "", note)
    elif len(ids):
        record.used(Subject.ACCURACY, f"sigmas {sigmas or 'equal in all axes'}")
    return marked_points(
        ids,
        ground,
        pixels,
        statements=tuple(record.statements),
        sigma_m=sigmas_m,
        image=images,
        sigma_px=sigmas_px,
    )


def _asp_marks(fields: list[str], where: str) -> list[tuple[str, float, float, float]]:
    """Image, row, column and sigma of each mark of a point; one without a position where it has none."""
    marks = []
    for start in range(0, len(fields), 5):
        column, row, sigma_column, sigma_row = parse_numbers(
            fields[start + 1 : start + 5], ["column", "row", "sigma_column", "sigma_row"], where
        )
        sigma_px = math.sqrt((sigma_column**2 + sigma_row**2) / 2.0)
        marks.append((fields[start], row, column, sigma_px))
    return marks or [("", math.nan, math.nan, math.nan)]


def _asp_datum(
    text: str, heights: Heights | None, source: str, record: Record
) -> tuple[CRS, Heights | None]:
    """The geographic system of the points, and the datum of their heights, by comments and caller."""
    comments = read_comments(comment_lines(text, "#"), source)
    record.statements += comments.statements
    for count, line in comment_lines(text, "#"):
        names = re.findall(r"\b(?:lat|lon|long)", line.lower())
        if line.lower().startswith("id") and names[:1] in (["lon"], ["long"]):
            raise FormatError(
                f"{source}, line {count}: the order {line[:60]!r} stated, expected latitude before "
                "longitude as ASP reads them; exchange the columns"
            )
    if comments.crs is None:
        record.assumed(Subject.HORIZONTAL_DATUM, "WGS 84", "", "a line '# WKT: ...' states another")
    crs = comments.crs or WGS84_3D
    if not crs.is_geographic:
        raise FormatError(
            f"{source}: {crs.name} stated in a comment, but points of ASP have latitude and longitude; "
            "expected a geographic system, or give the points as CSV with x and y"
        )
    return crs, agreed_heights(comments.heights, heights, source)


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
    comments = read_comments(comment_lines(text, "#"), source)
    crs = comments.crs
    if crs is None:
        raise FormatError(
            f"{source}: the file does not state its reference system, as those of older versions of "
            "QGIS; add it as a first line such as '#CRS: EPSG:32633'"
        )
    names = lines[0][1].split(",")
    record = Record(source, list(comments.statements))
    coordinates, pixels, active = [], [], []
    for where, line in lines[1:]:
        fields = next(csv.reader([line]))
        if not 5 <= len(fields) <= max(len(names), 5):
            raise FormatError(
                f"{where}: expected {len(names)} fields with decimal points, found {len(fields)}"
            )
        x, y, column, minus_row = parse_numbers(fields[:4], names[:4], where)
        if minus_row > _ABOVE_IMAGE_PX:
            raise FormatError(
                f"{where}: {names[3]}: expected 0 or less, as QGIS counts the lines of an image without "
                f"a map, found {minus_row:g}, a coordinate of an image that is on a map or a line "
                "that counts downwards; mark the points in the raw image"
            )
        coordinates.append((x, y, math.nan))
        pixels.append((-minus_row - QGIS_CORNER_PX, column - QGIS_CORNER_PX))
        active.append(_is_enabled(fields[4], where))
    points = coordinate_array(coordinates)
    check_axes(points, crs, source)
    ground = to_wgs84(points, crs.to_2d(), None, source)
    record.assumed(Subject.PIXEL_ORIGIN, "the corner of the first pixel is 0, 0, lines negative")
    record.used(Subject.VALIDITY, f"{sum(active)} of {len(active)} points enabled", "column enable")
    if len(names) > 5:
        record.not_used(Subject.ACCURACY, ", ".join(names[5:]), "", "residuals of a fit in QGIS")
    return marked_points(
        sequential_ids(pixels), ground, pixels, statements=tuple(record.statements), active=active
    )


def _is_enabled(field: str, where: str) -> bool:
    word = field.strip().lower()
    if word in ("1", "1.0", "true", "yes"):
        return True
    if word in ("0", "0.0", "false", "no"):
        return False
    raise FormatError(f"{where}: enable: expected 1 or 0, found {field[:20]!r}")


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
    record = Record(source)
    crs = _envi_crs(text, source, record)
    described = [line for line in comment_lines(text, ";") if not line[1].startswith("projection info")]
    comments = read_comments(described, source)
    if comments.crs is not None:
        raise FormatError(
            f"{source}: {comments.crs.name} stated in a comment beside the projection info; expected "
            "one reference system: remove the comment"
        )
    record.statements += comments.statements
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
    check_axes(points, crs, source)
    ground = to_wgs84(points, crs, agreed_heights(comments.heights, heights, source), source)
    if "elevation" in names:
        record.assumed(Subject.UNIT, "metres", "elevations")
    record.assumed(Subject.PIXEL_ORIGIN, "the corner of the first pixel is 1, 1")
    return marked_points(sequential_ids(pixels), ground, pixels, tuple(record.statements))


def _envi_crs(text: str, source: str, record: Record) -> CRS:
    info = re.search(r"^;\s*projection info\s*=\s*\{([^}\n]*)\}", text, re.MULTILINE)
    projection = info[1].strip() if info else ""
    utm, geographic = _ENVI_UTM.fullmatch(projection), _ENVI_GEOGRAPHIC.fullmatch(projection)
    crs = None
    if (
        utm is not None
        and 1 <= int(utm[1]) <= 60
        and (utm[3] or "meters").lower() in ("meters", "metres")
    ):
        crs = CRS.from_epsg((32600 if utm[2].lower() == "north" else 32700) + int(utm[1]))
    if geographic is not None and (geographic[1] or "degrees").lower() == "degrees":
        crs = CRS.from_epsg(4326)
    if crs is None:
        raise FormatError(
            f"{source}: projection info: expected Geographic Lat/Lon in degrees or UTM in metres with "
            f"WGS-84, found {projection[:60] or 'none'!r}"
        )
    if "units" in projection:
        record.used(Subject.UNIT, projection.rpartition("=")[2], "projection info")
    return crs


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
