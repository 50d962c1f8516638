"""Asking any collection for features: what a request may say, pages that go on, formats."""

import base64
import hashlib
import hmac
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import psycopg

from app.db import features
from app.db.collections import Collection, Property, Viewer
from app.db.cql2 import (
    ANYTHING,
    Condition,
    check_size,
    geometry_condition,
    parse_instant,
    parse_json,
    parse_text,
    translate,
)
from app.db.crs import CRS84, EVERY, Crs
from app.db.density import DENSITY
from app.db.engine import Connection
from app.db.features import Count, Key, Order, Reading, Selection
from app.db.outlines import BLOCKS, SCENES
from app.db.points import POINTS
from app.errors import InvalidParameter, NotFound
from services.formats.feature_files import Column, FeatureTable, read_feature_csv

COLLECTIONS: Mapping[str, Collection] = {
    collection.id: collection for collection in (POINTS, BLOCKS, DENSITY, SCENES)
}
DEFAULT_LIMIT = 100
MOST_FEATURES = 10_000
LARGEST_TEXT = 2_000
"""Features that are made into one text; more are streamed."""
FILTER_LANGUAGES = ("cql2-text", "cql2-json")
EARTH_RADIUS_M = 6_378_137.0

Format = Literal["json", "csv", "fgb", "parquet", "gpkg"]


@dataclass(frozen=True)
class Question:
    """What a request says, as it says it; None where it says nothing.

    Attributes:
        limit: most features on the page; more than 10,000 are never given at once.
        token: of the link `next` of the page before.
        equal: texts that properties must have.
        filter: CQL2, in `filter_lang`.
        intersects: a GeoJSON geometry that features must meet.
    """

    limit: int = DEFAULT_LIMIT
    token: str | None = None
    bbox: str | None = None
    bbox_crs: str | None = None
    crs: str | None = None
    datetime: str | None = None
    filter: Any = None
    filter_lang: str | None = None
    filter_crs: str | None = None
    sortby: str | None = None
    properties: str | None = None
    intersects: Any = None
    equal: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Asked:
    """A question that can be answered.

    Attributes:
        selection: what it selects.
        limit: most features.
        after: where the page begins; None for the first.
        matched: how many there are on all pages, when the link said so.
        fingerprint: of the question, without its page.
    """

    selection: Selection
    limit: int
    after: Key | None
    matched: Count | None
    fingerprint: str


@dataclass(frozen=True)
class Answer:
    """A page.

    Attributes:
        body: without what stands around features.
        returned: how many.
        matched: how many there are on all pages.
        next_token: where the next page begins, None on the last one.
    """

    body: bytes
    returned: int
    matched: Count
    next_token: str | None


def find_collection(name: str) -> Collection:
    """The collection of a name.

    Raises:
        NotFound: there is none.
    """
    found = COLLECTIONS.get(name)
    if found is None:
        raise NotFound(f"no collection {name:.100}: there are {', '.join(COLLECTIONS)}")
    return found


def understand(collection: Collection, viewer: Viewer, question: Question, secret: bytes) -> Asked:
    """What a question means.

    Args:
        secret: that links to further pages are signed with.

    Raises:
        InvalidParameter: naming what cannot be used.
    """
    if question.limit < 1:
        raise InvalidParameter(f"limit: {question.limit} found, 1 to {MOST_FEATURES} expected")
    crs = _crs("crs", question.crs, collection) if question.crs else collection.storage_crs
    selection = Selection(
        collection=collection,
        viewer=viewer,
        crs=crs,
        properties=_properties(collection, question.properties),
        condition=_condition(collection, question),
        order=_order(collection, question.sortby),
    )
    page = replace(question, limit=0, token=None, crs=None, properties=None)
    said = repr((collection.id, viewer, page)).encode()
    fingerprint = hashlib.sha256(said).hexdigest()
    after, matched = None, None
    if question.token is not None:
        after, matched = _parse_token(question.token, fingerprint, secret)
        if len(after) != len(selection.orders):
            raise InvalidParameter("token: not of this query; follow the link `next`")
    return Asked(selection, min(question.limit, MOST_FEATURES), after, matched, fingerprint)


def page(connection: Connection, asked: Asked, kind: features.Text, secret: bytes) -> Answer:
    """A page in a format that the database makes.

    Raises:
        InvalidParameter: a value of the filter cannot be calculated with.
    """
    try:
        found = features.page(connection, asked.selection, kind, asked.after, asked.limit)
        matched = _matched(connection, asked, found.last, found.returned)
    except psycopg.DataError as error:
        raise _unusable(error) from error
    return Answer(found.body, found.returned, matched, _next(asked, found.last, matched, secret))


