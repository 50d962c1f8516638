"""Values that JSON cannot carry: numbers that are not finite, and halves of surrogate pairs.

Source: RFC 8259, sections 6 and 8.2. Python's decoder accepts them, the database and encoders do not.
"""

import json
import math
import re
from typing import Any

SUSPICIOUS = re.compile(
    rb"NaN|Infinity|\\u[dD][89a-fA-F]|\xed[\xa0-\xbf]|\x00|[eE]\+?[0-9]{3}|[0-9]{300}"
)
"""What a body contains that decodes to such a value; other bodies need no second look."""


def unusable_value(value: Any, path: str) -> str | None:
    """Which value JSON cannot carry, with its path and what was expected; None without one.

    Args:
        value: of dicts, lists, texts and numbers.
        path: of the value, such as "body.inputs".
    """
    pending = [(value, path)]
    while pending:
        member, place = pending.pop()
        if isinstance(member, float) and not math.isfinite(member):
            return f"{place}: a finite number expected, {_word(member)} found"
        if isinstance(member, str) and not _is_text(member):
            return f"{place}: Unicode text expected, half of a surrogate pair found"
        if isinstance(member, dict):
            if not all(_is_text(str(name)) for name in member):
                return f"{place}: a name has half of a surrogate pair, Unicode text expected"
            pending += [(inner, f"{place}.{name}") for name, inner in member.items()]
        elif isinstance(member, list | tuple):
            pending += [(inner, f"{place}.{number}") for number, inner in enumerate(member)]
    return None


def unusable_body(body: bytes) -> str | None:
    """Which value of a JSON document is unusable, as `unusable_value`; None too for what is no JSON."""
    if not SUSPICIOUS.search(body):
        return None
    try:
        document = json.loads(body)
    except (ValueError, RecursionError):
        return None
    return unusable_value(document, "body")


def usable(value: Any) -> Any:
    """The same value as JSON can carry it: None for numbers that are not finite, ? for half a pair."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return value.encode("utf-8", "replace").decode()
    if isinstance(value, dict):
        return {usable(name): usable(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [usable(inner) for inner in value]
    return value


def _is_text(text: str) -> bool:
    return text.isascii() or not any("\ud800" <= letter <= "\udfff" for letter in text)


def _word(number: float) -> str:
    return "not a number" if math.isnan(number) else "an infinite one"
