"""The page of the API: its operations with their parameters, out of the OpenAPI description."""

from dataclasses import dataclass
from typing import Any

from fastapi import Request
from fastapi.responses import HTMLResponse

from amers.app.api.pages import Page, document_page

BOUNDS = {
    "minimum": "at least {}",
    "exclusiveMinimum": "above {}",
    "maximum": "at most {}",
    "exclusiveMaximum": "below {}",
    "maxLength": "at most {} characters",
    "minItems": "at least {} of them",
    "maxItems": "at most {} of them",
    "default": "default {}",
}


@dataclass(frozen=True)
class Parameter:
    """A parameter of an operation.

    Attributes:
        place: path, query or header.
        values: which it takes, in words.
    """

    name: str
    place: str
    required: bool
    values: str
    text: str


@dataclass(frozen=True)
class Operation:
    """An operation as the page shows it.

    Attributes:
        access: who may use it.
        body: kinds of its body, and the schema of JSON; "" without a body.
        replies: media types of its reply.
    """

    id: str
    method: str
    path: str
    text: str
    access: str
    parameters: tuple[Parameter, ...]
    body: str
    replies: str


def operations_page(request: Request, document: dict[str, Any]) -> HTMLResponse:
    """The description of the API for people, operations in groups."""
    groups: dict[str, list[Operation]] = {}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            tag = operation.get("tags", ["other"])[0]
            groups.setdefault(tag, []).append(_operation(method, path, operation))
    info = document["info"]
    links = [
        {"rel": "service-desc", "href": f"{request.base_url}api", "title": "As OpenAPI, for programs"}
    ]
    page = Page(f"{info['title']} {info['version']}", info["description"], links)
    return document_page(request, page, "api.html", groups=groups)


def _operation(method: str, path: str, operation: dict[str, Any]) -> Operation:
    replies = {
        kind: None for reply in operation["responses"].values() for kind in reply.get("content", {})
    }
    return Operation(
        id=operation["operationId"],
        method=method.upper(),
        path=path,
        text=operation.get("description", ""),
        access=_access(operation.get("security", [])),
        parameters=tuple(map(_parameter, operation["parameters"])),
        body=_body(operation.get("requestBody", {}).get("content", {})),
        replies=", ".join(replies) or "without content",
    )


def _access(security: list[dict[str, list[str]]]) -> str:
    """Who may use an operation with these requirements, of which one has to be met."""
    if not security or {} in security:
        return "everybody"
    scopes = {scope for requirement in security for names in requirement.values() for scope in names}
    return f"a token with scope {', '.join(sorted(scopes))}" if scopes else "any valid token"


def _parameter(parameter: dict[str, Any]) -> Parameter:
    content = parameter.get("content", {})
    schema = parameter.get("schema") or next(iter(content.values()))["schema"]
    return Parameter(
        name=parameter["name"],
        place=parameter["in"],
        required=parameter.get("required", False),
        values=_values(schema),
        text=parameter.get("description", ""),
    )


def _values(schema: dict[str, Any]) -> str:
    """The values that a schema allows, in words."""
    if "enum" in schema:
        kind = ", ".join(map(str, schema["enum"]))
    elif schema.get("type") == "array":
        kind = f"list of {_values(schema['items'])}" if schema.get("items") else "list"
    else:
        kind = str(schema.get("format") or schema.get("type", "any"))
    bounds = [
        words.format(schema[name]) for name, words in BOUNDS.items() if schema.get(name) is not None
    ]
    return "; ".join([kind, *bounds])


def _body(content: dict[str, Any]) -> str:
    """The kinds of a body, with the name of the schema where it has one."""
    return ", ".join(
        f"{kind} ({schema.rsplit('/', 1)[1]})" if schema else kind
        for kind, media in content.items()
        for schema in [media.get("schema", {}).get("$ref", "")]
    )
