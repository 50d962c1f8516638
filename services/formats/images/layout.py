"""Layout of the pixels in a TIFF: the data to decompress for one pixel. Source: TIFF 6.0.

GDAL shows a compressed strip that is a whole image as strips of one line, and unpacks it from its begin
for each of them. Only the directories of the file tell.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

MIB = 1 << 20
READ_BY_WINDOWS_BYTES = 16 * MIB
"""Largest strip or tile that is unpacked for each window: a quarter of the cache of GDAL."""
MOST_DIRECTORIES = 1000
MOST_ENTRIES = 1000
"""More than any product has in one directory; entries are ordered by their tag, and ours are small."""
SUBFILE, WIDTH, LENGTH, BITS, COMPRESSION, SAMPLES = 254, 256, 257, 258, 259, 277
ROWS, PLANES, TILE_WIDTH, TILE_LENGTH = 278, 284, 322, 323
_NEEDED = {SUBFILE, WIDTH, LENGTH, BITS, COMPRESSION, SAMPLES, ROWS, PLANES, TILE_WIDTH, TILE_LENGTH}
_FORMS = {1: "B", 3: "H", 4: "I", 16: "Q"}
_IS_MASK = 4
_PLAIN, _SEPARATE = 1, 2

Tags = dict[int, int]


def largest_piece_bytes(path: Path) -> int:
    """Bytes that the largest compressed strip or tile of the image and of its masks unpacks to.

    Smaller copies of the image are left out, and so are strips that are not compressed: any line of
    theirs can be read alone. What the file declares twice counts with the larger value.

    Args:
        path: of a TIFF or a BigTIFF; 0 for any other file, and for directories beyond the end.
    """
    with path.open("rb") as file:
        return max((_piece_bytes(tags) for tags in _directories(file)), default=0)


def _piece_bytes(tags: Tags) -> int:
    width, length = tags.get(WIDTH, 0), tags.get(LENGTH, 0)
    if TILE_WIDTH in tags or TILE_LENGTH in tags:
        pixels = tags.get(TILE_WIDTH, width) * tags.get(TILE_LENGTH, length)
    elif tags.get(COMPRESSION, _PLAIN) == _PLAIN:
        return 0
    else:
        pixels = width * min(tags.get(ROWS) or length, length)
    bands = 1 if tags.get(PLANES) == _SEPARATE else tags.get(SAMPLES, 1)
    return pixels * bands * tags.get(BITS, 1) // 8


def _directories(file: BinaryIO) -> Iterator[Tags]:
    """Yield the tags that matter here, of the first directory and of those of masks."""
    head = file.read(16)
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    if order is None or len(head) < 16:
        return
    is_big = struct.unpack(order + "H", head[2:4])[0] == 43
    offset = struct.unpack(order + ("Q" if is_big else "I"), head[8:16] if is_big else head[4:8])[0]
    seen = set[int]()
    while offset and offset not in seen and len(seen) < MOST_DIRECTORIES:
        seen.add(offset)
        try:
            tags, offset = _directory(file, offset, order, is_big)
        except struct.error:
            return
        if len(seen) == 1 or tags.get(SUBFILE, 0) & _IS_MASK:
            yield tags


def _directory(file: BinaryIO, offset: int, order: str, is_big: bool) -> tuple[Tags, int]:
    """The tags of one directory, and the offset of the next.

    Raises:
        struct.error: it lies beyond the end.
    """
    count_form, entry_form, next_form = ("Q", "HHQ8s", "Q") if is_big else ("H", "HHI4s", "I")
    file.seek(offset)
    (count,) = struct.unpack(order + count_form, file.read(struct.calcsize(order + count_form)))
    size = struct.calcsize(order + entry_form)
    content = file.read(size * min(count, MOST_ENTRIES))
    tags: Tags = {}
    for tag, kind, number, value in struct.iter_unpack(order + entry_form, content):
        if tag in _NEEDED and kind in _FORMS:
            tags[tag] = max(tags.get(tag, 0), _value(file, order, kind, number, value))
    if count > MOST_ENTRIES:
        return tags, 0
    file.seek(offset + struct.calcsize(order + count_form) + size * count)
    following = file.read(struct.calcsize(order + next_form))
    return tags, struct.unpack(order + next_form, following)[0]


def _value(file: BinaryIO, order: str, kind: int, number: int, value: bytes) -> int:
    """The first number of an entry, which lies elsewhere when there are many, as bits of many bands."""
    form = order + _FORMS[kind]
    size = struct.calcsize(form)
    if number * size > len(value):
        file.seek(struct.unpack(order + ("Q" if len(value) == 8 else "I"), value)[0])
        value = file.read(size)
    return int(struct.unpack(form, value[:size])[0])
