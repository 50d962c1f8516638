"""Marked points in JSON: Amers and Orthority GeoJSON, and the control points of OPF 1.0 (Pix4D)."""

import hashlib
import json
import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
from pyproj import CRS

from amers.services.errors import FormatError, InputError, VerticalDatumError
from amers.services.formats.gcp.comments import check_axes, earth_crs
from amers.services.formats.gcp.csv_columns import read_head
from amers.services.formats.gcp.marked_points import (
    ELLIPSOID,
    MarkedPoints,
    horizontal_unit_m,
    marked_points,
    to_wgs84,
)
from amers.services.formats.gcp.record import Record
from amers.services.formats.gcp.text_lines import check_lon_lat
from amers.services.formats.text_files import load_json
from amers.services.statements import Subject, gathered
from amers.services.types import Array, Measures

OPF_FORMAT = "application/opf-input-control-points+json"
_OPF_FORMATS = (OPF_FORMAT, OPF_FORMAT.removeprefix("application/"))
"""The name in the examples of the specification, and the one in its text."""
OPF_CORNER_PX = 0.5
"""OPF counts pixels from the corner of the first one."""
OPF_EXTENSION = "AMERS_images"
"""Extension of OPF with the names of the images, which OPF itself stores in a separate camera list."""


PIXEL_ORIGIN_OF_GEOJSON = "the centre of the first pixel is line 0, sample 0"
HEIGHTS_OF_GEOJSON = "metres above the WGS 84 ellipsoid"


def format_measures(measures: Measures, image: str, sigma_m: Array) -> str:
    """GeoJSON of the points of a registration: positions on the ground and in the scene, and status.

    Args:
        measures: of all n points within the scene.
        image: name of the scene.
        sigma_m: (n, 3) of the points, east, north, up; NaN where unknown.
    """
    numbers = {
        "predicted_line": measures.predicted[:, 0],
        "predicted_sample": measures.predicted[:, 1],
        **measured_numbers(measures),
        "sigma_east_m": sigma_m[:, 0],
        "sigma_north_m": sigma_m[:, 1],
        "sigma_up_m": sigma_m[:, 2],
    }
    features = [
        {
            "type": "Feature",
            "id": int(measures.point_id[i]),
            "geometry": {"type": "Point", "coordinates": [float(v) for v in lon_lat_h]},
            "properties": {
                "status": measures.status(i),
                "reason": str(measures.reason[i]),
                "views": int(measures.views[i]),
                **{name: _finite_or_none(float(values[i])) for name, values in numbers.items()},
            },
        }
        for i, lon_lat_h in enumerate(measures.lon_lat_h)
    ]
    document = {
        "type": "FeatureCollection",
        "image": image,
        "pixel_origin": PIXEL_ORIGIN_OF_GEOJSON,
        "heights": HEIGHTS_OF_GEOJSON,
        "features": features,
    }
    return json.dumps(document, allow_nan=False) + "\n"


def measured_numbers(measures: Measures) -> dict[str, Array]:
    """The measured values (n,) of each point, by their names in files; NaN where it was not matched."""
    return {
        "line": measures.line_sample[:, 0],
        "sample": measures.line_sample[:, 1],
        "sigma_px": measures.sigma_px,
        "score": measures.score,
        "residual_line_px": measures.residual_px[:, 0],
        "residual_sample_px": measures.residual_px[:, 1],
        "residual_east_m": measures.residual_m[:, 0],
        "residual_north_m": measures.residual_m[:, 1],
    }


