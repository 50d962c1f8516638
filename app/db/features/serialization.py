"""A feature as a text that the database makes: GeoJSON or a line of CSV."""

import json
from typing import Any

from sqlalchemy import ColumnElement, Text, case, cast, func

from amers.app.db.constants import integer_constant, text_constant
from amers.app.db.features.collection import Property
from amers.app.db.features.crs import from_storage, in_own_order
from amers.app.db.features.instants import time_text
from amers.app.db.features.query import Layout, Selection

DEGREE_DIGITS = 9
"""Decimals of a degree in replies: a tenth of a millimetre."""
METRE_DIGITS = 4
QUOTE = text_constant('"')
APOSTROPHE = text_constant("'")
FORMULA = text_constant(r"^[=@\t\r]|^[+-](?!([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?$)")
"""Texts that a table calculator would compute; numbers are not."""


def feature_text(layout: Layout) -> ColumnElement[str]:
    """One feature as GeoJSON text; texts are quoted by to_json, numbers are finite."""
    collection, crs = layout.collection, layout.crs
    digits = integer_constant(DEGREE_DIGITS if crs.in_degrees else METRE_DIGITS)
    geometry = in_own_order(from_storage(collection.geometry, crs), crs)
    parts = [
        text_constant('{"type":"Feature","id":'),
        _json(collection.key),
        text_constant(',"geometry":'),
        func.coalesce(
            func.st_asgeojson(geometry, digits, integer_constant(0), type_=Text()), text_constant("null")
        ),
        text_constant(',"properties":{'),
    ]
    for place, item in enumerate(layout.properties):
        parts += _member(f"{',' if place else ''}{json.dumps(item.name)}:", item)
    return func.concat(*parts, text_constant("}}"), type_=Text())


def csv_header(selection: Selection) -> str:
    """The names of the columns of CSV."""
    names = [selection.collection.key.name, *_position_names(selection.layout)]
    return ",".join([*names, *(item.name for item in selection.properties)])


def _position_names(layout: Layout) -> tuple[str, ...]:
    if layout.collection.geometry_type != "Point":
        return ("wkt",)
    if not layout.crs.in_degrees:
        return ("east_m", "north_m")
    return ("lon_deg", "lat_deg", "height_m") if layout.crs.has_height else ("lon_deg", "lat_deg")


def csv_text(layout: Layout) -> ColumnElement[str]:
    """A line of CSV; columns are named, so longitude is first whatever the reference system."""
    collection = layout.collection
    geometry = from_storage(collection.geometry, layout.crs)
    position: list[ColumnElement[Any]]
    if collection.geometry_type == "Point":
        axes = (func.st_x, func.st_y, func.st_z)[: len(_position_names(layout))]
        position = [cast(axis(geometry), Text()) for axis in axes]
    else:
        wkt = func.st_astext(geometry, integer_constant(DEGREE_DIGITS), type_=Text())
        # `concat_ws` leaves out what is null: the columns after it would move.
        position = [func.coalesce(QUOTE.concat(wkt).concat(QUOTE), text_constant(""))]
    values = [_csv(collection.key), *position, *(_csv(item) for item in layout.properties)]
    return func.concat_ws(text_constant(","), *values, type_=Text())


def _member(name: str, item: Property) -> list[ColumnElement[Any]]:
    """The texts of a member; one where the value may be unknown, which takes less time than two."""
    value = _json(item)
    if not item.nullable:
        return [text_constant(name), value]
    known = text_constant(name).concat(cast(value, Text()))
    return [func.coalesce(known, text_constant(f"{name}null"))]


def _json(item: Property) -> ColumnElement[Any]:
    """A value that is known, as JSON; the session writes dates in ISO 8601."""
    if item.type == "date":
        return QUOTE.concat(cast(item.expression, Text())).concat(QUOTE)
    value = plain_value(item)
    if item.is_number:
        return value
    return cast(value if item.type == "boolean" else func.to_json(value), Text())


def _csv(item: Property) -> ColumnElement[str]:
    text: ColumnElement[str] = cast(plain_value(item), Text())
    if item.type == "text":
        text = case((text.op("~")(FORMULA), APOSTROPHE.concat(text)), else_=text)
        doubled = func.replace(text, QUOTE, text_constant('""'), type_=Text())
        text = QUOTE.concat(doubled).concat(QUOTE)
    return func.coalesce(text, text_constant("")) if item.nullable else text


def plain_value(item: Property) -> ColumnElement[Any]:
    """A value of the few types that texts of all formats have: dates and times are text in RFC 3339."""
    return time_text(item) if item.is_time else item.expression
