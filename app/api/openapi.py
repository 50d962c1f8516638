"""The description of the API: what the framework makes of the code, and what OGC clients look for."""

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from app.api.negotiation import PROBLEM_JSON
from app.usecases.features import COLLECTIONS

PROBLEM = {
    "type": "object",
    "description": "Problem details, RFC 9457.",
    "required": ["type", "title", "status", "detail"],
    "properties": {
        "type": {"type": "string"},
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "detail": {"type": "string"},
    },
}
REFUSED = {
    "description": "What was wrong, as problem details.",
    "content": {PROBLEM_JSON: {"schema": {"$ref": "#/components/schemas/Problem"}}},
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
    schemas["Problem"] = PROBLEM
    document["components"]["securitySchemes"] = {"bearer": {"type": "http", "scheme": "bearer"}}
    document["security"] = [{"bearer": []}, {}]
    for path, operations in list(document["paths"].items()):
        for operation in operations.values():
            operation["responses"].pop("422", None)
            operation["responses"]["default"] = REFUSED
        if "{collection}" in path:
            _spell_out(document["paths"], path)
    return document


def _spell_out(paths: dict[str, Any], path: str) -> None:
    """A path for each collection: clients look for the largest page under the collection's own name."""
    operations = paths.pop(path)
    for name in COLLECTIONS:
        own = path.replace("{collection}", name)
        if own not in paths:
            paths[own] = {method: _of_collection(value, name) for method, value in operations.items()}


def _of_collection(operation: dict[str, Any], name: str) -> dict[str, Any]:
    parameters = [item for item in operation.get("parameters", []) if item["name"] != "collection"]
    return {
        **operation,
        "operationId": f"{operation['operationId']}_{name}",
        "parameters": parameters,
    }