def table(connection: Connection, asked: Asked, secret: bytes) -> tuple[FeatureTable, Answer]:
    """A page as columns, for the formats that hold columns."""
    selection = asked.selection
    try:
        text = features.copy_csv(connection, selection, asked.after, asked.limit)
    except psycopg.DataError as error:
        raise _unusable(error) from error
    columns = [
        Column(item.name, "text" if item.is_time else item.type)
        for item in (selection.collection.key, *selection.properties)
    ]
    read, last_keys = read_feature_csv(
        text, columns, selection.collection.geometry_type, selection.crs.srid, asked.limit
    )
    last = None if last_keys is None else tuple(json.loads(last_keys))
    matched = _matched(connection, asked, last, len(read))
    return read, Answer(b"", len(read), matched, _next(asked, last, matched, secret))


def stream(connection: Connection, asked: Asked, secret: bytes) -> Iterator[bytes | Answer]:
    """The features of a large page as GeoJSON, in pieces; the last thing is the answer about them."""
    reading = Reading()
    matched = asked.matched or features.count(connection, asked.selection)
    yield from features.stream_geojson(connection, asked.selection, asked.after, asked.limit, reading)
    yield Answer(b"", reading.returned, matched, _next(asked, reading.last, matched, secret))


def find_feature(
    connection: Connection, collection: Collection, viewer: Viewer, reference: str, crs: str | None
) -> tuple[str, Crs]:
    """One feature as GeoJSON text, and its reference system.

    Raises:
        NotFound: there is no such feature, or not for this caller.
    """
    chosen = _crs("crs", crs, collection) if crs else collection.storage_crs
    selection = Selection(collection, viewer, chosen, collection.properties)
    found = None if "\0" in reference else features.find(connection, selection, reference)
    if found is None:
        raise NotFound(f"no feature {reference:.100} in {collection.id}")
    return found, chosen


def extent(connection: Connection, collection: Collection, viewer: Viewer) -> tuple[float, ...] | None:
    """West, south, east, north of what the viewer may see of a collection, None without any."""
    # Points lie in the outlines of their blocks, which are fewer; so do cells, to a tenth of a degree.
    whose = BLOCKS if collection.id in ("points", "density") else collection
    found = features.extent(connection, whose, viewer if whose is collection else Viewer())
    if found is None or found[2] <= 180.0:
        return found
    return (-180.0, found[1], 180.0, found[3])


def everything_in(collection: Collection, bbox: str | None = None) -> Selection:
    """All features in a box, as anybody sees them.

    Raises:
        InvalidParameter: the box cannot be used.
    """
    condition = _condition(collection, Question(bbox=bbox))
    return Selection(collection, Viewer(), collection.storage_crs, collection.properties, condition)


def _condition(collection: Collection, question: Question) -> Condition:
    parts = []
    if question.bbox is not None:
        crs = _crs("bbox-crs", question.bbox_crs, None) if question.bbox_crs else CRS84
        parts.append(_in_box(collection, parse_bbox(question.bbox, crs)))
    if question.datetime is not None:
        parts.append(_in_time(collection, question.datetime))
    if question.intersects is not None:
        check_size(question.intersects)
        parts.append(geometry_condition(collection, question.intersects, CRS84))
    if question.filter is not None:
        crs = _crs("filter-crs", question.filter_crs, None) if question.filter_crs else CRS84
        parts.append(translate(_filter(question), collection, crs))
    for rank, (name, value) in enumerate(question.equal):
        literal = _literal(collection.queryables[name], value)
        equal = {"op": "=", "args": [{"property": name}, literal]}
        parts.append(translate(equal, collection, CRS84, prefix=f"e{rank}_"))
    condition = ANYTHING
    for part in parts:
        condition = part if condition is ANYTHING else condition & part
    return condition


def _filter(question: Question) -> Any:
    language = question.filter_lang or ("cql2-text" if isinstance(question.filter, str) else "cql2-json")
    if language not in FILTER_LANGUAGES:
        raise InvalidParameter(
            f"filter-lang: {language!r:.40} found, {' or '.join(FILTER_LANGUAGES)} expected"
        )
    if language == "cql2-json":
        text = question.filter if isinstance(question.filter, str) else json.dumps(question.filter)
        return parse_json(text)
    if not isinstance(question.filter, str):
        raise InvalidParameter("filter: cql2-text is a text")
    return parse_text(question.filter)


