"""Write the TypeScript types of the API's replies and of the report into the sources of the map page.

They come from the OpenAPI description and from the JSON Schema of `report.json`, which have the
descriptions of all members. With `--check` nothing is written: the exit code is 1 if a file is not up to
date.
"""

import json
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from amers.app.config import Settings
from amers.app.main import create_app
from amers.services.reports.document import report_schema

FOLDER = Path(__file__).parents[1] / "web" / "source"
HEAD = "// Types of {what}. Made by scripts/make_api_types.py; do not edit.\n"
SCALARS = {
    "string": "string",
    "number": "number",
    "integer": "number",
    "boolean": "boolean",
    "null": "null",
}
GEOMETRIES = {
    "geometry-point": "Point",
    "geometry-polygon-or-multipolygon": "Polygon | MultiPolygon",
    "geometry-any": "Geometry",
}

Schema = Mapping[str, Any]


def api_types() -> str:
    """The types of all JSON replies of the API."""
    document = create_app(Settings(data_folder=Path("unused"))).openapi()
    schemas = document["components"]["schemas"]
    replies = [
        operation["responses"] for path in document["paths"].values() for operation in path.values()
    ]
    names = _reachable(replies, schemas)
    imports = 'import type { Geometry, MultiPolygon, Point, Polygon } from "geojson";\n'
    head = HEAD.format(what="the JSON replies of the service") + "\n" + imports
    return "\n".join([head, *(_declaration(name, schemas[name]) for name in sorted(names))])


def report_types() -> str:
    """The types of `report.json`."""
    schema = report_schema()
    definitions = {"Report": schema, **schema["$defs"]}
    head = HEAD.format(what="report.json, the report of a registration")
    return "\n".join([head, *(_declaration(name, definitions[name]) for name in sorted(definitions))])


FILES = {"api_types.ts": api_types, "report_types.ts": report_types}


def main(arguments: list[str]) -> int:
    """Write the files, or compare them."""
    outdated = []
    for name, make in FILES.items():
        path, text = FOLDER / name, make()
        if path.is_file() and path.read_text() == text:
            continue
        outdated.append(name)
        if "--check" not in arguments:
            path.write_text(text)
    if outdated and "--check" in arguments:
        print(f"{', '.join(outdated)}: not up to date; run python scripts/make_api_types.py")
        return 1
    return 0


def _reachable(roots: object, schemas: Mapping[str, Schema]) -> set[str]:
    """The names of all schemas that some JSON values refer to, directly or not."""
    found: set[str] = set()
    waiting = [roots]
    while waiting:
        for name in set(_references(waiting.pop())) - found:
            found.add(name)
            waiting.append(schemas[name])
    return found


def _references(value: object) -> Iterator[str]:
    if isinstance(value, dict):
        if "$ref" in value:
            yield _referred(value)
        for member in value.values():
            yield from _references(member)
    elif isinstance(value, list):
        for item in value:
            yield from _references(item)


def _referred(schema: Schema) -> str:
    return str(schema["$ref"]).rsplit("/", 1)[1]


def _declaration(name: str, schema: Schema) -> str:
    if schema.get("type") == "object" and "properties" in schema:
        return f"export interface {name} {_members(schema)}\n"
    return f"export type {name} = {_type(schema)};\n"


def _members(schema: Schema) -> str:
    """The members of an object, a line for each."""
    required = schema.get("required", ())
    lines = []
    for name, member in schema["properties"].items():
        key = name if name.isidentifier() else json.dumps(name)
        mark = "" if name in required else "?"
        lines.append(f"  {key}{mark}: {_type(member)};\n")
    if schema.get("additionalProperties") is True:
        lines.append("  [member: string]: unknown;\n")
    return "{\n" + "".join(lines) + "}"


def _type(schema: Schema) -> str:
    """A schema as a TypeScript type."""
    if "$ref" in schema:
        return _referred(schema)
    if "const" in schema:
        return json.dumps(schema["const"])
    if "enum" in schema:
        return " | ".join(json.dumps(value) for value in schema["enum"])
    if "anyOf" in schema:
        return _union(_type(kind) for kind in schema["anyOf"])
    if schema.get("format") in GEOMETRIES:
        nullable = isinstance(schema.get("type"), list) and "null" in schema["type"]
        return GEOMETRIES[schema["format"]] + " | null" * nullable
    kinds = schema.get("type", ())
    return _union(_type_of_kind(kind, schema) for kind in ([kinds] if isinstance(kinds, str) else kinds))


def _type_of_kind(kind: str, schema: Schema) -> str:
    if kind == "array" and "prefixItems" in schema:
        return f"[{', '.join(_type(item) for item in schema['prefixItems'])}]"
    if kind == "array":
        item = _type(schema.get("items", {}))
        return f"({item})[]" if " | " in item else f"{item}[]"
    if kind == "object":
        values = schema.get("additionalProperties")
        return f"Record<string, {_type(values) if isinstance(values, dict) else 'unknown'}>"
    return SCALARS[kind]


def _union(types: Iterator[str]) -> str:
    """Types of which one holds; `unknown` for none."""
    return " | ".join(dict.fromkeys(types)) or "unknown"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
