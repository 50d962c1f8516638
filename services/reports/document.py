"""`report.json` and `block_quality.json`: reports as documents, and the JSON Schemas that describe them.

They follow the dataclasses of the report, but for plans, selections and adjustments: a field is a member
of the same name, and the descriptions are those of the docstrings. A value that could not be computed is
null.
"""

import inspect
import json
import math
import types
from dataclasses import Field, fields, is_dataclass
from datetime import datetime
from enum import StrEnum
from typing import (
    Any,
    Literal,
    Protocol,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    runtime_checkable,
)

import numpy as np

from amers.services.docstrings import attribute_descriptions
from amers.services.reports.block_quality import BLOCK_QUALITY_FORMAT, BlockQualityReport
from amers.services.reports.failure import FAILURE_FORMAT, FailureReport
from amers.services.reports.joint import JOINT_FORMAT, JointReport
from amers.services.reports.report import NOT_IN_JSON, REPORT_FORMAT, RegistrationReport


@runtime_checkable
class WithDocument(Protocol):
    """A report whose document has other members than its dataclass."""

    def document(self) -> dict[str, Any]:
        """Members of the document."""


Report = RegistrationReport | FailureReport | BlockQualityReport | JointReport | WithDocument
Json = None | bool | int | float | str | list[Any] | dict[str, Any]


def format_report(report: Report) -> str:
    """The text of a report's document."""
    return json.dumps(report_document(report), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def report_document(report: Report) -> dict[str, Any]:
    """The report as plain JSON values; numbers that are not finite become null."""
    if isinstance(report, WithDocument):
        return {name: _plain(value) for name, value in report.document().items()}
    return {field.name: _plain(getattr(report, field.name)) for field in _members(type(report))}


def _members(kind: type) -> list[Field[Any]]:
    """The fields of a dataclass that are members of the document."""
    return [field for field in fields(kind) if field.metadata != NOT_IN_JSON]


def _plain(value: Any) -> Json:
    """Any value of a report as JSON."""
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, (np.ndarray, np.generic)):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, datetime):
        return value.isoformat()
    if value is None or isinstance(value, (bool, int, str)):
        return value
    raise TypeError(f"a report cannot hold a {type(value).__name__}")


def report_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of `report.json`."""
    return _schema(RegistrationReport, "Amers registration report", REPORT_FORMAT)


def failure_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of the `report.json` of a registration that failed."""
    return _schema(FailureReport, "Amers registration failure", FAILURE_FORMAT)


def joint_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of the `report.json` of scenes registered together."""
    return _schema(JointReport, "Amers registration of scenes together", JOINT_FORMAT)


def block_quality_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of `block_quality.json`."""
    return _schema(BlockQualityReport, "Amers block quality", BLOCK_QUALITY_FORMAT)


def _schema(kind: type, title: str, document_format: str) -> dict[str, Any]:
    """JSON Schema of a report, with its title and the value of its member `format`."""
    definitions: dict[str, Any] = {
        "Numbers": {
            "description": "A number, null where it is unknown, or rows of them.",
            "type": ["number", "null", "array"],
            "items": {"$ref": "#/$defs/Numbers"},
        }
    }
    document = _object_schema(kind, definitions)
    document["properties"]["format"]["const"] = document_format
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": title,
        **document,
        "$defs": dict(sorted(definitions.items())),
    }


def _object_schema(kind: type, definitions: dict[str, Any]) -> dict[str, Any]:
    """Schema of a dataclass; schemas of the dataclasses inside it are added to the definitions."""
    hints, described = get_type_hints(kind), attribute_descriptions(kind)
    properties = {}
    for field in _members(kind):
        schema = _value_schema(hints[field.name], definitions)
        if field.name in described:
            schema = {"description": described[field.name], **schema}
        properties[field.name] = schema
    return {
        "description": (inspect.getdoc(kind) or kind.__name__).splitlines()[0],
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


_SCALARS: dict[Any, dict[str, Any]] = {
    bool: {"type": "boolean"},
    int: {"type": "integer"},
    float: {"type": ["number", "null"]},
    str: {"type": "string"},
    datetime: {"type": "string", "format": "date-time"},
    type(None): {"type": "null"},
}


def _value_schema(hint: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    """Schema of one type of a report."""
    if hint in _SCALARS:
        return dict(_SCALARS[hint])
    if is_dataclass(hint):
        name = getattr(hint, "__name__", "")
        if name not in definitions:
            definitions[name] = {}
            definitions[name] = _object_schema(hint, definitions)  # type: ignore[arg-type]
        return {"$ref": f"#/$defs/{name}"}
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return {"enum": list(arguments)}
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        return {"enum": [member.value for member in hint]}
    if origin is np.ndarray:
        return {"type": "array", "items": {"$ref": "#/$defs/Numbers"}}
    if origin is tuple:
        return {"type": "array", "items": _value_schema(arguments[0], definitions)}
    if origin in (Union, types.UnionType):
        return {"anyOf": [_value_schema(argument, definitions) for argument in arguments]}
    raise TypeError(f"no JSON Schema for {hint}")
