"""The OpenAPI description: what FastAPI makes of the code, completed for clients of OGC API."""

from collections.abc import Sequence
from functools import cache
from itertools import chain
from typing import Any

from fastapi import APIRouter, FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from pydantic.json_schema import models_json_schema

from amers.app.api.access import declared_security, either_scheme
from amers.app.api.credentials import BASIC, BEARER
from amers.app.api.json_schemas import collection_schemas, property_schema, reference, schema_name
from amers.app.api.models.base import Link, Problem
from amers.app.api.negotiation import DOCUMENTS, FEATURES, GEOJSON, HTML, JSON, PROBLEM_JSON
from amers.app.api.openapi_30 import as_openapi_30
from amers.app.auth import Scope
from amers.app.config import Settings
from amers.app.db.features.collection import Collection, Property
from amers.app.usecases.features.items import COLLECTIONS
from amers.app.usecases.features.tiles import MATRIX_SET, MOST_ZOOM, TILED

REFUSED = {
    "description": "The request cannot be served; problem details say why.",
    "content": {PROBLEM_JSON: {"schema": reference("Problem")}},
}
SECURITY_SCHEMES = {
    BEARER: {"type": "http", "scheme": "bearer", "description": "The token."},
    BASIC: {
        "type": "http",
        "scheme": "basic",
        "description": "The token as password, with any user name, for clients without bearer tokens.",
    },
}
COMMA_SEPARATED = ("bbox", "collections", "ids")
PLACES: dict[str, dict[str, Any]] = {
    "matrix_set": {"enum": [MATRIX_SET]},
    "z": {"minimum": 0, "maximum": MOST_ZOOM},
    "y": {"minimum": 0},
    "x": {"minimum": 0},
}


def install(app: FastAPI, routers: Sequence[APIRouter], settings: Settings) -> None:
    """Give an application the completed description."""

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = get_openapi(
                title=app.title, version=app.version, description=app.description, routes=app.routes
            )
            _declare_access(document, routers, settings)
            app.openapi_schema = _completed(document)
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]
    app.state.openapi_30 = cache(lambda: as_openapi_30(openapi()))


def _declare_access(document: dict[str, Any], routers: Sequence[APIRouter], settings: Settings) -> None:
    """Give each operation the `security` that its dependencies declare."""
    for route in chain.from_iterable(router.routes for router in routers):
        if isinstance(route, APIRoute) and route.include_in_schema:
            security = declared_security(route.dependant, settings)
            for method in (route.methods or ()) if security else ():
                document["paths"][route.path_format][method.lower()]["security"] = security


def _completed(document: dict[str, Any]) -> dict[str, Any]:
    schemas = document.setdefault("components", {}).setdefault("schemas", {})
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    for collection in COLLECTIONS.values():
        schemas |= collection_schemas(collection)
    schemas |= _model_schemas()
    document["components"]["securitySchemes"] = SECURITY_SCHEMES
    for path, operations in list(document["paths"].items()):
        for operation in operations.values():
            operation["responses"].pop("422", None)
            operation["responses"]["default"] = REFUSED
            parameters = [_parameter(item, operation) for item in operation.get("parameters", [])]
            operation["parameters"] = [item for item in parameters if item is not None]
        if "{collection}" in path:
            _expand_collections(document["paths"], path)
    return document


def _model_schemas() -> dict[str, Any]:
    """Schemas of the models that only this module refers to."""
    models = [(Link, "serialization"), (Problem, "serialization")]
    _, document = models_json_schema(models, ref_template="#/components/schemas/{model}")  # type: ignore[arg-type]
    schemas: dict[str, Any] = document["$defs"]
    return schemas


def _parameter(parameter: dict[str, Any], operation: dict[str, Any]) -> dict[str, Any] | None:
    """A parameter as the standards define it, out of what the framework makes of its model.

    None for a parameter without a value: that is one of the model which the operation does not take.
    """
    kinds = [kind for kind in _kinds(parameter.pop("schema")) if kind.get("type") != "null"]
    if not kinds:
        return None
    # Objects are sent in bodies; a query has the same as text.
    schema = kinds[0]
    name, place = parameter["name"], parameter["in"]
    if place == "query" and schema.get("type") == "object":
        return {**parameter, "content": {JSON: {"schema": schema}}}
    if place == "query" and name in COMMA_SEPARATED:
        parameter |= {"style": "form", "explode": False}
    content = operation["responses"].get("200", {}).get("content", {})
    if name == "f" and HTML in content:
        schema["enum"] = list(FEATURES if FEATURES["csv"] in content else DOCUMENTS)
    return {**parameter, "schema": schema | PLACES.get(name, {})}


def _kinds(schema: dict[str, Any]) -> list[dict[str, Any]]:
    """The schemas that a value may follow, each with what they share."""
    shared = {name: value for name, value in schema.items() if name not in ("anyOf", "description")}
    return [{**shared, **kind} for kind in schema.get("anyOf", [{}])]


def _expand_collections(paths: dict[str, Any], path: str) -> None:
    """Replace a path of any collection by one for each: clients read limits and properties there."""
    operations = paths.pop(path)
    has_path = TILED if "/tiles" in path else COLLECTIONS
    for name, collection in ((name, COLLECTIONS[name]) for name in has_path):
        own_path = path.replace("{collection}", name)
        if own_path not in paths:
            paths[own_path] = {
                method: _of_collection(operation, collection, path)
                for method, operation in operations.items()
            }


def _of_collection(operation: dict[str, Any], collection: Collection, path: str) -> dict[str, Any]:
    """An operation of any collection as that of one."""
    parameters = [item for item in operation["parameters"] if item["name"] != "collection"]
    own = {
        **operation,
        "operationId": f"{operation['operationId']}_{collection.id}",
        "parameters": parameters,
    }
    if not collection.is_open:
        own["security"] = either_scheme([str(Scope.REGISTER)])
    if path.endswith("/items"):
        own["parameters"] = parameters + [_equal(item) for item in collection.queryables.values()]
    if path.endswith(("/items", "/search")):
        own["responses"] = _with_geojson(schema_name(collection, "Page"), operation["responses"])
    elif path.endswith("/{feature_id}"):
        own["responses"] = _with_geojson(schema_name(collection, "Feature"), operation["responses"])
    return own


def _equal(item: Property) -> dict[str, Any]:
    """The parameter for features of which a property has a value."""
    schema = property_schema(item)
    return {"name": item.name, "in": "query", "required": False, "schema": schema}


def _with_geojson(name: str, responses: dict[str, Any]) -> dict[str, Any]:
    """Responses whose GeoJSON follows a schema."""
    ok = responses["200"]
    content = {**ok["content"], GEOJSON: {"schema": reference(name)}}
    return {**responses, "200": {**ok, "content": content}}
