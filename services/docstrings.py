"""Descriptions of attributes, read from the docstrings of dataclasses for schemas and API documents."""

import inspect
import re


def attribute_descriptions(kind: type) -> dict[str, str]:
    """The text of every attribute in the `Attributes:` section of a docstring, by attribute name.

    Inherited attributes have the descriptions of the class that declares them.
    """
    descriptions: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        _, _, section = inspect.cleandoc(base.__doc__ or "").partition("Attributes:\n")
        for entry in re.split(r"\n(?=    \w)", section.rstrip()):
            names, colon, text = entry.partition(":")
            if colon:
                descriptions.update(dict.fromkeys(re.findall(r"\w+", names), " ".join(text.split())))
    return descriptions
