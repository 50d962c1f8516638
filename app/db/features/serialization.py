"""A feature as a text made by the database: GeoJSON or a line of CSV."""

import json

from app.db.features.collection import Property
from app.db.features.crs import from_storage, in_own_order
from app.db.features.query import Selection

DEGREE_DIGITS = 9
"""Decimals of a degree in replies: a tenth of a millimetre."""
METRE_DIGITS = 4


def feature_text(selection: Selection) -> str:
    """SQL of one feature as GeoJSON text; texts and dates are quoted by to_json, numbers are finite."""
    collection = selection.collection
    digits = DEGREE_DIGITS if selection.crs.in_degrees else METRE_DIGITS
    geometry = in_own_order(from_storage(collection.geometry, selection.crs), selection.crs)
    parts = [
        """'{"type":"Feature","id":'""",
        _json(collection.key),
        """',"geometry":'""",
        f"coalesce(st_asgeojson({geometry}, {digits}, 0), 'null')",
        """',"properties":{'""",
    ]
    for number, item in enumerate(selection.properties):
        parts += [f"'{',' if number else ''}{json.dumps(item.name)}:'", _json(item)]
    parts += ["'}'", *([collection.members] if collection.members else []), "'}'"]
    return f"concat({', '.join(parts)})"


def csv_header(selection: Selection) -> str:
    """The names of the columns of CSV."""
    names = [selection.collection.key.name, *_position_names(selection)]
    return ",".join([*names, *(item.name for item in selection.properties)])


def _position_names(selection: Selection) -> tuple[str, ...]:
    if selection.collection.geometry_type != "Point":
        return ("wkt",)
    if not selection.crs.in_degrees:
        return ("east_m", "north_m")
    return ("lon_deg", "lat_deg", "height_m") if selection.crs.has_height else ("lon_deg", "lat_deg")


def csv_text(selection: Selection) -> str:
    """SQL of a line of CSV; columns are named, so longitude is first whatever the reference system."""
    collection = selection.collection
    geometry = from_storage(collection.geometry, selection.crs)
    if collection.geometry_type == "Point":
        axes = ("st_x", "st_y", "st_z")[: len(_position_names(selection))]
        position = [f"{axis}({geometry})::text" for axis in axes]
    else:
        position = [f"'\"' || st_astext({geometry}, {DEGREE_DIGITS}) || '\"'"]
    values = [_csv(collection.key), *position, *(_csv(item) for item in selection.properties)]
    return f"concat_ws(',', {', '.join(values)})"


def _json(item: Property) -> str:
    sql = item.expression
    if item.type == "boolean":
        sql = f"({sql})::text"
    elif not item.is_number:
        sql = f"to_json({sql})::text"
    return f"coalesce(({sql})::text, 'null')" if item.nullable else sql


def _csv(item: Property) -> str:
    sql = f"({plain_value(item)})::text"
    if item.type == "text":
        sql = f"'\"' || replace({sql}, '\"', '\"\"') || '\"'"
    return f"coalesce({sql}, '')" if item.nullable else sql


def plain_value(item: Property) -> str:
    """A value of the few types that files of all formats have: dates are text in ISO 8601."""
    if item.is_time:
        return f"(to_json({item.expression}) #>> '{{}}')"
    return item.expression
