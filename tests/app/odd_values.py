"""Odd values for every parameter and every member of a body that the description of the API names."""

import json
import random
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

LONG = 6000
DEPTH = 60
DEEPEST_MEMBER = 5
"""Members below this depth of a body are not taken one by one."""

TEXTS: tuple[str, ...] = (
    "",
    " ",
    "\0",
    "a\0b",
    "".join(map(chr, range(1, 32))),
    "\x7f\x80\x9f",
    "\ud800",
    "x\udfff",
    "\r\nX-Injected: yes",
    "\u202egnp.exe",
    "\ufeffpoints",
    "\u0430dmin",
    "\uff50oints",
    "\u0130\u0131\ufb03\u1e9e",
    "e\u0301" * 50,
    "\U0001f6f0\U0010ffff",
    "\u0663\u0664",
    "' or 1=1 --",
    '"; drop table job; --',
    "$$; select pg_sleep(20); $$",
    "%s%n%x",
    "\\",
    "%00",
    "%",
    "%ff%fe",
    "<script>alert(1)</script>",
    "<!ENTITY x SYSTEM 'file:///etc/passwd'>",
    "{{7*7}}${7*7}",
    "../../../../etc/passwd",
    "..\\..\\secret",
    "/etc/passwd",
    "/vsicurl/http://127.0.0.1:1/x",
    "file:///etc/passwd",
    "s3://bucket/key",
    ".",
    "..",
    "-",
    "--help",
    "null",
    "None",
    "true",
    "NaN",
    "-Infinity",
    "1e999",
    "-0",
    "0x10",
    "1_000",
    "9" * 400,
    "-1",
    "1.5",
    ",",
    ",,,,",
    "1,2,3",
    "nan,nan,nan,nan",
    "180,90,-180,-90",
    "1e308,1e308,1e309,1e309",
    "..",
    "../..",
    "0000-00-00",
    "9999-12-31T23:59:60Z",
    "2024-02-30/..",
    "10000-01-01T00:00:00Z",
    "-4713-01-01",
    "2024-01-01T00:00:00+99:99",
    "http://www.opengis.net/def/crs/EPSG/0/99999999",
    "urn:ogc:def:crs:EPSG::0",
    "POINT EMPTY",
    "00000000-0000-0000-0000-000000000000",
    "{00000000-0000-0000-0000-000000000000}",
    "a" * LONG,
    "\u00e9" * LONG,
    "[" * 200,
    "(" * 200,
    "'" * 201,
    "*" * 300,
)
NUMBERS: tuple[Any, ...] = (
    0,
    -1,
    1,
    2**15,
    2**31,
    -(2**31) - 1,
    2**53 + 1,
    2**63,
    -(2**63) - 1,
    2**64,
    10**400,
    0.1,
    -0.0,
    5e-324,
    1e308,
    -1e308,
    float("nan"),
    float("inf"),
    float("-inf"),
)
OTHERS: tuple[Any, ...] = (None, True, False)


def nested(opening: str) -> Any:
    """A list or an object inside itself, many times."""
    value: Any = 1
    for _ in range(DEPTH):
        value = [value] if opening == "[" else {"a": value}
    return value


LISTS: tuple[Any, ...] = (
    [],
    [None],
    [[]],
    ["\ud800"],
    [float("nan")] * 4,
    [1e308, -1e308, 10**400, 2**63],
    list(range(LONG)),
    ["a"] * 100,
    nested("["),
    [{"": []}],
)
OBJECTS: tuple[Any, ...] = (
    {},
    {"": ""},
    {"\ud800": 1},
    {"\0": "\0"},
    {"__proto__": {"admin": True}, "constructor": None},
    {"type": "Point", "coordinates": [float("nan"), float("inf")]},
    {"type": "Polygon", "coordinates": []},
    {"op": "not", "args": []},
    {"href": "file:///etc/passwd"},
    {"value": {"value": 1}},
    nested("{"),
)
BY_TYPE: dict[str, tuple[Any, ...]] = {
    "string": TEXTS,
    "integer": NUMBERS,
    "number": NUMBERS,
    "boolean": (*OTHERS, 2, "yes"),
    "array": LISTS,
    "object": OBJECTS,
    "null": OTHERS,
}
ALL: tuple[Any, ...] = (*TEXTS, *NUMBERS, *OTHERS, *LISTS, *OBJECTS)


