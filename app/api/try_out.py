"""Requests that a reader of the pages sends from a form: without a script, to this service alone."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Field:
    """A parameter of a request that a form asks for.

    Attributes:
        name: of the parameter; `id` of the field with that of the form.
        label: for people.
        value: that the form has at first.
        choices: the only values, in words by value; none: any text.
    """

    name: str
    label: str
    value: str
    choices: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class TryOut:
    """A request with its words.

    Attributes:
        id: in the page.
        path: below the address of the service.
    """

    id: str
    title: str
    text: str
    path: str
    fields: tuple[Field, ...]


_FORMAT = Field(
    "f",
    "Reply as",
    "html",
    (("html", "page"), ("json", "GeoJSON"), ("csv", "CSV"), ("gpkg", "GeoPackage")),
)
_LIMIT = Field("limit", "At most", "10", tuple((text, f"{text} features") for text in ("10", "100")))
TRY_OUTS = (
    TryOut(
        "box",
        "Points in a box",
        "West, south, east and north in degrees.",
        "collections/points/items",
        (Field("bbox", "Box", "-180,-90,180,90"), _LIMIT, _FORMAT),
    ),
    TryOut(
        "condition",
        "Points that meet a condition",
        "A condition in CQL2. The page of the collection lists the properties that it may name.",
        "collections/points/items",
        (Field("filter", "Condition", "n_views >= 3 AND saliency > 0.3"), _LIMIT, _FORMAT),
    ),
    TryOut(
        "blocks",
        "Blocks with their accuracy",
        "Each block is one production of points.",
        "collections/blocks/items",
        (_LIMIT, _FORMAT),
    ),
)
