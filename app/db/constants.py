"""Constants of our own in statements: written into the text, so that no execution sends them again."""

from collections.abc import Callable

from sqlalchemy import ColumnElement, Integer, Text, literal_column

from amers.app.db.schema.base import Double
from amers.app.db.statements import DIALECT

_QUOTE: Callable[[str], str] = Text().literal_processor(DIALECT)  # type: ignore[no-untyped-call]


def text_constant(value: str) -> ColumnElement[str]:
    """A text as a quoted literal. Values of users are bind parameters, never constants."""
    return literal_column(_QUOTE(value), Text())


def integer_constant(value: int) -> ColumnElement[int]:
    """A whole number as a literal."""
    return literal_column(repr(int(value)), Integer())


def real_constant(value: float) -> ColumnElement[float]:
    """A number with decimals as a literal."""
    return literal_column(repr(float(value)), Double)
