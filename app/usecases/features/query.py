"""The feature query: what a client may ask of a collection, and what that selects.

The parameters are declared once, here. Pages of features, search by POST, chips and STAC search use
these models; OpenAPI shows their descriptions.
"""

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema

from amers.app.db.features.bbox import Box
from amers.app.db.features.collection import Collection, Property, Viewer
from amers.app.db.features.counts import Count
from amers.app.db.features.cql2 import geometry_condition, translate, translate_text
from amers.app.db.features.cql2_bounds import check_size, parse_json
from amers.app.db.features.crs import CRS84, EARTH_RADIUS_M, EVERY, Crs
from amers.app.db.features.instants import parse_interval
from amers.app.db.features.predicates import ANYTHING, Condition, in_time, key_among
from amers.app.db.features.query import Key, Order, Selection
from amers.app.errors import InvalidParameter
from amers.app.usecases.features.page_tokens import parse_token

DEFAULT_LIMIT = 100
MOST_FEATURES = 10_000
FILTER_LANGUAGES = ("cql2-text", "cql2-json", "cql-text")
"""`cql-text` is the name of CQL2 text in the draft of the standard; GDAL still sends it."""


def _joined(value: Any) -> Any:
    """A list of numbers as text; other values are left to the check of the type."""
    if isinstance(value, list) and all(type(item) in (int, float) for item in value):
        return ",".join(map(repr, value))
    return value


def _parsed_geometry(value: Any) -> Any:
    """The text of a geometry as an object; other values are left to the check of the type."""
    if not isinstance(value, str):
        return value
    try:
        return json.loads(value)
    except (ValueError, RecursionError):
        raise InvalidParameter(f"intersects: {value!r:.60} found, GeoJSON expected") from None


BBOX_SCHEMA = {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 6}
Bbox = Annotated[str, BeforeValidator(_joined), WithJsonSchema(BBOX_SCHEMA)]
Geometry = Annotated[dict[str, Any], BeforeValidator(_parsed_geometry)]


class FeatureFilter(BaseModel):
    """Which features of a collection: those that meet all of the conditions given."""

    model_config = ConfigDict(frozen=True, populate_by_name=True)

    bbox: Bbox | None = Field(
        default=None,
        description="Box W,S,E,N, or with heights W,S,LOWEST,E,N,HIGHEST; W greater than E crosses the"
        " antimeridian. Features without a geometry meet every box.",
    )
    bbox_crs: str | None = Field(
        default=None, alias="bbox-crs", description="URI of the coordinate reference system of `bbox`."
    )
    datetime: str | None = Field(
        default=None,
        description="A date, a time, or an interval FROM/TO with `..` for an open end, as RFC 3339 has"
        " them. A date is a whole day, UTC. Features without a time meet all of them.",
    )
    filter: str | dict[str, Any] | None = Field(
        default=None, description="CQL2: text, or JSON in the body of a POST."
    )
    filter_lang: str | None = Field(
        default=None,
        alias="filter-lang",
        description="Language of `filter`: cql2-text by default for text, cql2-json for an object.",
        json_schema_extra={"enum": list(FILTER_LANGUAGES)},
    )
    filter_crs: str | None = Field(
        default=None,
        alias="filter-crs",
        description="URI of the coordinate reference system of geometries in `filter`.",
    )
    intersects: Geometry | None = Field(
        default=None,
        description="GeoJSON geometry in longitude and latitude; only features that intersect it.",
    )


class FeatureQuery(FeatureFilter):
    """Which features of a collection, in which order, how many, and how they are given."""

    limit: int = Field(
        default=DEFAULT_LIMIT,
        ge=1,
        description=f"Number of features on a page; larger values give {MOST_FEATURES:,}.",
        json_schema_extra={"maximum": MOST_FEATURES},
    )
    token: str | None = Field(
        default=None, description="Start of the page, from the link `next` of the page before."
    )
    crs: str | None = Field(
        default=None, description="URI of the coordinate reference system of the reply."
    )
    sortby: str | None = Field(
        default=None,
        description="Properties to sort by, separated by commas; `-` before one sorts it descending.",
    )
    properties: str | None = Field(
        default=None, description="Properties to return, separated by commas; all by default."
    )


FINGERPRINTED = (*FeatureFilter.model_fields, "sortby")
"""Parameters that all pages of one reply share."""


@dataclass(frozen=True)
class ResolvedQuery:
    """A query in the terms of the store.

    Attributes:
        selection: features, their order and properties.
        limit: largest number of features on the page.
        after: key of the last feature of the page before; None for the first page.
        matched: number of features on all pages if the page token carries it, else None.
        fingerprint: digest of the query without its page; page tokens are signed with it.
    """

    selection: Selection
    limit: int
    after: Key | None
    matched: Count | None
    fingerprint: str


@dataclass(frozen=True)
class Restriction:
    """Conditions beside those of the query parameters.

    Attributes:
        equal: pairs of a property's name and the value it must have, as text.
        ids: identifiers of the features; None for any.
        has_geometry: whether features without a geometry are left out.
    """

    equal: tuple[tuple[str, str], ...] = ()
    ids: tuple[str, ...] | None = None
    has_geometry: bool = False


NO_RESTRICTION = Restriction()


