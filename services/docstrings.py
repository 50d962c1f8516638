"""Descriptions of attributes, read from the docstrings of dataclasses for schemas and API documents."""

import inspect
import re


def attribute_descriptions(kind: type) -> dict[str, str]:
    """The text of every attribute in the `Attributes:` section of a docstring, by attribute name."""
    _, _, section = (inspect.getdoc(kind) or "").partition("Attributes:\n")
    descriptions: dict[str, str] = {}
    for entry in re.split(r"\n(?=    \w)", section.rstrip()):
        names, colon, text = entry.partition(":")
        if colon:
            descriptions.update(dict.fromkeys(re.findall(r"\w+", names), " ".join(text.split())))
    return descriptions