def parse_geojson_points(text: str, source: str = "GeoJSON") -> MarkedPoints:
    """The marked points of a GeoJSON: of a registration, of a user or of Orthority.

    Positions are longitude and latitude of WGS 84, or in the reference system of the member `crs`, which
    older GeoJSON has, east first.

    Each feature is a Point with longitude, latitude and height. Its properties are `line` and
    `sample`, from the centre of the first pixel, or Orthority's `ji` (column, row). Optional: `id`,
    `image` or `filename`, `sigma_px`, `sigma_east_m`, `sigma_north_m`, `sigma_up_m`, `check`, and
    `status`: a point with a status other than "active" is not active. Features without a position in
    the image are points that are not marked.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: the document or a feature has another form.
        VerticalDatumError: a point has no height.
    """
    document = load_json(text, source)
    document = document if isinstance(document, dict) else {}
    features = document.get("features")
    if document.get("type") != "FeatureCollection" or not isinstance(features, list):
        raise FormatError(f"{source}: expected a GeoJSON FeatureCollection")
    record = Record(source)
    crs = _geojson_crs(document, source, record)
    image = str(document.get("image") or "")
    rows = [
        _geojson_row(feature, f"{source}, feature {count}", image, str(count))
        for count, feature in enumerate(features, start=1)
    ]
    if crs is not None and rows:
        given = np.array([row["lon_lat_h"] for row in rows])
        check_axes(given, crs, source)
        ground = to_wgs84(given, crs, None if crs.is_compound else ELLIPSOID, source)
        record.statements += ground.statements
        for row, position in zip(rows, ground.lon_lat_h.tolist(), strict=True):
            row["lon_lat_h"] = position
            row["sigma_m"][:2] = np.hypot(row["sigma_m"][:2], ground.sigma_m).tolist()
    for count, row in enumerate(rows, start=1):
        lon, lat, _ = row["lon_lat_h"]
        check_lon_lat(lon, lat, f"{source}, feature {count}")
    _record_properties(features, rows, record)
    return _points_from_rows(rows, record)


