"""The page of the API: its operations with their parameters, out of the OpenAPI description."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from fastapi import Request
from fastapi.responses import HTMLResponse

from amers.app.api.pages import Page, document_page
from amers.app.api.try_out import TRY_OUTS

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


GROUPS = {
    "features": ("Features", "Points, blocks, density and scenes, by box, time, condition and order."),
    "points": ("One point", "A point with all its properties, its chips, and its suspension."),
    "collections": (
        "Collections",
        "What the service has, and the properties that a condition may name.",
    ),
    "tiles": ("Tiles", "Vector tiles of points and density, and images of scenes and surfaces."),
    "blocks": ("Blocks", "Upload, publication, withdrawal, quality and deletion of blocks of points."),
    "scenes": ("Scenes", "Images with their sensor models, and files beside them."),
    "uploads": ("Resumable uploads", "Large files in pieces, by the protocol tus 1.0."),
    "processes": ("Processes", "What the service computes, with the inputs of each process."),
    "jobs": ("Jobs", "Computations that were asked for: their states, messages and results."),
    "stac": ("STAC", "Scenes with their verdicts as items of a catalogue."),
    "references": ("References", "Ortho-images on which scenes are registered without control points."),
    "tokens": ("Tokens", "Callers of the service, what they may do and what they keep."),
    "operations": (
        "Operation",
        "Figures for monitoring, the state of the installation, the audit trail.",
    ),
    "system": ("Service", "The first page, the classes of the standards, and health."),
}
"""Title and words of each group of requests, by its tag, in the order of the page."""


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


@dataclass(frozen=True)
class Group:
    """Operations about one subject."""

    title: str
    text: str
    operations: list[Operation]


def operations_page(request: Request, document: dict[str, Any]) -> HTMLResponse:
    """The description of the API for people, operations in groups."""
    found: dict[str, list[Operation]] = {}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            tag = operation.get("tags", ["other"])[0]
            found.setdefault(tag, []).append(_operation(method, path, operation))
    groups = {tag: Group(*GROUPS.get(tag, (tag, "")), found[tag]) for tag in _in_order(found)}
    info = document["info"]
    links = [
        {"rel": "service-desc", "href": f"{request.base_url}api", "title": "As OpenAPI, for programs"}
    ]
    page = Page(f"{info['title']} {info['version']}", info["description"], links)
    return document_page(request, page, "api.html", groups=groups, try_outs=TRY_OUTS)


def _in_order(tags: Iterable[str]) -> list[str]:
    """The tags in the order of `GROUPS`; others come last."""
    order = list(GROUPS)
    return sorted(tags, key=lambda tag: order.index(tag) if tag in GROUPS else len(order))


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