def _literal(item: Property, text: str) -> Any:
    if not item.is_number:
        return text
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InvalidParameter(f"{item.name}: {text!r:.60} found, a number expected")
    return value


@dataclass(frozen=True)
class Box:
    """A box of longitude and latitude; `east` below `west` crosses the antimeridian.

    Attributes:
        low_m, high_m: heights; unbounded unless given.
    """

    west: float
    south: float
    east: float
    north: float
    low_m: float = -math.inf
    high_m: float = math.inf


def parse_bbox(text: str, crs: Crs = CRS84) -> Box:
    """A box out of `W,S,E,N`, or with heights between; west greater than east crosses the antimeridian.

    Args:
        crs: of the numbers, in its own order of axes.

    Raises:
        InvalidParameter: naming the value that cannot be used.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (4, 6) or not all(math.isfinite(value) for value in values):
        raise InvalidParameter(f"bbox: {text!r:.100} found, four or six numbers W,S,E,N expected")
    half = len(values) // 2
    first, second = values[:2], values[half : half + 2]
    heights = (values[2], values[5]) if half == 3 else (-math.inf, math.inf)
    if crs.lat_first:
        first, second = first[::-1], second[::-1]
    if not crs.in_degrees:
        first, second = _from_mercator(*first), _from_mercator(*second)
    box = Box(first[0], first[1], second[0], second[1], heights[0], heights[1])
    for name, value, limit in (
        ("west", box.west, 180.0),
        ("south", box.south, 90.0),
        ("east", box.east, 180.0),
        ("north", box.north, 90.0),
    ):
        if abs(value) > limit:
            raise InvalidParameter(f"bbox: {name} {value:g} found, {-limit:g} to {limit:g} expected")
    if box.south > box.north:
        raise InvalidParameter(f"bbox: south {box.south:g} is above north {box.north:g}")
    return box


def _from_mercator(east_m: float, north_m: float) -> list[float]:
    limit_m = math.pi * EARTH_RADIUS_M
    if abs(east_m) > limit_m * (1.0 + 1e-9):
        raise InvalidParameter(f"bbox: east {east_m:g} m found, {limit_m:g} at most expected")
    lon = max(-180.0, min(180.0, math.degrees(east_m / EARTH_RADIUS_M)))
    north_m = max(-4.0 * limit_m, min(4.0 * limit_m, north_m))
    return [lon, math.degrees(math.atan(math.sinh(north_m / EARTH_RADIUS_M)))]


def _in_box(collection: Collection, box: Box) -> Condition:
    """The condition that a feature meets a box: by the index, which is coarser, then exactly.

    The exact part is wrapped in `coalesce`, where the planner does not look: it would take four ranges
    of unknown values for very selective, and read all the world to find its first hundred points.
    """
    geometry = collection.geometry
    srid = 4979 if collection.has_height else 4326
    ranges = [(box.west, 180.0), (-180.0, box.east)] if box.east < box.west else [(box.west, box.east)]
    parameters: dict[str, Any] = {"south": box.south, "north": box.north}
    near, exact = [], []
    for i, (west, east) in enumerate(ranges):
        parameters |= {f"west{i}": west, f"east{i}": east}
        envelope = f"st_makeenvelope(%(west{i})s, %(south)s, %(east{i})s, %(north)s, {srid})"
        near.append(f"{geometry} && {envelope}")
        exact.append(
            f"st_x({geometry}) between %(west{i})s and %(east{i})s"
            if collection.geometry_type == "Point"
            else f"st_intersects({geometry}, {envelope})"
        )
    sql = f"({' or '.join(near)}) and coalesce(({' or '.join(exact)})"
    if collection.geometry_type == "Point":
        sql += f" and st_y({geometry}) between %(south)s and %(north)s"
    if collection.has_height and box.low_m > -math.inf:
        parameters |= {"low": box.low_m, "high": box.high_m}
        sql += f" and st_z({geometry}) between %(low)s and %(high)s"
    return Condition(f"{sql}, false)", parameters, spatial=True)


def _in_time(collection: Collection, text: str) -> Condition:
    """The condition that a feature's time meets an instant or an interval `from/to`, `..` for open."""
    ends = text.split("/")
    if len(ends) > 2 or not text or ends == ["", ""]:
        raise InvalidParameter(f"datetime: {text!r:.100} found, a time or FROM/TO expected")
    low, high = (None if end in ("", "..") else parse_instant(end, "datetime") for end in (ends * 2)[:2])
    if len(ends) == 1 and low is None:
        raise InvalidParameter(f"datetime: {text!r:.100} found, a time or FROM/TO expected")
    if low and high and low > high:
        raise InvalidParameter(f"datetime: {ends[0]} is after {ends[1]}")
    if collection.interval is None:
        return ANYTHING
    if low and ends[-1] and len(ends[-1]) == 10 and high:
        high = high.replace(hour=23, minute=59, second=59, microsecond=999_999)
    start, end = (collection.queryables[name].expression for name in collection.interval)
    sql = (
        f"({start}::timestamp at time zone 'UTC' <= coalesce(%(until)s::timestamptz, 'infinity')"
        f" and {end}::timestamp at time zone 'UTC' >= coalesce(%(since)s::timestamptz, '-infinity'))"
    )
    return Condition(sql, {"since": low, "until": high})


