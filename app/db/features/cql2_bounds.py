"""Parsing of filters within limits of size: CQL2 in both languages, geometries.

Sources: OGC 21-065r2, Common Query Language (CQL2); RFC 7946.
"""

import json
from typing import Any

import shapely

from amers.app.db.features.antimeridian import on_the_map
from amers.app.db.features.cql2_process import parse
from amers.app.db.features.cql2_tokens import check_text, check_times
from amers.app.db.features.crs import Crs, lon_lat_from_mercator
from amers.app.db.features.instants import parse_moment
from amers.app.errors import InvalidParameter

LONGEST_JSON = 2_000_000
"""Characters of a filter in JSON."""
DEEPEST_JSON = 32
DEEPEST_PARSED = 100
"""Levels of a filter in text as JSON, two for each operator."""
MOST_NODES = 1_000
MOST_VERTICES = 10_000


def parse_text(text: str) -> Any:
    """The CQL2 JSON of a filter in CQL2 text.

    Raises:
        InvalidParameter: the text is not CQL2, too long or too deep.
    """
    _check_unicode(text)
    check_text(text)
    check_times(text)
    document = parse("text", text)
    check_size(document, "filter", DEEPEST_PARSED)
    return document


def parse_json(document: Any) -> Any:
    """A filter in CQL2 JSON, checked by the library.

    Args:
        document: parsed, or its text.

    Raises:
        InvalidParameter: the document is not CQL2, too large or too deep, or has a number that is not
            finite, a member twice or half a character.
    """
    if isinstance(document, str):
        document = _loaded(document)
    check_size(document, "filter")
    _check_times(document)
    try:
        text = json.dumps(document, ensure_ascii=False, allow_nan=False)
    except ValueError:
        raise InvalidParameter("filter: NaN or an infinity found, a finite number expected") from None
    _check_unicode(text)
    if len(text) > LONGEST_JSON:
        raise InvalidParameter(f"filter: {len(text)} characters of JSON, {LONGEST_JSON} at most")
    return parse("json", text)


def _check_times(document: Any) -> None:
    """As `check_times` of text, for a document that `check_size` has let through."""
    parts = [document]
    while parts:
        part = parts.pop()
        if isinstance(part, list):
            parts += part
        elif isinstance(part, dict):
            parts += part.values()
            ends = part.get("interval")
            texts = [end for end in ends if isinstance(end, str)] if isinstance(ends, list) else []
            texts += [part[name] for name in ("date", "timestamp") if name in part]
            for text in texts:
                if text != "..":
                    parse_moment(text, "filter")


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


def _check_unicode(text: str) -> None:
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
        shape = _box(node["bbox"]) if "bbox" in node else shapely.from_geojson(json.dumps(node))
    except (shapely.errors.ShapelyError, TypeError, ValueError) as error:
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
