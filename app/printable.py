"""Text of others in a line that people read: no character of it controls the terminal or the line."""

import re

_UNPRINTABLE = re.compile(r"[^ -~]")


def printable(text: str) -> str:
    """A text whose control characters are written as escapes, such as `\\x1b` or `\\u2028`.

    Line breaks, codes of terminals, marks that turn the direction of writing, characters without a width
    and halves of surrogate pairs are not printable.
    """
    if text.isprintable():
        return text
    return _UNPRINTABLE.sub(_escaped, text)


def printable_json(document: str) -> str:
    """The same for a document of JSON on one line, with the escapes of JSON."""
    if document.isprintable():
        return document
    return _UNPRINTABLE.sub(_escaped_in_json, document)


def _escaped(found: re.Match[str]) -> str:
    character = found.group()
    return character if character.isprintable() else ascii(character)[1:-1]


def _escaped_in_json(found: re.Match[str]) -> str:
    character = found.group()
    if character.isprintable():
        return character
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at : at + 2].hex()}" for at in range(0, len(units), 2))
