"""Numbers of spreadsheets: decimal commas, and degrees with minutes, seconds and a hemisphere."""

import math
import re

from amers.services.errors import FormatError
from amers.services.formats.text_files import NUMBER_PATTERN, parse_number

_COMMA = re.compile(r"[-+]?\d+,\d+")
_PLACES = {"lon": "EW", "lat": "NS"}
_ANGLE = re.compile(
    r"(?P<before>[NSEW])?\s*(?P<sign>[-+])?\s*(?P<deg>\d+(?:\.\d+)?)\s*(?:°|º|deg|d|:|\s)?\s*"
    r"(?:(?P<min>\d+(?:\.\d+)?)\s*(?:'|′|’|min|m|:|\s)?\s*)?"  # noqa: RUF001
    r"(?:(?P<sec>\d+(?:\.\d+)?)\s*(?:\"|″|”|''|′′|’’|sec|s)?\s*)?(?P<after>[NSEW])?",  # noqa: RUF001
    re.IGNORECASE,
)


def has_decimal_comma(field: str) -> bool:
    """Whether a field is a number with a decimal comma."""
    return _COMMA.fullmatch(field.strip()) is not None


def parse_field(field: str, name: str, where: str, *, comma: bool) -> float:
    """The number of a field; NaN where it is empty.

    Args:
        field: of the table.
        name: of its column; longitudes and latitudes may have minutes, seconds and a hemisphere.
        where: place in the file, for messages.
        comma: whether the decimal sign of the file is a comma.

    Raises:
        FormatError: the field is no such number.
    """
    if not field:
        return math.nan
    field = field.replace("\N{MINUS SIGN}", "-")
    if comma:
        if "." in field and re.fullmatch(r"[-+\d.,]+", field):
            raise FormatError(
                f"{where}: {name}: expected a decimal comma as in other numbers of this file, found "
                f"{field[:40]!r}; write all numbers alike, without separators of thousands"
            )
        field = field.replace(",", ".")
    if name in _PLACES and re.fullmatch(NUMBER_PATTERN, field) is None:
        field = field if "." in field else field.replace(",", ".")
        return _angle(field, name, where)
    return parse_number(field, name, where)


def _angle(field: str, name: str, where: str) -> float:
    """Degrees of a longitude or latitude with minutes, seconds, or a hemisphere."""
    match = _ANGLE.fullmatch(field.strip())
    if match is None:
        return parse_number(field, name, where)
    letters = [letter.upper() for letter in (match["before"], match["after"]) if letter]
    minutes, seconds = float(match["min"] or 0.0), float(match["sec"] or 0.0)
    if len(letters) > 1 or (letters and match["sign"]) or minutes >= 60.0 or seconds >= 60.0:
        raise FormatError(
            f"{where}: {name}: expected degrees, or degrees, minutes and seconds with one sign or "
            f"letter, found {field[:40]!r}"
        )
    if letters and letters[0] not in _PLACES[name]:
        raise FormatError(
            f"{where}: {name}: expected {' or '.join(_PLACES[name])}, found {field[:40]!r}: are "
            "longitude and latitude exchanged?"
        )
    if (match["sec"] and "." in match["min"]) or (match["min"] and "." in match["deg"]):
        raise FormatError(f"{where}: {name}: expected whole degrees and minutes, found {field[:40]!r}")
    size = float(match["deg"]) + minutes / 60.0 + seconds / 3600.0
    return -size if match["sign"] == "-" or letters[:1] in (["S"], ["W"]) else size
