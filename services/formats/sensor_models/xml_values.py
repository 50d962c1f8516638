"""Values of XML metadata: required single elements, numbers, lists of numbers, times."""

import re
from datetime import datetime
from xml.etree import ElementTree

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.text_files import parse_number
from amers.services.types import Array

_TIME = re.compile(r"(\d{4}-\d\d-\d\d)T(\d\d:\d\d:\d\d)(\.\d{1,12})?Z?")


def single(parent: ElementTree.Element, path: str, source: str) -> ElementTree.Element:
    """The only element at a path, anywhere below another element.

    Raises:
        FormatError: there is none, or more than one.
    """
    elements = parent.findall(f".//{path}")
    if len(elements) != 1:
        raise FormatError(f"{source}: expected one {path} in <{parent.tag}>, found {len(elements)}")
    return elements[0]


def elements_by_tag(parent: ElementTree.Element) -> dict[str, list[ElementTree.Element]]:
    """All elements anywhere below another element, by their tags: for readers of many of them."""
    found: dict[str, list[ElementTree.Element]] = {}
    for element in parent.iter():
        found.setdefault(element.tag, []).append(element)
    return found


def number(
    parent: ElementTree.Element,
    path: str,
    source: str,
    within: tuple[float, float] = (-1e15, 1e15),
) -> float:
    """The number of the only element at a path.

    Raises:
        FormatError: the element is missing or not a number, or its value is out of the range.
    """
    text = (single(parent, path, source).text or "").strip()
    value = parse_number(text, path, source)
    if not within[0] <= value <= within[1]:
        raise FormatError(
            f"{source}: {path}: {text[:60]} found, {within[0]:g} to {within[1]:g} expected"
        )
    return value


def whole_number(parent: ElementTree.Element, path: str, source: str, within: tuple[int, int]) -> int:
    """The whole number of the only element at a path.

    Raises:
        FormatError: the element is missing or not a whole number, or its value is out of the range.
    """
    value = number(parent, path, source, within)
    if value != int(value):
        raise FormatError(f"{source}: {path}: {value:g} found, a whole number expected")
    return int(value)


def numbers(element: ElementTree.Element, source: str, count: int | None = None) -> Array:
    """The numbers (n,) of an element, separated by blanks.

    Args:
        element: whose text is read.
        source: name of the file, for messages.
        count: how many are expected; None for one or more.

    Raises:
        FormatError: a text is not a number, or their count differs.
    """
    words = (element.text or "").split()
    if not words or (count is not None and len(words) != count):
        raise FormatError(
            f"{source}: {element.tag}: {len(words)} numbers found, {count or 'at least one'} expected"
        )
    values = np.array([parse_number(word, element.tag, source) for word in words])
    if not np.isfinite(values).all():
        raise FormatError(f"{source}: {element.tag}: a number is too large for double precision")
    return values


def seconds(element: ElementTree.Element, midnight: datetime, source: str) -> float:
    """The UTC time of an element in seconds after a midnight, with all its decimals.

    Raises:
        FormatError: it is not a time like 2017-03-08T06:55:34.3400290Z.
    """
    text = (element.text or "").strip()
    match = _TIME.fullmatch(text)
    try:
        if match is None:
            raise ValueError
        whole = (datetime.fromisoformat(f"{match[1]}T{match[2]}") - midnight).total_seconds()
    except ValueError:
        raise FormatError(
            f"{source}: {element.tag}: {text[:60]!r} found, "
            "a time like 2017-03-08T06:55:34.340Z expected"
        ) from None
    return whole + float(match[3] or 0.0)


def midnight_before(element: ElementTree.Element, source: str) -> datetime:
    """The midnight from which `seconds` counts in a document, that before the time of an element.

    Raises:
        FormatError: it is not a time.
    """
    seconds(element, datetime(2000, 1, 1), source)
    return datetime.fromisoformat((element.text or "").strip()[:10])


def check_increasing(values: Array, name: str, needed: int, source: str) -> Array:
    """The values (n,) themselves.

    Raises:
        FormatError: they are fewer than needed, or one is not larger than the one before.
    """
    if len(values) < needed:
        raise FormatError(f"{source}: {name}: {len(values)} found, at least {needed} expected")
    steps = np.diff(values)
    late = np.flatnonzero(steps <= 0.0)
    if len(late):
        raise FormatError(
            f"{source}: {name}: entry {late[0] + 2} is {steps[late[0]]:g} after the one before, "
            "increasing entries expected"
        )
    return values
