"""What models of replies share: links, problem details, members that may be missing."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

JsonObject = dict[str, Any]
Schema = dict[str, Any]


def _simplify(schema: Schema) -> None:
    """Drop the titles of members, and null from the types of members that may be missing."""
    required = schema.get("required", [])
    for name, member in schema.get("properties", {}).items():
        member.pop("title", None)
        if name not in required:
            kinds = [kind for kind in member.pop("anyOf", []) if kind != {"type": "null"}]
            member.update(*kinds[:1])
            member.pop("default", None)


class Reply(BaseModel):
    """A JSON object of a reply."""

    model_config = ConfigDict(from_attributes=True, json_schema_extra=_simplify)


def _is_none(value: object) -> bool:
    return value is None


Missing = Field(default=None, exclude_if=_is_none)
"""The default of a member that is left out of the reply when it is None."""


def missing(name: str) -> Any:
    """`Missing` for a member whose name in JSON is no identifier."""
    return Field(default=None, exclude_if=_is_none, serialization_alias=name)


class Link(Reply):
    """A link, RFC 8288."""

    rel: str
    href: str
    type: str | None = Missing
    title: str | None = Missing
    templated: bool | None = Missing
    method: str | None = Missing
    body: JsonObject | None = Missing


class Problem(Reply):
    """Problem details, RFC 9457."""

    model_config = ConfigDict(extra="allow")

    type: str
    title: str
    status: Annotated[int, Field(ge=0)]
    detail: str
    error: str | None = Missing
    errors: list[JsonObject] | None = Missing


Count = Annotated[int, Field(ge=0)]


class StatedAccuracy(Reply):
    """Accuracy against one reference; null where it is unknown, and `words` say why."""

    label: str
    ce90_m: float | None
    le90_m: float | None
    words: str


def stated_accuracy(stated: Any) -> StatedAccuracy | None:
    """The accuracy in a stored document; None in those of earlier versions, which do not have it."""
    known = isinstance(stated, dict) and set(StatedAccuracy.model_fields) <= set(stated)
    return StatedAccuracy.model_validate(stated) if known else None
