"""Dates and instants: texts in RFC 3339, and comparisons that respect how fine a time is.

A date has the granularity of a day, UTC. Two times are compared at the coarser granularity of the two: a
date equals every instant of its day. So exactly one of `<`, `=` and `>` holds for two known times.

Sources: RFC 3339, section 5.6; OGC 17-069r4, 7.15.4; OGC 21-065r2, 7.11.
"""

import re
from dataclasses import dataclass
from datetime import UTC, date, datetime, time
from typing import Any

from sqlalchemy import ColumnElement, Date, DateTime, Text, cast, func, literal

from amers.app.db.constants import text_constant
from amers.app.db.features.collection import Property
from amers.app.db.schema.base import Timestamp
from amers.app.errors import InvalidParameter

DATE = re.compile(r"\d{4}-\d{2}-\d{2}", re.ASCII)
# Offsets and the numbers of days are checked by the calendar of Python.
INSTANT = re.compile(
    rf"{DATE.pattern}T(?:[01]\d|2[0-3]):[0-5]\d:(?P<second>[0-5]\d|60)(?:\.\d+)?(?:Z|[+-]\d{{2}}:[0-5]\d)",
    re.ASCII,
)
LONGEST = 100
TEXT_OF_INSTANT = text_constant('YYYY-MM-DD"T"HH24:MI:SS.US"Z"')

Moment = date | datetime
"""A date, which is a whole day, or an instant in UTC."""


def parse_moment(text: Any, where: str) -> Moment:
    """The date or the instant of a text in RFC 3339; digits beyond a microsecond are cut off.

    Raises:
        InvalidParameter: the text is neither; the message names it and `where` it stood.
    """
    expected = "a date or a time with its offset, such as 2024-05-06T07:08:09Z, expected"
    try:
        if not isinstance(text, str) or len(text) > LONGEST:
            raise ValueError
        # GDAL sends a date as `2024-05-06T`.
        upper = text.upper().removesuffix("T")
        if DATE.fullmatch(upper):
            return date.fromisoformat(upper)
        parts = INSTANT.fullmatch(upper)
        if parts is None:
            raise ValueError
        if parts["second"] == "60":
            expected = "a second of 0 to 59 expected: no time scale here has leap seconds"
            raise ValueError
        return datetime.fromisoformat(upper).astimezone(UTC)
    except (ValueError, OverflowError):
        raise InvalidParameter(f"{where}: {text!r:.60} found, {expected}") from None


def parse_interval(text: str) -> tuple[Moment | None, Moment | None]:
    """Start and end of a time or of an interval `FROM/TO`; None for an open end (`..` or no text).

    Raises:
        InvalidParameter: the text is neither a time nor an interval.
    """
    ends = text.split("/")
    if len(ends) > 2 or not text or ends == ["", ""] or ends == [".."]:
        raise InvalidParameter(f"datetime: {text!r:.100} found, a time or FROM/TO expected")
    low, high = (None if end in ("", "..") else parse_moment(end, "datetime") for end in (ends * 2)[:2])
    if low is not None and high is not None and first_instant(low) > last_instant(high):
        raise InvalidParameter(f"datetime: {ends[0]} is after {ends[-1]}")
    return low, high


def first_instant(moment: Moment) -> datetime:
    """The first instant of a date; an instant itself."""
    return moment if isinstance(moment, datetime) else datetime.combine(moment, time.min, UTC)


def last_instant(moment: Moment) -> datetime:
    """The last instant of a date; an instant itself."""
    return moment if isinstance(moment, datetime) else datetime.combine(moment, time.max, UTC)


def format_moment(moment: Moment) -> str:
    """A date or an instant in RFC 3339, in UTC."""
    if isinstance(moment, datetime):
        return moment.astimezone(UTC).isoformat().replace("+00:00", "Z")
    return moment.isoformat()


@dataclass(frozen=True, eq=False)
class Time:
    """A time in a statement; its comparisons are predicates.

    Attributes:
        expression: of type date or timestamptz.
        is_date: whether its granularity is a day.
    """

    expression: ColumnElement[Any]
    is_date: bool

    @staticmethod
    def of(value: Moment | Property) -> "Time":
        """A known time, or that of a property."""
        if isinstance(value, Property):
            return Time(value.expression, value.type == "date")
        is_instant = isinstance(value, datetime)
        return Time(literal(value, Timestamp if is_instant else Date()), not is_instant)

    @staticmethod
    def unbounded(sign: str = "") -> "Time":
        """The time after all others; before all others with the sign "-"."""
        return Time(cast(text_constant(f"{sign}infinity"), Timestamp), False)

    @property
    def day(self) -> ColumnElement[Any]:
        """The day in UTC that it lies in."""
        return self.expression if self.is_date else cast(in_utc(self.expression), Date())

    def _beside(self, other: "Time") -> tuple[ColumnElement[Any], ColumnElement[Any]]:
        """Both at the coarser granularity of the two."""
        if self.is_date == other.is_date:
            return self.expression, other.expression
        return self.day, other.day

    def __lt__(self, other: "Time") -> ColumnElement[bool]:
        one, another = self._beside(other)
        return one < another

    def __le__(self, other: "Time") -> ColumnElement[bool]:
        one, another = self._beside(other)
        return one <= another

    def __gt__(self, other: "Time") -> ColumnElement[bool]:
        return other < self

    def __ge__(self, other: "Time") -> ColumnElement[bool]:
        return other <= self

    def __eq__(self, other: "Time") -> ColumnElement[bool]:  # type: ignore[override]
        one, another = self._beside(other)
        return one == another

    def __ne__(self, other: "Time") -> ColumnElement[bool]:  # type: ignore[override]
        one, another = self._beside(other)
        return one != another

    __hash__ = None  # type: ignore[assignment]


def in_utc(instant: ColumnElement[Any]) -> ColumnElement[Any]:
    """An instant as date and time of day in UTC, whatever the zone of the session is."""
    return func.timezone(text_constant("UTC"), instant, type_=DateTime())


def time_text(item: Property) -> ColumnElement[str]:
    """A date or an instant of a property as text in RFC 3339, in UTC."""
    if item.type == "date":
        return func.to_char(item.expression, text_constant("YYYY-MM-DD"), type_=Text())
    return func.to_char(in_utc(item.expression), TEXT_OF_INSTANT, type_=Text())