def _crs(parameter: str, uri: str | None, collection: Collection | None) -> Crs:
    """A reference system by its name; of those a collection has, if there is one."""
    allowed = EVERY if collection is None else {crs.uri: crs for crs in collection.crs}
    found = allowed.get((uri or "").strip("[]"))
    if found is None:
        raise InvalidParameter(f"{parameter}: {uri!r:.100} found, one of {', '.join(allowed)} expected")
    return found


def _properties(collection: Collection, text: str | None) -> tuple[Property, ...]:
    if text is None:
        return collection.properties
    names = [name for name in text.split(",") if name]
    known = collection.queryables
    for name in names:
        if name not in known:
            raise InvalidParameter(
                f"properties: no property {name!r:.60} in {collection.id}: there are {', '.join(known)}"
            )
    return tuple(item for item in collection.properties if item.name in names)


def _order(collection: Collection, text: str | None) -> tuple[Order, ...]:
    orders = []
    for part in [] if text is None else text.split(","):
        name = part.strip().lstrip("+-")
        found = collection.queryables.get(name)
        if found is None:
            known = ", ".join(collection.queryables)
            raise InvalidParameter(
                f"sortby: no property {name!r:.60} in {collection.id}: there are {known}"
            )
        orders.append(Order(found, part.strip().startswith("-")))
    if len(orders) > len(collection.queryables):
        raise InvalidParameter("sortby: more properties than there are")
    return tuple(orders)


def _matched(connection: Connection, asked: Asked, last: Key | None, returned: int) -> Count:
    """How many match; a first page that holds them all has counted them already."""
    if asked.matched is not None:
        return asked.matched
    if last is None and asked.after is None:
        return Count(returned, exact=True)
    return features.count(connection, asked.selection)


def _next(asked: Asked, last: Key | None, matched: Count, secret: bytes) -> str | None:
    if last is None:
        return None
    packed = json.dumps([last, matched.number, matched.exact], separators=(",", ":")).encode()
    return base64.urlsafe_b64encode(_seal(packed, asked.fingerprint, secret) + packed).decode()


def _parse_token(token: str, fingerprint: str, secret: bytes) -> tuple[Key, Count]:
    try:
        raw = base64.b64decode(token.encode("ascii"), altchars=b"-_", validate=True)
    except ValueError:
        raw = b""
    seal, packed = raw[:16], raw[16:]
    if not hmac.compare_digest(seal, _seal(packed, fingerprint, secret)):
        raise InvalidParameter(f"token: {token!r:.100} is not of this query; follow the link `next`")
    last, number, exact = json.loads(packed)
    return tuple(last), Count(number, exact)


def _seal(packed: bytes, fingerprint: str, secret: bytes) -> bytes:
    """Signs a place in the answer to one question of one caller."""
    return hmac.digest(secret, fingerprint.encode() + packed, "sha256")[:16]


def _unusable(error: psycopg.DataError) -> InvalidParameter:
    said = error.diag.message_primary or str(error)
    return InvalidParameter(f"filter: {said:.200}")


def page_secret(connection: Connection) -> bytes:
    """What the installation signs the links to further pages with."""
    return features.page_secret(connection)


def csv_header(selection: Selection) -> str:
    """The names of the columns of CSV."""
    return features.csv_header(selection)