def format_opf(points: MarkedPoints) -> str:
    """The active points and the check points as input control points of OPF 1.0, in EPSG:4979.

    The id of a camera is a hash of the name of its image; an extension lists the names.

    Raises:
        InputError: a sigma is unknown, which OPF does not allow.
    """
    used = points.take(points.active | points.check)
    gcps: dict[str, dict[str, Any]] = {}
    for i, point in enumerate(used.id.tolist()):
        lon, lat, height_m = used.lon_lat_h[i].tolist()
        east_m, north_m, up_m = used.sigma_m[i].tolist()
        if not np.isfinite([east_m, north_m, up_m, used.sigma_px[i]]).all():
            raise InputError(f"point {point}: a sigma is unknown; OPF needs the sigmas of every point")
        gcp = gcps.setdefault(
            point,
            {
                "id": point,
                "geolocation": {
                    "crs": {"definition": "EPSG:4979"},
                    "coordinates": [lat, lon, height_m],
                    "sigmas": [north_m, east_m, up_m],
                },
                "marks": [],
                "is_checkpoint": bool(used.check[i]),
            },
        )
        line, sample = (used.line_sample[i] + OPF_CORNER_PX).tolist()
        gcp["marks"].append(
            {
                "camera_id": opf_camera_id(str(used.image[i])),
                "position_px": [sample, line],
                "accuracy": float(used.sigma_px[i]),
            }
        )
    images = {str(opf_camera_id(name)): name for name in dict.fromkeys(used.image.tolist())}
    document = {
        "format": OPF_FORMAT,
        "version": "1.0",
        "gcps": list(gcps.values()),
        "mtps": [],
        "extensions": {OPF_EXTENSION: images},
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def opf_camera_id(image: str) -> int:
    """The camera id of an image: the first 48 bits of the SHA-256 of its name.

    Readers with floating-point numbers keep 48 bits exactly.
    """
    return int.from_bytes(hashlib.sha256(image.encode()).digest()[:6], "big")


def parse_opf(text: str, source: str = "OPF") -> MarkedPoints:
    """The marked points of the input control points of OPF 1.0.

    The extension of Amers gives the names of the images; without it the name is the id of the camera.
    Heights are those of the CRS of each point; where it is two-dimensional, OPF says "the ellipsoid",
    which is taken as that of WGS 84, as GNSS gives.

    Args:
        text: contents of the file.
        source: its name, for messages.

    Raises:
        FormatError: the document or a point has another form.
        VerticalDatumError: heights need a grid that is not installed.
    """
    document = load_json(text, source)
    if not isinstance(document, dict) or document.get("format") not in _OPF_FORMATS:
        raise FormatError(f"{source}: expected a document of the format {OPF_FORMAT}")
    if not str(document.get("version", "")).startswith("1."):
        raise FormatError(f"{source}: expected OPF 1, found version {document.get('version')!r}")
    gcps = document.get("gcps")
    if not isinstance(gcps, list):
        raise FormatError(f"{source}: expected a list of gcps")
    extensions = document.get("extensions")
    names = extensions.get(OPF_EXTENSION) if isinstance(extensions, dict) else None
    images = names if isinstance(names, dict) else {}
    record = Record(source)
    rows = []
    for count, gcp in enumerate(gcps, start=1):
        rows += _opf_rows(gcp, images, f"{source}, gcp {count}", record)
    if document.get("mtps"):
        record.not_used(Subject.IDENTITY, f"{len(document['mtps'])} manual tie points", "mtps")
    if not images and any(row["image"] for row in rows):
        note = "the ids of the cameras are taken as names of images"
        record.assumed(Subject.IDENTITY, str(rows[0]["image"]), "camera_id", note)
    record.assumed(Subject.PIXEL_ORIGIN, "the corner of the first pixel is 0, 0")
    if any(row["check"] for row in rows):
        record.used(Subject.VALIDITY, "check points", "is_checkpoint")
    return _points_from_rows(rows, record)


_NOT_MARKED = (math.nan, math.nan)

Row = dict[str, Any]
"""One mark: values by the attribute names of `MarkedPoints`."""


def _points_from_rows(rows: list[Row], record: Record) -> MarkedPoints:
    columns: dict[str, Any] = {name: [row[name] for row in rows] for name in rows[0]} if rows else {}
    return marked_points(
        columns.pop("id", []),
        columns.pop("lon_lat_h", []),
        columns.pop("line_sample", []),
        gathered(record.statements),
        **columns,
    )


_GEOJSON_STATEMENTS = {
    "pixel_origin": (Subject.PIXEL_ORIGIN, PIXEL_ORIGIN_OF_GEOJSON),
    "heights": (Subject.VERTICAL_DATUM, HEIGHTS_OF_GEOJSON),
}
_OF_AMERS = re.compile(r"predicted_\w+|residual_\w+|score|reason|views|info|image|filename|id")
"""Properties that Amers or Orthority write for people."""
_READ_PROPERTIES = {"ji", "line", "sample", "sigma_px", "sigma_east_m", "sigma_north_m", "sigma_up_m"}


def _geojson_crs(document: dict[str, Any], source: str, record: Record) -> CRS | None:
    """The system of the member `crs`; None for WGS 84. Notes what the collection states."""
    for name, (subject, expected) in _GEOJSON_STATEMENTS.items():
        if name in document and document[name] != expected:
            raise FormatError(
                f"{source}: {name}: expected {expected!r}, found {str(document[name])[:80]!r}"
            )
        if name in document:
            record.used(subject, expected, name)
    for name in ("coordRefSys", "coordinateEpoch", "epoch"):
        if name in document:
            subject = Subject.HORIZONTAL_DATUM if name == "coordRefSys" else Subject.EPOCH
            record.not_used(subject, str(document[name])[:80], name)
    if "pixel_origin" not in document:
        record.assumed(Subject.PIXEL_ORIGIN, PIXEL_ORIGIN_OF_GEOJSON)
    node = document.get("crs")
    if node is None:
        record.assumed(Subject.HORIZONTAL_DATUM, "WGS 84", "", "RFC 7946")
        return None
    properties = node.get("properties") if isinstance(node, dict) else None
    definition = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(definition, str):
        raise FormatError(
            f"{source}: crs: expected the name of a reference system, found {str(node)[:60]!r}"
        )
    crs = earth_crs(definition, f"{source}, crs")
    return crs


def _record_properties(features: list[Any], rows: list[Row], record: Record) -> None:
    """Note the properties that are not read; refuses heights of 0 beside a property with others."""
    properties = [feature.get("properties") or {} for feature in features]
    names = {name: None for one in properties for name in one}
    known = _READ_PROPERTIES | {"status", "check"}
    for name in names:
        if name in known or _OF_AMERS.fullmatch(name):
            continue
        head = read_head(name)
        values = [one[name] for one in properties if one.get(name) is not None]
        is_height = head.name == "height" or head.looks_like_height
        if is_height and any(values) and rows and not any(row["lon_lat_h"][2] for row in rows):
            raise VerticalDatumError(
                f"{record.file}: the coordinates have heights of 0, and the property {name!r} others "
                f"such as {str(values[0])[:20]}; write heights above the ellipsoid into the coordinates"
            )
        subject = Subject.VERTICAL_DATUM if is_height else head.subject
        record.not_used(subject, ", ".join(dict.fromkeys(map(str, values[:3])))[:80], f"property {name}")
    if {"status", "check"} & set(names):
        record.used(Subject.VALIDITY, "switched off and check points", "properties status, check")
    if any("sigma" in name for name in names):
        record.used(Subject.ACCURACY, "sigmas", "properties")


def _geojson_row(feature: Any, where: str, image: str, count: str) -> Row:
    """The point of one feature, with its mark if it has a position in the image."""
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    properties = feature.get("properties") if isinstance(feature, dict) else None
    if not isinstance(geometry, dict) or geometry.get("type") != "Point":
        raise FormatError(f"{where}: expected a Point")
    properties = properties if isinstance(properties, dict) else {}
    coordinates = geometry.get("coordinates")
    if isinstance(coordinates, list) and len(coordinates) == 2:
        raise VerticalDatumError(f"{where}: expected longitude, latitude and height, found 2 numbers")
    lon, lat, height_m = _numbers(coordinates, 3, "coordinates", where)
    position = properties.get("ji", [properties.get("sample"), properties.get("line")])
    sample, line = _NOT_MARKED
    if position != [None, None]:
        sample, line = _numbers(position, 2, "line and sample", where)
    point_id = feature.get("id", properties.get("id"))
    return {
        "id": count if point_id is None else str(point_id),
        "lon_lat_h": (lon, lat, height_m),
        "line_sample": (line, sample),
        "image": str(properties.get("image") or properties.get("filename") or image),
        "sigma_px": _optional(properties, "sigma_px", where),
        "sigma_m": [
            _optional(properties, name, where)
            for name in ("sigma_east_m", "sigma_north_m", "sigma_up_m")
        ],
        "residual_px": [
            _optional(properties, name, where) for name in ("residual_line_px", "residual_sample_px")
        ],
        "active": properties.get("status", "active") == "active",
        "check": properties.get("check") is True,
    }


def _opf_rows(gcp: Any, images: dict[str, Any], where: str, record: Record) -> list[Row]:
    """The marks of one point, or one row without a mark."""
    if not isinstance(gcp, dict) or not isinstance(gcp.get("geolocation"), dict):
        raise FormatError(f"{where}: expected a geolocation")
    if gcp.get("id") in (None, ""):
        raise FormatError(f"{where}: id: expected a name, found {gcp.get('id')!r}")
    location, marks = gcp["geolocation"], gcp.get("marks")
    if not isinstance(marks, list) or not all(isinstance(mark, dict) for mark in marks):
        raise FormatError(f"{where}: expected a list of marks")
    ground, sigma_m = _opf_ground(location, where, record)
    point = {
        "id": str(gcp.get("id")),
        "lon_lat_h": ground,
        "sigma_m": sigma_m,
        "check": gcp.get("is_checkpoint") is True,
    }
    unmarked = {"line_sample": _NOT_MARKED, "image": "", "sigma_px": math.nan}
    rows = [] if marks else [point | unmarked]
    for mark in marks:
        sample, line = _numbers(mark.get("position_px"), 2, "position_px", where)
        camera = str(mark.get("camera_id"))
        rows.append(
            point
            | {
                "line_sample": (line - OPF_CORNER_PX, sample - OPF_CORNER_PX),
                "image": str(images.get(camera, camera)),
                "sigma_px": _optional(mark, "accuracy", where),
            }
        )
    return rows


def _opf_ground(location: dict[str, Any], where: str, record: Record) -> tuple[list[float], list[float]]:
    """Longitude, latitude, height and the sigmas east, north, up of a geolocation."""
    crs_node = location.get("crs")
    if not isinstance(crs_node, dict) or not isinstance(crs_node.get("definition"), str):
        raise FormatError(f"{where}: expected a crs with a definition")
    crs = earth_crs(crs_node["definition"], where)
    record.used(Subject.ORDER, ", ".join(axis.abbrev for axis in crs.axis_info[:2]), "crs")
    if len(crs.axis_info) < 3:
        record.assumed(Subject.VERTICAL_DATUM, ELLIPSOID, "crs", "OPF: of a system without heights")
    record.used(Subject.UNIT, str(crs.axis_info[-1].unit_name), "crs")
    record.used(Subject.ACCURACY, "sigmas", "geolocation")
    for name in ("epoch", "coordinate_epoch"):
        if name in crs_node:
            record.not_used(Subject.EPOCH, str(crs_node[name])[:40], "crs")
    coordinates = np.array([_numbers(location.get("coordinates"), 3, "coordinates", where)])
    sigmas = _numbers(location.get("sigmas"), 3, "sigmas", where)
    geoid_m = _optional(crs_node, "geoid_height", where)
    unit_m = horizontal_unit_m(crs)
    up_unit_m = float(crs.axis_info[2].unit_conversion_factor) if len(crs.axis_info) > 2 else unit_m
    east, north = sigmas[:2] if _east_first(crs) else sigmas[1::-1]
    if crs.is_compound and not math.isnan(geoid_m):
        coordinates[:, 2] = coordinates[:, 2] * up_unit_m + geoid_m
        crs = crs.sub_crs_list[0]
    elif len(crs.axis_info) < 3:
        coordinates[:, 2] *= unit_m
    check_axes(coordinates if _east_first(crs) else coordinates[:, [1, 0, 2]], crs, where)
    heights = None if crs.is_compound else ELLIPSOID
    ground = to_wgs84(coordinates, crs, heights, where, axes_of_crs=True)
    record.statements += [replace(one, file=record.file) for one in ground.statements]
    datum_m = ground.sigma_m
    sigmas_m = [math.hypot(east * unit_m, datum_m), math.hypot(north * unit_m, datum_m)]
    return ground.lon_lat_h[0].tolist(), [*sigmas_m, sigmas[2] * up_unit_m]


def _east_first(crs: CRS) -> bool:
    return crs.axis_info[0].direction == "east"


def _numbers(values: Any, count: int, name: str, where: str) -> list[float]:
    """A list of `count` finite numbers."""
    if not isinstance(values, list) or len(values) != count or not all(map(_is_number, values)):
        raise FormatError(f"{where}: {name}: expected {count} numbers, found {str(values)[:60]}")
    return [float(value) for value in values]


def _optional(node: dict[str, Any], name: str, where: str) -> float:
    """A number of a JSON object; NaN where it is missing or null."""
    value = node.get(name)
    return math.nan if value is None else _numbers([value], 1, name, where)[0]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300


def _finite_or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
