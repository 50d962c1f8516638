"""JSON Schemas of what is served: of the properties of a collection, and of the documents of OGC API.

Sources: OGC 17-069r4 (Features), OGC 20-057 (Tiles), OGC 19-072 (Common); RFC 7946, RFC 9457.
"""

from typing import Any

from app.api.negotiation import HTML, JSON
from app.db.features.collection import Collection, Property

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


def reference(name: str) -> Schema:
    """A schema of `COMPONENTS`, by name."""
    return {"$ref": f"#/components/schemas/{name}"}


def document_of(name: str, kind: str = JSON) -> dict[int | str, dict[str, Any]]:
    """What the description of the API says of a document that is a page for people too."""
    return {200: {"description": name, "content": {kind: {"schema": reference(name)}, HTML: {}}}}


def json_of(name: str) -> dict[int | str, dict[str, Any]]:
    """What the description of the API says of a document that is JSON only."""
    return {200: {"description": name, "content": {JSON: {"schema": reference(name)}}}}


def property_schema(item: Property) -> Schema:
    """A property that is known."""
    said: Schema = {"title": item.title, **JSON_TYPES[item.type]}
    if item.choices:
        said["enum"] = list(item.choices)
    if item.unit:
        said["x-ogc-unit"] = item.unit
    return said


def geometry_schema(collection: Collection) -> Schema:
    """The geometry of a collection, as OGC API - Features - Part 5 says it."""
    # Outlines are cut at 180 degrees.
    kind = "point" if collection.geometry_type == "Point" else "polygon-or-multipolygon"
    return {"title": "Geometry", "format": f"geometry-{kind}"}


def feature_schema(collection: Collection) -> Schema:
    """A feature in GeoJSON; those that are asked for alone may have more properties."""
    kinds = [collection.geometry_type, f"Multi{collection.geometry_type}"]
    geometry = {
        "type": ["object", "null"],
        "required": ["type", "coordinates"],
        "properties": {"type": {"enum": kinds}, "coordinates": {"type": "array"}},
    }
    properties = {item.name: _perhaps_null(item) for item in collection.queryables.values()}
    return {
        "type": "object",
        "required": ["type", "id", "geometry", "properties"],
        "properties": {
            "type": {"const": "Feature"},
            "id": JSON_TYPES[collection.key.type],
            "geometry": geometry,
            "properties": {"type": "object", "properties": properties},
            "links": LINKS,
        },
    }


def page_schema(collection: Collection) -> Schema:
    """A page of features in GeoJSON."""
    return {
        "type": "object",
        "required": ["type", "features", "links", "numberMatched", "numberReturned"],
        "properties": {
            "type": {"const": "FeatureCollection"},
            "features": {"type": "array", "items": feature_schema(collection)},
            "links": LINKS,
            "numberMatched": COUNT,
            "numberReturned": COUNT,
            "amers:numberMatchedIsExact": {"type": "boolean"},
        },
    }


def _perhaps_null(item: Property) -> Schema:
    said = property_schema(item)
    if item.nullable:
        said["type"] = [said["type"], "null"]
        if item.choices:
            said["enum"] = [*item.choices, None]
    return said


def _object(required: str, **properties: Schema) -> Schema:
    return {"type": "object", "required": required.split(), "properties": properties}


def _array(items: Schema) -> Schema:
    return {"type": "array", "items": items}


TEXT: Schema = {"type": "string"}
TEXTS = _array(TEXT)
COUNT: Schema = {"type": "integer", "minimum": 0}
LINKS = _array(reference("Link"))
BOXES = _array({"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 6})
COMPONENTS: dict[str, Schema] = {
    "Problem": {
        **_object("type title status detail", type=TEXT, title=TEXT, status=COUNT, detail=TEXT),
        "description": "Problem details, RFC 9457.",
    },
    "Link": _object("rel href", rel=TEXT, href=TEXT, type=TEXT, title=TEXT),
    "Landing": _object("title links", title=TEXT, description=TEXT, links=LINKS),
    "Conformance": _object("conformsTo", conformsTo=TEXTS),
    "Collections": _object(
        "links collections", links=LINKS, collections=_array(reference("Collection"))
    ),
    "Collection": _object(
        "id links",
        id=TEXT,
        title=TEXT,
        description=TEXT,
        itemType=TEXT,
        crs=TEXTS,
        storageCrs=TEXT,
        extent=_object("spatial", spatial=_object("bbox", bbox=BOXES, crs=TEXT)),
        links=LINKS,
    ),
    "JsonSchema": _object(
        "$schema $id type properties",
        **{"$schema": TEXT, "$id": TEXT, "type": {"const": "object"}, "properties": {"type": "object"}},
    ),
    "TileSets": _object("tilesets", tilesets=_array(reference("TileSet"))),
    "TileSet": _object(
        "dataType crs links",
        title=TEXT,
        dataType={"const": "vector"},
        crs=TEXT,
        tileMatrixSetURI=TEXT,
        links=LINKS,
        layers=_array(_object("id dataType", id=TEXT, dataType={"const": "vector"})),
    ),
    "TileMatrixSets": _object(
        "tileMatrixSets", tileMatrixSets=_array(_object("id links", id=TEXT, uri=TEXT, links=LINKS))
    ),
    "TileMatrixSet": _object(
        "id crs tileMatrices",
        id=TEXT,
        uri=TEXT,
        crs=TEXT,
        orderedAxes=TEXTS,
        tileMatrices=_array({"type": "object", "required": ["id", "scaleDenominator", "cellSize"]}),
    ),
}
