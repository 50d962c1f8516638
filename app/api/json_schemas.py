"""JSON Schemas of the features that the database builds: their properties, a feature, a page.

Sources: RFC 7946; OGC 17-069r4 (Features); OGC 23-058 (Features - Part 5, schemas).
"""

from typing import Any

from amers.app.db.features.collection import Collection, Property

Schema = dict[str, Any]

JSON_TYPES: dict[str, dict[str, str]] = {
    "bigint": {"type": "integer"},
    "real": {"type": "number"},
    "double precision": {"type": "number"},
    "text": {"type": "string"},
    "boolean": {"type": "boolean"},
    "date": {"type": "string", "format": "date"},
    "timestamptz": {"type": "string", "format": "date-time"},
}
COUNT: Schema = {"type": "integer", "minimum": 0}


def reference(name: str) -> Schema:
    """A reference to a schema of the API's description."""
    return {"$ref": f"#/components/schemas/{name}"}


LINKS: Schema = {"type": "array", "items": reference("Link")}


def property_schema(item: Property) -> Schema:
    """A property whose value is known."""
    schema: Schema = {"title": item.title, **JSON_TYPES[item.type]}
    if item.choices:
        schema["enum"] = list(item.choices)
    if item.unit:
        schema["x-ogc-unit"] = item.unit
    return schema


def geometry_schema(collection: Collection) -> Schema:
    """The geometry of a collection as OGC API - Features - Part 5 describes it."""
    return {"title": "Geometry", "format": _geometry_format(collection)}


def _geometry_format(collection: Collection) -> str:
    # Outlines are cut at 180 degrees, into several polygons.
    kind = "point" if collection.geometry_type == "Point" else "polygon-or-multipolygon"
    return f"geometry-{kind}"


def schema_name(collection: Collection, kind: str = "") -> str:
    """The name of a schema of a collection: `PointFeature`, `PointHistoryPage`."""
    words = collection.id.removesuffix("s").split("-")
    return "".join(word.capitalize() for word in words) + kind


def collection_schemas(collection: Collection) -> dict[str, Schema]:
    """The schemas of the features of a collection, by name."""
    return {
        schema_name(collection, "FeatureProperties"): _properties_schema(collection),
        schema_name(collection, "Feature"): _feature_schema(collection),
        schema_name(collection, "Page"): _page_schema(collection),
    }


def _properties_schema(collection: Collection) -> Schema:
    """The properties of a feature; a request may ask for some of them only."""
    return {
        "type": "object",
        "description": f"Properties of a feature of the collection {collection.id}.",
        "properties": {item.name: _nullable_schema(item) for item in collection.columns.values()},
    }


def _feature_schema(collection: Collection) -> Schema:
    kinds = [collection.geometry_type, f"Multi{collection.geometry_type}"]
    geometry = {
        "type": ["object", "null"],
        "format": _geometry_format(collection),
        "required": ["type", "coordinates"],
        "properties": {"type": {"enum": kinds}, "coordinates": {"type": "array"}},
    }
    return {
        "type": "object",
        "description": f"A feature of the collection {collection.id} in GeoJSON.",
        "required": ["type", "id", "geometry", "properties"],
        "properties": {
            "type": {"const": "Feature"},
            "id": JSON_TYPES[collection.key.type],
            "geometry": geometry,
            "properties": reference(schema_name(collection, "FeatureProperties")),
            "links": LINKS,
        },
    }


def _page_schema(collection: Collection) -> Schema:
    return {
        "type": "object",
        "description": f"A page of features of the collection {collection.id} in GeoJSON.",
        "required": ["type", "features", "links", "numberMatched", "numberReturned"],
        "properties": {
            "type": {"const": "FeatureCollection"},
            "features": {"type": "array", "items": reference(schema_name(collection, "Feature"))},
            "links": LINKS,
            "numberMatched": COUNT,
            "numberReturned": COUNT,
            "amers:numberMatchedIsExact": {"type": "boolean"},
        },
    }


def _nullable_schema(item: Property) -> Schema:
    schema = property_schema(item)
    if item.nullable:
        schema["type"] = [schema["type"], "null"]
        if item.choices:
            schema["enum"] = [*item.choices, None]
    return schema
