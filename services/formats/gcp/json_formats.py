"""Marked points in JSON: Amers and Orthority GeoJSON, and the control points of OPF 1.0 (Pix4D)."""

import hashlib
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
from pyproj import CRS

from amers.services.errors import FormatError, InputError, VerticalDatumError
from amers.services.formats.gcp.marked_points import (
    Ground,
    MarkedPoints,
    horizontal_unit_m,
    marked_points,
    parse_crs,
    to_wgs84,
)
from amers.services.formats.gcp.text_lines import check_lon_lat
from amers.services.formats.text_files import load_json
from amers.services.statements import Statements, gathered
from amers.services.types import Array, Measures

OPF_FORMAT = "application/opf-input-control-points+json"
_OPF_FORMATS = (OPF_FORMAT, OPF_FORMAT.removeprefix("application/"))
"""The name in the examples of the specification, and the one in its text."""
OPF_CORNER_PX = 0.5
"""OPF counts pixels from the corner of the first one."""
OPF_EXTENSION = "AMERS_images"
"""Extension of OPF with the names of the images, which OPF itself stores in a separate camera list."""


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
        "pixel_origin": "the centre of the first pixel is line 0, sample 0",
        "heights": "metres above the WGS 84 ellipsoid",
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
    image = str(document.get("image") or "")
    rows = [
        _geojson_row(feature, f"{source}, feature {count}", image, str(count))
        for count, feature in enumerate(features, start=1)
    ]
    return _points_from_rows(rows)


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
    rows = []
    for count, gcp in enumerate(gcps, start=1):
        rows += _opf_rows(gcp, images, f"{source}, gcp {count}")
    statements = [one for row in rows for one in row.pop("statements")]
    return _points_from_rows(rows, gathered(statements))


_NOT_MARKED = (math.nan, math.nan)

Row = dict[str, Any]
"""One mark: values by the attribute names of `MarkedPoints`."""


def _points_from_rows(rows: list[Row], statements: Statements = ()) -> MarkedPoints:
    columns: dict[str, Any] = {name: [row[name] for row in rows] for name in rows[0]} if rows else {}
    return marked_points(
        columns.pop("id", []),
        columns.pop("lon_lat_h", []),
        columns.pop("line_sample", []),
        statements,
        **columns,
    )


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
    check_lon_lat(lon, lat, where)
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


def _opf_rows(gcp: Any, images: dict[str, Any], where: str) -> list[Row]:
    """The marks of one point, or one row without a mark."""
    if not isinstance(gcp, dict) or not isinstance(gcp.get("geolocation"), dict):
        raise FormatError(f"{where}: expected a geolocation")
    if gcp.get("id") in (None, ""):
        raise FormatError(f"{where}: id: expected a name, found {gcp.get('id')!r}")
    location, marks = gcp["geolocation"], gcp.get("marks")
    if not isinstance(marks, list) or not all(isinstance(mark, dict) for mark in marks):
        raise FormatError(f"{where}: expected a list of marks")
    ground, sigma_m = _opf_ground(location, where)
    file = where.rpartition(", gcp ")[0]
    point = {
        "id": str(gcp.get("id")),
        "lon_lat_h": ground.lon_lat_h[0],
        "sigma_m": [*(math.hypot(sigma, ground.sigma_m) for sigma in sigma_m[:2]), sigma_m[2]],
        "statements": [replace(one, file=file) for one in ground.statements],
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


def _opf_ground(location: dict[str, Any], where: str) -> tuple[Ground, list[float]]:
    """Longitude, latitude, height and the sigmas east, north, up of a geolocation."""
    crs_node = location.get("crs")
    if not isinstance(crs_node, dict) or not isinstance(crs_node.get("definition"), str):
        raise FormatError(f"{where}: expected a crs with a definition")
    crs = parse_crs(crs_node["definition"], where)
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
    heights = None if crs.is_compound else "ellipsoid"
    ground = to_wgs84(coordinates, crs, heights, where, axes_of_crs=True)
    return ground, [east * unit_m, north * unit_m, sigmas[2] * up_unit_m]


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