def resolve(
    collection: Collection,
    viewer: Viewer,
    query: FeatureQuery,
    secret: bytes,
    restriction: Restriction = NO_RESTRICTION,
) -> ResolvedQuery:
    """Translate a query into the terms of the store.

    Args:
        secret: key that page tokens are signed with.

    Raises:
        InvalidParameter: a parameter cannot be used; the message names it.
    """
    selection = Selection(
        collection=collection,
        viewer=viewer,
        crs=crs_of("crs", query.crs, collection) if query.crs else collection.storage_crs,
        properties=_properties(collection, query.properties),
        condition=condition_of(collection, query, restriction),
        order=_order(collection, query.sortby),
    )
    shared = tuple(getattr(query, name) for name in FINGERPRINTED)
    fingerprint = hashlib.sha256(repr((collection.id, viewer, shared, restriction)).encode()).hexdigest()
    after, matched = None, None
    if query.token is not None:
        after, matched = parse_token(query.token, fingerprint, secret)
        if len(after) != len(selection.orders):
            raise InvalidParameter("token: not of this query; follow the link `next`")
    return ResolvedQuery(selection, min(query.limit, MOST_FEATURES), after, matched, fingerprint)


def condition_of(
    collection: Collection, query: FeatureFilter, restriction: Restriction = NO_RESTRICTION
) -> Condition:
    """The condition on features that a filter and a restriction state.

    Raises:
        InvalidParameter: a parameter cannot be used; the message names it.
    """
    parts = [*_filter_conditions(collection, query), *_restriction_conditions(collection, restriction)]
    condition = ANYTHING
    for part in parts:
        condition = part if condition is ANYTHING else condition & part
    return condition


def _filter_conditions(collection: Collection, query: FeatureFilter) -> Iterator[Condition]:
    if query.bbox is not None:
        crs = crs_of("bbox-crs", query.bbox_crs, None) if query.bbox_crs else CRS84
        yield Condition(box=parse_bbox(query.bbox, crs))
    if query.datetime is not None:
        yield in_time(collection, *parse_interval(query.datetime))
    if query.intersects is not None:
        check_size(query.intersects, "intersects")
        yield geometry_condition(collection, query.intersects, "intersects")
    if query.filter is not None:
        crs = crs_of("filter-crs", query.filter_crs, None) if query.filter_crs else CRS84
        yield _cql2_condition(query, collection, crs)


def _restriction_conditions(collection: Collection, restriction: Restriction) -> Iterator[Condition]:
    for name, value in restriction.equal:
        literal = _literal(collection.queryables[name], value)
        equal = {"op": "=", "args": [{"property": name}, literal]}
        yield translate(equal, collection, CRS84)
    if restriction.ids is not None:
        yield key_among(collection, restriction.ids)
    if restriction.has_geometry:
        yield Condition(non_bbox_predicate=collection.geometry.is_not(None))


def _cql2_condition(query: FeatureFilter, collection: Collection, crs: Crs) -> Condition:
    language = query.filter_lang or ("cql2-text" if isinstance(query.filter, str) else "cql2-json")
    if language not in FILTER_LANGUAGES:
        raise InvalidParameter(
            f"filter-lang: {language!r:.40} found, one of {', '.join(FILTER_LANGUAGES)} expected"
        )
    if language == "cql2-json":
        return translate(parse_json(query.filter), collection, crs)
    if not isinstance(query.filter, str):
        raise InvalidParameter(f"filter: an object found, text expected for filter-lang {language}")
    return translate_text(query.filter, collection, crs)


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
    """The box of a text `W,S,E,N`, or of six numbers with heights.

    Args:
        text: west greater than east crosses the antimeridian.
        crs: reference system of the numbers, which follow its order of axes.

    Raises:
        InvalidParameter: a value cannot be used; the message names it.
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


def crs_of(parameter: str, uri: str | None, collection: Collection | None) -> Crs:
    """The coordinate reference system of a URI.

    Args:
        parameter: name of the parameter, for the message.
        collection: its reference systems are allowed; None allows all that the service knows.

    Raises:
        InvalidParameter: the reference system is not allowed.
    """
    allowed = EVERY if collection is None else {crs.uri: crs for crs in collection.crs}
    crs = allowed.get((uri or "").strip("[]"))
    if crs is None:
        raise InvalidParameter(f"{parameter}: {uri!r:.100} found, one of {', '.join(allowed)} expected")
    return crs


def _properties(collection: Collection, text: str | None) -> tuple[Property, ...]:
    if text is None:
        return collection.properties
    names = [name for name in text.split(",") if name]
    for name in names:
        if name not in collection.columns:
            raise _unknown_property("properties", name, collection)
    return tuple(item for item in collection.properties if item.name in names)


def _order(collection: Collection, text: str | None) -> tuple[Order, ...]:
    orders = []
    for part in [] if text is None else text.split(","):
        name = part.strip().lstrip("+-")
        item = collection.columns.get(name)
        if item is None:
            raise _unknown_property("sortby", name, collection)
        orders.append(Order(item, part.strip().startswith("-")))
    if len(orders) > len(collection.columns):
        raise InvalidParameter("sortby: more properties than there are")
    return tuple(orders)


def _unknown_property(parameter: str, name: str, collection: Collection) -> InvalidParameter:
    names = ", ".join(collection.columns)
    return InvalidParameter(
        f"{parameter}: no property {name!r:.60} in {collection.id}: there are {names}"
    )
