"""Safe GeoJSON: a copy that GDAL cannot interpret as any other format.

GDAL looks into a file for what it is. A JSON document may be a pipeline of commands that read other
files, or hold a virtual dataset, and its reference system may be an address, which GDAL fetches. So GDAL
gets a copy with the features alone, under a name that chooses its driver.
"""

import json
from pathlib import Path
from typing import Any

from pyproj import CRS
from pyproj.exceptions import CRSError

from amers.services.errors import FormatError
from amers.services.formats.text_files import load_json

MOST_PARTS = 1_000_000
"""Parts of collections that are looked at: more than a body of the largest size has."""
SHAPES = {"Point", "MultiPoint", "LineString", "MultiLineString", "Polygon", "MultiPolygon"}
COLLECTION = "GeometryCollection"


def plain_geojson(path: Path, folder: Path) -> tuple[str, bool, dict[int, str]]:
    """What GDAL opens: a copy in a folder with features, name and named reference system of a file.

    Returns:
        Its name; whether its reference system is known: where the file states one that PROJ does not
        know, GDAL would take longitudes and latitudes; and the rows of geometries of an unknown type,
        which the copy leaves out.

    Raises:
        FormatError: the file is not GeoJSON.
    """
    document = load_json(path.read_text(encoding="utf-8-sig"), str(path))
    if not isinstance(document, dict):
        raise FormatError(f"{path}: a JSON object expected, another value found")
    plain: dict[str, Any] = {"type": "FeatureCollection"}
    if isinstance(document.get("name"), str):
        plain["name"] = document["name"]
    crs = _named_crs(document.get("crs"))
    if crs is not None:
        plain["crs"] = {"type": "name", "properties": {"name": crs}}
    features = [_feature(one, path) for one in _features(document, path)]
    unusable = {}
    for row, one in enumerate(features):
        kind = _unknown_type(one["geometry"])
        if kind is not None:
            one["geometry"], unusable[row] = None, f"unknown type of geometry {kind!r:.60}"
    plain["features"] = features
    copy = folder / path.name
    copy.write_text(json.dumps(plain), encoding="utf-8")
    return f"GeoJSON:{copy}", crs is not None or "crs" not in document, unusable


def _unknown_type(geometry: Any) -> Any | None:
    """The first type in a geometry that GeoJSON does not know; None where it knows all."""
    left, depth = [geometry], 0
    while left and depth < MOST_PARTS:
        one, depth = left.pop(), depth + 1
        kind = one.get("type") if isinstance(one, dict) else None
        if kind == COLLECTION and isinstance(one.get("geometries"), list):
            left += one["geometries"]
        elif one is not None and kind not in SHAPES:
            return "none" if kind is None else kind
    return None


def _features(document: dict[str, Any], path: Path) -> list[Any]:
    if document.get("type") == "FeatureCollection" and isinstance(document.get("features"), list):
        return list(document["features"])
    if document.get("type") == "Feature":
        return [document]
    if "coordinates" in document or "geometries" in document:
        return [{"geometry": document}]
    raise FormatError(f"{path}: features or a geometry of GeoJSON expected, another document found")


def _feature(feature: Any, path: Path) -> dict[str, Any]:
    """The identifier, the attributes and the geometry of a feature."""
    if not isinstance(feature, dict) or not isinstance(feature.get("geometry"), dict | None):
        raise FormatError(f"{path}: a feature with a geometry or null expected, another value found")
    geometry = feature.get("geometry")
    plain = {"type": "Feature", "properties": feature.get("properties"), "geometry": None}
    if "id" in feature:
        plain["id"] = feature["id"]
    if geometry is not None:
        members = ("type", "coordinates", "geometries")
        plain["geometry"] = {key: geometry[key] for key in members if key in geometry}
    return plain


def _named_crs(crs: Any) -> str | None:
    """The name of a reference system that PROJ knows; not its address, which would be fetched."""
    properties = crs.get("properties") if isinstance(crs, dict) and crs.get("type") == "name" else None
    name = properties.get("name") if isinstance(properties, dict) else None
    is_code = isinstance(name, str) and name.upper().startswith(("URN:OGC:DEF:CRS:", "EPSG:", "OGC:"))
    if not is_code:
        return None
    try:
        CRS.from_user_input(name)
    except CRSError:
        return None
    return str(name)
