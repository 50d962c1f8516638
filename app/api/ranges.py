"""Ranges of bytes that a request asks for.

Source: RFC 9110, sections 14.1, 14.2 and 15.3.7.
"""

import re
from dataclasses import dataclass
from uuid import uuid4

SPECIFIER = re.compile(r"\s*bytes\s*=(.*)", re.IGNORECASE | re.DOTALL)
RANGE = re.compile(r"(\d{1,4000})-(\d{1,4000})?|-(\d{1,4000})")
MOST_RANGES = 100


@dataclass(frozen=True)
class Part:
    """A part of a body: a text, then bytes of a file.

    Attributes:
        head: what stands before the bytes.
        start, end: of the bytes in the file; the end is the first that is not sent.
    """

    head: bytes
    start: int
    end: int


def wanted_ranges(header: str | None, size: int) -> list[tuple[int, int]] | None:
    """Start and end of the ranges that `Range` asks for, in their order; an end is not included.

    None where the standard demands or allows to ignore the header: another unit, no ranges, or too many.
    An empty list: no range begins within the file.

    Args:
        header: value of the header; None without it.
        size: of the file, bytes.
    """
    specifier = SPECIFIER.fullmatch(header or "")
    if specifier is None:
        return None
    texts = [text for part in specifier[1].split(",") if (text := part.strip())]
    found = [RANGE.fullmatch(text) for text in texts]
    if not 0 < len(found) <= MOST_RANGES:
        return None
    ranges = []
    for one in found:
        if one is None:
            return None
        first, last, suffix = (None if text is None else int(text) for text in one.groups())
        if first is None:
            assert suffix is not None
            first, last = (max(0, size - suffix), size) if suffix else (size, size)
        elif last is not None and last < first:
            return None
        if first < size:
            ranges.append((first, size if last is None else min(last + 1, size)))
    return _merged(ranges)


def content_range(start: int, end: int, size: int) -> str:
    """A range as `Content-Range` has it."""
    return f"bytes {start}-{end - 1}/{size}"


def multipart(ranges: list[tuple[int, int]], size: int, media_type: str) -> tuple[str, list[Part]]:
    """The media type and the parts of a body with several ranges."""
    boundary = uuid4().hex
    parts = []
    for number, (start, end) in enumerate(ranges):
        between = "\r\n" if number else ""
        head = (
            f"{between}--{boundary}\r\nContent-Type: {media_type}\r\n"
            f"Content-Range: {content_range(start, end, size)}\r\n\r\n"
        )
        parts.append(Part(head.encode(), start, end))
    parts.append(Part(f"\r\n--{boundary}--\r\n".encode(), 0, 0))
    return f"multipart/byteranges; boundary={boundary}", parts


def _merged(ranges: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Ranges in ascending order, those that touch each other as one."""
    merged: list[tuple[int, int]] = []
    for start, end in sorted(ranges):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], end))
        else:
            merged.append((start, end))
    return merged