@dataclass(frozen=True)
class Target:
    """One parameter, or one member of a body, of one operation.

    Attributes:
        method, path: of the operation.
        place: path, query, header or body.
        name: of the parameter, or the names that lead to the member.
        types: of its schema.
    """

    method: str
    path: str
    place: str
    name: tuple[str, ...]
    types: tuple[str, ...]

    def value(self, chance: random.Random) -> Any:
        """An odd value, two times out of three one of the right type."""
        fitting = [value for kind in self.types for value in BY_TYPE[kind]]
        return chance.choice(fitting if fitting and chance.random() < 0.67 else ALL)


def targets(document: dict[str, Any], inputs: dict[str, dict[str, Any]]) -> list[Target]:
    """All parameters and members of a description.

    Args:
        inputs: the JSON Schema of the inputs of each process, which the description leaves open.
    """
    found = []
    schemas = document["components"]["schemas"]
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            for item in operation["parameters"]:
                kinds = _types(item.get("schema", {"type": "string"}), schemas)
                found.append(Target(method, path, item["in"], (item["name"],), kinds))
            content = operation.get("requestBody", {}).get("content", {}).get("application/json")
            if content is not None:
                for name, kinds in _members(content["schema"], schemas):
                    found.append(Target(method, path, "body", name, kinds))
    execute = "/processes/{process_id}/execution"
    for process, schema in inputs.items():
        for name, kinds in _members(schema, schema.get("$defs", {})):
            path = execute.replace("{process_id}", process)
            found.append(Target("post", path, "body", ("inputs", *name), kinds))
    return found


def _resolved(schema: dict[str, Any], schemas: dict[str, Any]) -> list[dict[str, Any]]:
    """The schemas that a value may follow, without references."""
    if "$ref" in schema:
        return _resolved(schemas[schema["$ref"].rsplit("/", 1)[1]], schemas)
    choices = schema.get("anyOf") or schema.get("oneOf") or schema.get("allOf")
    if choices:
        return [kind for choice in choices for kind in _resolved(choice, schemas)]
    return [schema]


def _types(schema: dict[str, Any], schemas: dict[str, Any]) -> tuple[str, ...]:
    kinds = [kind.get("type", "string") for kind in _resolved(schema, schemas)]
    return tuple(dict.fromkeys(kind for kind in kinds if kind in BY_TYPE))


def _members(
    schema: dict[str, Any], schemas: dict[str, Any], depth: int = 0
) -> Iterator[tuple[tuple[str, ...], tuple[str, ...]]]:
    """The members of a body with their types; the body itself has no name."""
    yield (), _types(schema, schemas)
    for kind in _resolved(schema, schemas) if depth < DEEPEST_MEMBER else ():
        for name, member in kind.get("properties", {}).items():
            for below, types in _members(member, schemas, depth + 1):
                yield (name, *below), types


def json_text(value: Any) -> bytes:
    """JSON with NaN, infinities and lone surrogates, as careless or hostile senders write it."""
    return json.dumps(value).encode()


def in_url(value: Any) -> str:
    """A value in a path or a query; lone surrogates become bytes that are no UTF-8."""
    text = value if isinstance(value, str) else json.dumps(value)
    return quote(text.encode("utf-8", "surrogatepass"), safe="")


def with_member(body: Any, name: tuple[str, ...], value: Any) -> Any:
    """A body in which one member has another value."""
    if not name:
        return value
    inner = body.get(name[0], {}) if isinstance(body, dict) else {}
    return {**(body if isinstance(body, dict) else {}), name[0]: with_member(inner, name[1:], value)}
