"""The description of the API: what the framework makes of the code, and what OGC clients look for."""

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from app.api.json_schemas import COMPONENTS, feature_schema, page_schema, property_schema, reference
from app.api.negotiation import DOCUMENTS, FEATURES, GEOJSON, HTML, PROBLEM_JSON
from app.db.features.collection import Collection, Property
from app.usecases.features.items import COLLECTIONS
from app.usecases.features.tiles import MATRIX_SET, MOST_ZOOM

REFUSED = {
    "description": "What was wrong, as problem details.",
    "content": {PROBLEM_JSON: {"schema": reference("Problem")}},
}

_BY_COMMAS = {"style": "form", "explode": False}
LISTS = {
    "bbox": {
        "schema": {"type": "array", "items": {"type": "number"}, "minItems": 4, "maxItems": 6},
        **_BY_COMMAS,
    },
    "ids": {"schema": {"type": "array", "items": {"type": "integer"}, "minItems": 1}, **_BY_COMMAS},
}
PLACES: dict[str, dict[str, Any]] = {
    "matrix_set": {"enum": [MATRIX_SET]},
    "z": {"minimum": 0, "maximum": MOST_ZOOM},
    "y": {"minimum": 0},
    "x": {"minimum": 0},
}


def install(app: FastAPI) -> None:
    """Make the application describe itself so."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            made = get_openapi(
                title=app.title, version=app.version, description=app.description, routes=app.routes
            )
            app.openapi_schema = _finished(made)
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _finished(document: dict[str, Any]) -> dict[str, Any]:
    schemas = document.setdefault("components", {}).setdefault("schemas", {})
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    schemas |= COMPONENTS
    document["components"]["securitySchemes"] = {"bearer": {"type": "http", "scheme": "bearer"}}
    document["security"] = [{"bearer": []}, {}]
    for path, operations in list(document["paths"].items()):
        for operation in operations.values():
            operation["responses"].pop("422", None)
            operation["responses"]["default"] = REFUSED
            for parameter in operation.get("parameters", []):
                _define(parameter, operation)
        if "{collection}" in path:
            _spell_out(document["paths"], path)
    return document


def _define(parameter: dict[str, Any], operation: dict[str, Any]) -> None:
    """What the code takes as text and reads by itself, as the standards define it."""
    parameter["schema"] = _without_null(parameter["schema"])
    content = operation["responses"].get("200", {}).get("content", {})
    if parameter["name"] in ("bbox", "ids") and parameter["in"] == "query":
        parameter |= LISTS[parameter["name"]]
    elif parameter["name"] == "f" and HTML in content:
        formats = FEATURES if FEATURES["csv"] in content else DOCUMENTS
        parameter["schema"]["enum"] = list(formats)
    elif parameter["name"] in PLACES:
        parameter["schema"] |= PLACES[parameter["name"]]


def _without_null(schema: dict[str, Any]) -> dict[str, Any]:
    """A parameter that may be left out: nobody can send null."""
    kinds = [kind for kind in schema.get("anyOf", []) if kind != {"type": "null"}]
    if len(kinds) != 1:
        return schema
    return {**{name: value for name, value in schema.items() if name != "anyOf"}, **kinds[0]}


def _spell_out(paths: dict[str, Any], path: str) -> None:
    """A path for each collection: there clients look for the largest page and what filters may name."""
    operations = paths.pop(path)
    for name, collection in COLLECTIONS.items():
        own = path.replace("{collection}", name)
        if own not in paths:
            paths[own] = {
                method: _of_collection(operation, collection, path)
                for method, operation in operations.items()
            }


def _of_collection(operation: dict[str, Any], collection: Collection, path: str) -> dict[str, Any]:
    parameters = [item for item in operation.get("parameters", []) if item["name"] != "collection"]
    own = {
        **operation,
        "operationId": f"{operation['operationId']}_{collection.id}",
        "parameters": parameters,
    }
    if path.endswith("/items"):
        own["parameters"] = parameters + [_equal(item) for item in collection.queryables.values()]
    if path.endswith(("/items", "/search")):
        own["responses"] = _giving(page_schema(collection), operation["responses"])
    elif path.endswith("/{feature_id}"):
        own["responses"] = _giving(feature_schema(collection), operation["responses"])
    return own


def _equal(item: Property) -> dict[str, Any]:
    """The parameter that asks for features of which a property has a value."""
    schema = property_schema(item)
    return {"name": item.name, "in": "query", "required": False, "schema": schema}


def _giving(schema: dict[str, Any], responses: dict[str, Any]) -> dict[str, Any]:
    good = responses["200"]
    content = {**good["content"], GEOJSON: {"schema": schema}}
    return {**responses, "200": {**good, "content": content}}
