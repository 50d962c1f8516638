"""Limits of filters: CQL2 JSON and geometries that are not too large, too deep or no JSON.

Sources: OGC 21-065r2, Common Query Language (CQL2); RFC 7946.
"""

import json
from typing import Any

import shapely

from amers.app.db.features.antimeridian import on_the_map
from amers.app.db.features.crs import Crs, lon_lat_from_mercator
from amers.app.errors import InvalidParameter

LONGEST_JSON = 2_000_000
"""Characters of a filter in JSON."""
DEEPEST_JSON = 32
MOST_NODES = 1_000
MOST_VERTICES = 10_000
KINDS = ("op", "property", "date", "timestamp", "interval", "type", "bbox")
"""Members of which each object of CQL2 JSON has one: it says what the object is."""
GEOMETRY_TYPES = (
    *("Point", "LineString", "Polygon", "MultiPoint", "MultiLineString", "MultiPolygon"),
    "GeometryCollection",
)


def parse_json(document: Any) -> Any:
    """A filter in CQL2 JSON within limits; `translate` checks what it means.

    Args:
        document: parsed, or its text.

    Raises:
        InvalidParameter: the document is not JSON, too large or too deep, or has a number that is not
            finite, a member twice or half a character.
    """
    if isinstance(document, str):
        document = _loaded(document)
    check_size(document, "filter")
    _check_kinds(document)
    try:
        text = json.dumps(document, ensure_ascii=False, allow_nan=False)
    except ValueError:
        raise InvalidParameter("filter: NaN or an infinity found, a finite number expected") from None
    check_unicode(text)
    if len(text) > LONGEST_JSON:
        raise InvalidParameter(f"filter: {len(text)} characters of JSON, {LONGEST_JSON} at most")
    return document


def _check_kinds(document: Any) -> None:
    """Raise an error for an object that could be read in several ways, or as no geometry."""
    parts = [document]
    while parts:
        part = parts.pop()
        if isinstance(part, list):
            parts += part
        elif isinstance(part, dict):
            parts += part.values()
            # A geometry may state its extent.
            kinds = [kind for kind in KINDS if kind in part and not (kind == "bbox" and "type" in part)]
            if len(kinds) != 1 or part.get("type", "Point") not in GEOMETRY_TYPES:
                raise InvalidParameter(
                    f"filter: {json.dumps(part)!s:.60} found, an object with one member of"
                    f" {', '.join(KINDS)} expected, and the type of a geometry as `type`"
                )


def _loaded(text: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=_members, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InvalidParameter(f"filter: not JSON: {error!s:.200}") from None


def _members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) < len(pairs):
        raise ValueError("an object has a member twice")
    return members


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} found, a finite number expected")


def check_unicode(text: str) -> None:
    """Raise an error for half a character, which neither a statement nor a reply can carry."""
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise InvalidParameter(
            f"filter: half a character (a lone surrogate) at character {error.start + 1}"
        ) from None


def check_size(document: Any, where: str, deepest: int = DEEPEST_JSON) -> None:
    """Raise an error for a document that is too deep or has too many parts; the check does not recurse.

    Raises:
        InvalidParameter: the document exceeds a limit; the message names it and `where` it stood.
    """
    level, vertices, nodes = [document], 0, 0
    for _ in range(deepest):
        below: list[Any] = []
        for part in level:
            inside = list(part.values()) if isinstance(part, dict) else part
            if not isinstance(inside, list):
                continue
            is_position = bool(inside) and all(isinstance(value, int | float) for value in inside)
            vertices, nodes = vertices + is_position, nodes + (not is_position) * len(inside)
            below += [] if is_position else inside
        level = below
        if vertices > MOST_VERTICES or nodes > MOST_NODES + 2 * MOST_VERTICES:
            raise InvalidParameter(
                f"{where}: too large: {MOST_NODES} parts and {MOST_VERTICES} positions at most"
            )
        if not level:
            return
    raise InvalidParameter(f"{where}: deeper than {deepest} levels")


def parse_geometry(node: Any, crs: Crs, where: str) -> bytes:
    """The WKB of a GeoJSON geometry or a bbox, with longitude first, cut at 180 degrees.

    Args:
        crs: of its coordinates; longitudes may exceed 180 degrees.

    Raises:
        InvalidParameter: the geometry is invalid or outside the bounds of its reference system; the
            message names `where` it stood.
    """
    if not isinstance(node, dict):
        raise InvalidParameter(f"{where}: a geometry expected, {json.dumps(node)!s:.60} found")
    try:
        is_box = "bbox" in node and "type" not in node
        shape = _box(node["bbox"]) if is_box else shapely.from_geojson(json.dumps(node))
    except (shapely.errors.ShapelyError, ArithmeticError, TypeError, ValueError) as error:
        raise InvalidParameter(f"{where}: not a GeoJSON geometry: {error!s:.200}") from None
    shape = shapely.force_2d(shape)
    if crs.lat_first:
        shape = shapely.transform(shape, lambda position: position[:, ::-1])
    coordinates = shapely.get_coordinates(shape)
    limit = (360.0, 90.0) if crs.in_degrees else (4.1e7, 2.6e8)
    if not len(coordinates) or not (abs(coordinates) <= limit).all():
        raise InvalidParameter(
            f"{where}: a geometry is empty or beyond {limit[0]:g} and {limit[1]:g}, its bounds"
        )
    if not shapely.is_valid(shape):
        raise InvalidParameter(f"{where}: geometry: {shapely.is_valid_reason(shape):.200}")
    if not crs.in_degrees:
        shape = shapely.transform(shape, lon_lat_from_mercator)
    return bytes(shapely.to_wkb(on_the_map(shape)))


def _box(values: Any) -> Any:
    if not isinstance(values, list) or len(values) not in (4, 6):
        raise ValueError("a bbox has four or six numbers")
    west, south, *_ = values
    east, north = values[len(values) // 2 : len(values) // 2 + 2]
    if west <= east:
        return shapely.box(west, south, east, north)
    sides = [shapely.box(west, south, 180.0, north), shapely.box(-180.0, south, east, north)]
    return shapely.multipolygons(sides)
