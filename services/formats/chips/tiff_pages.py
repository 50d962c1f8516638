"""The chips of many points as the pages of one GeoTIFF, generated page by page.

Each page has its own projection, as the GeoTIFF of one chip has (`chips.images`). No library writes such
pages to a stream, so this module encodes them. Source: TIFF 6.0; OGC 19-008r4 (GeoTIFF 1.1).
"""

import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from amers.services.conventions import CHIP_CENTRE
from amers.services.formats.chips.images import pixel_size_on_ellipsoid_m
from amers.services.formats.chips.stacks import chip_runs, chip_table, read_runs
from amers.services.types import ChipArray, ChipSource, ControlPoints

SHORT, LONG, DOUBLE, ASCII = 3, 4, 12, 2
CODES = {SHORT: "H", LONG: "I", DOUBLE: "d"}
HEADER = struct.pack("<2sHI", b"II", 42, 8)

# Keys of a user-defined projection: azimuthal equidistant (12) on WGS 84 (4326) in metres (9001), with
# its centre at the point. A location of 34736 refers to the tag with the list of doubles.
GEO_KEYS = (
    *(1, 1, 1, 11),
    *(1024, 0, 1, 1),
    *(1025, 0, 1, 1),
    *(2048, 0, 1, 4326),
    *(3072, 0, 1, 32767),
    *(3074, 0, 1, 32767),
    *(3075, 0, 1, 12),
    *(3076, 0, 1, 9001),
    *(3082, 34736, 1, 0),
    *(3083, 34736, 1, 1),
    *(3088, 34736, 1, 2),
    *(3089, 34736, 1, 3),
)


def stream_chips_tiff(points: ControlPoints, chips: ChipSource) -> Iterator[bytes]:
    """Yield the bytes of a GeoTIFF with one page for each chip of points: raw values, 0 is nodata.

    The description of a page is JSON with the columns of `stacks.chip_table`, null where unknown.

    Raises:
        FormatError: a file of chips is unreadable or too short; before the first piece where it is the
            file of the first chips.
    """
    table = chip_table(points)
    last, page, offset = len(table["point_id"]) - 1, 0, len(HEADER)
    head = HEADER
    for run in read_runs(chip_runs(points), chips):
        pieces = [head]
        for chip in run:
            row = {name: column[page] for name, column in table.items()}
            pieces.append(_page(chip, row, offset, is_last=page == last))
            offset, page = offset + len(pieces[-1]), page + 1
        yield b"".join(pieces)
        head = b""


def _page(chip: ChipArray, row: dict[str, Any], offset: int, *, is_last: bool) -> bytes:
    """The bytes of one page, of even length: directory, values too long for it, pixels."""
    lon, lat, _ = (float(value) for value in row["lon_lat_h"])
    east_m, north_m = pixel_size_on_ellipsoid_m(row["lon_lat_h"], float(row["gsd_m"]))
    corner = CHIP_CENTRE + 0.5
    height, width = chip.shape
    tags: list[tuple[int, int, tuple[Any, ...]]] = [
        (256, SHORT, (width,)),
        (257, SHORT, (height,)),
        (258, SHORT, (8 * chip.itemsize,)),
        (259, SHORT, (1,)),
        (262, SHORT, (1,)),
        (270, ASCII, (_description(row),)),
        (273, LONG, (0,)),
        (277, SHORT, (1,)),
        (278, SHORT, (height,)),
        (279, LONG, (chip.nbytes,)),
        (339, SHORT, (1,)),
        (33550, DOUBLE, (east_m, north_m, 0.0)),
        (33922, DOUBLE, (0.0, 0.0, 0.0, -corner * east_m, corner * north_m, 0.0)),
        (34735, SHORT, GEO_KEYS),
        (34736, DOUBLE, (0.0, 0.0, lon, lat)),
        (42113, ASCII, (b"0\0",)),
    ]
    directory_end = offset + 2 + 12 * len(tags) + 4
    entries, values = [], b""
    for tag, kind, content in tags:
        count = len(content[0]) if kind == ASCII else len(content)
        packed = content[0] if kind == ASCII else struct.pack(f"<{count}{CODES[kind]}", *content)
        if len(packed) > 4:
            value_or_offset = struct.pack("<I", directory_end + len(values))
            values += packed + b"\0" * (-len(packed) % 8)
        else:
            value_or_offset = packed.ljust(4, b"\0")
        entries.append(struct.pack("<HHI", tag, kind, count) + value_or_offset)
    pixels_at = directory_end + len(values)
    entries[6] = struct.pack("<HHII", 273, LONG, 1, pixels_at)
    pixels = chip.astype(chip.dtype.newbyteorder("<"), copy=False).tobytes()
    pixels += b"\0" * ((pixels_at + len(pixels)) % 2)
    following = 0 if is_last else pixels_at + len(pixels)
    directory = struct.pack("<H", len(tags)) + b"".join(entries) + struct.pack("<I", following)
    return directory + values + pixels


def _description(row: dict[str, Any]) -> bytes:
    """The metadata of a chip as JSON, ended by a zero byte."""
    values = {name: value.tolist() for name, value in row.items() if name != "acquired_at"}
    values = {name: None if value != value else value for name, value in values.items()}
    time = None if np.isnat(row["acquired_at"]) else f"{row['acquired_at']}Z"
    return json.dumps({**values, "acquired_at": time}).encode("ascii") + b"\0"
