"""Contents of small text files: text, decimal numbers, JSON, XML."""

import codecs
import json
import re
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from amers.services.errors import FormatError
from amers.services.formats.addresses import Address, FilePlace

NUMBER_PATTERN = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
"""Pattern of a decimal number; "nan" and "inf" do not match."""

_MAX_TEXT_BYTES = 20_000_000
_KEPT_LETTERS = 500_000
"""Length of XML documents whose trees are kept for a while: those of products without ephemerides."""


def read_text(path: FilePlace) -> str:
    """The content of a small text file, with its ends of lines.

    It is in UTF-8, with or without a byte order mark, in UTF-16 with one, or else in Latin-1.

    Raises:
        FormatError: the file cannot be read, is larger than 20 MB, or is in UTF-16 or binary without a
            byte order mark.
    """
    data = path.read_bytes(_MAX_TEXT_BYTES) if isinstance(path, Address) else _content(path)
    return _decoded(data, str(path))


def _decoded(data: bytes, name: str) -> str:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        try:
            return data.decode("utf-32" if data.startswith(codecs.BOM_UTF32_LE) else "utf-16")
        except UnicodeDecodeError:
            raise FormatError(
                f"{name}: UTF-16 expected by its byte order mark; the text is damaged"
            ) from None
    if b"\0" in data[:1000]:
        raise FormatError(
            f"{name}: expected a text in UTF-8, or in UTF-16 with a byte order mark, found bytes of 0; "
            "save it as UTF-8"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _content(path: Path) -> bytes:
    try:
        if not path.is_file() or path.stat().st_size > _MAX_TEXT_BYTES:
            raise FormatError(
                f"{path}: expected an existing text file of at most {_MAX_TEXT_BYTES} bytes"
            )
        return path.read_bytes()
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}") from error


def parse_number(text: str, key: str, source: str) -> float:
    """The decimal number of a text.

    Raises:
        FormatError: the text is not a decimal number; "nan" and "inf" are not.
    """
    number = text.strip()  # of more than `float` would: the information separators of ASCII, too
    if re.fullmatch(NUMBER_PATTERN, number) is None:
        raise FormatError(f"{source}: {key}: expected a number, found {number[:60]!r}")
    return float(number)


def load_json(text: str, source: str) -> Any:
    """The value of a JSON document.

    Raises:
        FormatError: the text is not JSON.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{source}: expected a JSON document: {error}") from None


def parse_xml(text: str, source: str) -> ElementTree.Element:
    """The root of an XML document without a document type, hence without entities of its own.

    Raises:
        FormatError: it is not such a document.
    """
    if "<!DOCTYPE" in text:
        raise FormatError(f"{source}: <!DOCTYPE found, a document without a document type expected")
    try:
        return _tree(text) if len(text) <= _KEPT_LETTERS else ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise FormatError(f"{source}: expected a well-formed XML document: {error}") from None


@lru_cache(maxsize=2)
def _tree(text: str) -> ElementTree.Element:
    """The tree of a document, kept for the readers that look into the same one; none changes it."""
    return ElementTree.fromstring(text)
