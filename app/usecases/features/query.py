"""What a request for features says, and what it means: box, time, filter, order, page."""

import hashlib
import json
import math
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any

from app.db.features.bbox import Box
from app.db.features.collection import Collection, Property, Viewer
from app.db.features.counts import Count
from app.db.features.cql2 import geometry_condition, translate
from app.db.features.cql2_bounds import check_size, parse_instant, parse_json, parse_text
from app.db.features.crs import CRS84, EARTH_RADIUS_M, EVERY, Crs
from app.db.features.predicates import ANYTHING, Condition, in_box, in_time
from app.db.features.query import Key, Order, Selection
from app.errors import InvalidParameter
from app.usecases.features.page_tokens import parse_token

DEFAULT_LIMIT = 100
MOST_FEATURES = 10_000
FILTER_LANGUAGES = ("cql2-text", "cql2-json", "cql-text")
"""The last one is what GDAL calls CQL2 text: the name of the draft."""


@dataclass(frozen=True)
class FeatureQuery:
    """What a request says, as it says it; None where it says nothing.

    Attributes:
        limit: most features on the page; more than 10,000 are never given at once.
        token: of the link `next` of the page before.
        equal: texts that properties must have.
        filter: CQL2, in `filter_lang`.
        intersects: a GeoJSON geometry that features must meet.
        ids: of the features, None for any.
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
    ids: tuple[str, ...] | None = None


@dataclass(frozen=True)
class ResolvedQuery:
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


def resolve(
    collection: Collection, viewer: Viewer, question: FeatureQuery, secret: bytes
) -> ResolvedQuery:
    """What a question means.

    Args:
        secret: that links to further pages are signed with.

    Raises:
        InvalidParameter: naming what cannot be used.
    """
    if question.limit < 1:
        raise InvalidParameter(f"limit: {question.limit} found, 1 to {MOST_FEATURES} expected")
    crs = crs_of("crs", question.crs, collection) if question.crs else collection.storage_crs
    selection = Selection(
        collection=collection,
        viewer=viewer,
        crs=crs,
        properties=_properties(collection, question.properties),
        condition=condition_of(collection, question),
        order=_order(collection, question.sortby),
    )
    page = replace(question, limit=0, token=None, crs=None, properties=None)
    said = repr((collection.id, viewer, page)).encode()
    fingerprint = hashlib.sha256(said).hexdigest()
    after, matched = None, None
    if question.token is not None:
        after, matched = parse_token(question.token, fingerprint, secret)
        if len(after) != len(selection.orders):
            raise InvalidParameter("token: not of this query; follow the link `next`")
    return ResolvedQuery(selection, min(question.limit, MOST_FEATURES), after, matched, fingerprint)


def condition_of(collection: Collection, question: FeatureQuery) -> Condition:
    parts = []
    if question.bbox is not None:
        crs = crs_of("bbox-crs", question.bbox_crs, None) if question.bbox_crs else CRS84
        parts.append(in_box(collection, parse_bbox(question.bbox, crs)))
    if question.datetime is not None:
        parts.append(in_time(collection, *parse_interval(question.datetime)))
    if question.intersects is not None:
        check_size(question.intersects, "intersects")
        parts.append(geometry_condition(collection, question.intersects, "intersects"))
    if question.filter is not None:
        crs = crs_of("filter-crs", question.filter_crs, None) if question.filter_crs else CRS84
        parts.append(translate(_filter(question), collection, crs))
    for rank, (name, value) in enumerate(question.equal):
        literal = _literal(collection.queryables[name], value)
        equal = {"op": "=", "args": [{"property": name}, literal]}
        parts.append(translate(equal, collection, CRS84, prefix=f"e{rank}_"))
    if question.ids is not None:
        key = f"{collection.key.expression}::text"
        parts.append(Condition(f"{key} = any(%(ids)s)", {"ids": list(question.ids)}))
    condition = ANYTHING
    for part in parts:
        condition = part if condition is ANYTHING else condition & part
    return condition


def _filter(question: FeatureQuery) -> Any:
    language = question.filter_lang or ("cql2-text" if isinstance(question.filter, str) else "cql2-json")
    if language not in FILTER_LANGUAGES:
        raise InvalidParameter(
            f"filter-lang: {language!r:.40} found, one of {', '.join(FILTER_LANGUAGES)} expected"
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


def parse_interval(text: str) -> tuple[datetime | None, datetime | None]:
    """The ends of an interval out of an instant or `from/to`; None for an open end, `..` or nothing.

    Raises:
        InvalidParameter: the text is neither.
    """
    ends = text.split("/")
    if len(ends) > 2 or not text or ends == ["", ""]:
        raise InvalidParameter(f"datetime: {text!r:.100} found, a time or FROM/TO expected")
    low, high = (None if end in ("", "..") else parse_instant(end, "datetime") for end in (ends * 2)[:2])
    if len(ends) == 1 and low is None:
        raise InvalidParameter(f"datetime: {text!r:.100} found, a time or FROM/TO expected")
    if low and high and low > high:
        raise InvalidParameter(f"datetime: {ends[0]} is after {ends[1]}")
    if high and len(ends[-1]) == 10:
        high = high.replace(hour=23, minute=59, second=59, microsecond=999_999)
    return low, high


def crs_of(parameter: str, uri: str | None, collection: Collection | None) -> Crs:
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
