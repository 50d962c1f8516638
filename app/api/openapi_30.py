"""The description of the API in OpenAPI 3.0, for clients and test suites that do not read 3.1.

Sources: OpenAPI Specification 3.0.3 and 3.1.0; the latter describes values by JSON Schema 2020-12.
"""

from collections.abc import Callable, Mapping
from typing import Any

Json = Any
VERSION = "3.0.3"
NULL = {"type": "null"}
# What a schema of 3.0 may say in the words of JSON Schema; names that begin with `x-` are free.
KEPT = frozenset(
    (
        "$ref",
        "title",
        "description",
        "default",
        "format",
        "enum",
        "required",
        "deprecated",
        "readOnly",
        "writeOnly",
        "example",
        "nullable",
        "discriminator",
        "multipleOf",
        "maximum",
        "minimum",
        "maxLength",
        "minLength",
        "pattern",
        "maxItems",
        "minItems",
        "uniqueItems",
        "maxProperties",
        "minProperties",
    )
)


def as_openapi_30(document: Mapping[str, Json]) -> dict[str, Json]:
    """A description in OpenAPI 3.1 as one in 3.0; what 3.0 has no word for is left out.

    Args:
        document: not changed.
    """
    components = dict(document.get("components", {}))
    schemas = {name: _schema(schema) for name, schema in components.pop("schemas", {}).items()}
    return {
        "openapi": VERSION,
        "info": {name: value for name, value in document["info"].items() if name != "summary"},
        **{name: document[name] for name in ("servers", "tags", "externalDocs") if name in document},
        "paths": _described(document["paths"]),
        "components": {**_described(components), "schemas": schemas},
    }


def _described(node: Json) -> Json:
    """A part of the description outside of schemas."""
    if isinstance(node, list):
        return [_described(item) for item in node]
    if not isinstance(node, dict):
        return node
    return {name: _member(name, value) for name, value in node.items()}


def _member(name: str, value: Json) -> Json:
    if name == "schema":
        return _schema(value)
    if name == "security":
        # 3.0 knows scopes of OAuth and OpenID Connect only.
        return [{scheme: [] for scheme in requirement} for requirement in value]
    return _described(value)


def _schema(schema: Json) -> dict[str, Json]:
    """A JSON Schema 2020-12 in the words of OpenAPI 3.0."""
    if isinstance(schema, bool):
        return {} if schema else {"not": {}}
    out = {name: value for name, value in schema.items() if name in KEPT or name.startswith("x-")}
    for name, value in schema.items():
        if name in CONVERTED:
            out |= CONVERTED[name](value)
    for name in ("anyOf", "oneOf", "allOf"):
        if name in schema:
            out |= _alternatives(name, schema[name])
    if out.get("type") == "array":
        out.setdefault("items", {})
    if "$ref" in out and len(out) > 1:
        # What stands beside a reference is ignored in 3.0.
        out["allOf"] = [{"$ref": out.pop("$ref")}]
    return out


def _alternatives(name: str, schemas: list[Json]) -> dict[str, Json]:
    """Alternatives without null, which becomes `nullable`; a single one is what it says."""
    known = [_schema(schema) for schema in schemas if schema != NULL]
    nullable = {"nullable": True} if len(known) < len(schemas) else {}
    if len(known) == 1 and nullable:
        return {**({"allOf": known} if "$ref" in known[0] else known[0]), **nullable}
    return {name: known, **nullable}


def _types(value: Json) -> dict[str, Json]:
    types = [value] if isinstance(value, str) else value
    known = [kind for kind in types if kind != "null"]
    nullable = {"nullable": True} if len(known) < len(types) else {}
    if not known:
        return {"enum": [None], **nullable}
    if len(known) == 1:
        return {"type": known[0], **nullable}
    return {"anyOf": [_schema({"type": kind}) for kind in known], **nullable}


def _tuple(value: list[Json]) -> dict[str, Json]:
    """Items that differ by their place: each may be any of them."""
    kinds: list[Json] = []
    for schema in map(_schema, value):
        kinds += [] if schema in kinds else [schema]
    return {"items": kinds[0] if len(kinds) == 1 else {"anyOf": kinds}}


def _bound(side: str) -> Callable[[Json], dict[str, Json]]:
    return lambda value: {side: value, f"exclusive{side.capitalize()}": True}


CONVERTED: Mapping[str, Callable[[Json], dict[str, Json]]] = {
    "type": _types,
    "const": lambda value: {"enum": [value]},
    "examples": lambda value: {"example": value[0]} if value else {},
    "exclusiveMinimum": _bound("minimum"),
    "exclusiveMaximum": _bound("maximum"),
    "prefixItems": _tuple,
    "items": lambda value: {"items": _schema(value)},
    "not": lambda value: {"not": _schema(value)},
    "properties": lambda value: {"properties": {name: _schema(one) for name, one in value.items()}},
    "additionalProperties": lambda value: {
        "additionalProperties": value if isinstance(value, bool) else _schema(value)
    },
}
