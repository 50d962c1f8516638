"""The content of a stored file, read once: its size, its SHA-256 and the checksums of its chips."""

import hashlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import BinaryIO

from amers.services.errors import FormatError
from amers.services.formats.chips.checksums import Checksums, ChipHasher
from amers.services.formats.chips.npy_files import MAX_HEADER_BYTES, parse_chip_header

READ_BYTES = 1 << 20


@dataclass(frozen=True)
class Content:
    """What was read from a file.

    Attributes:
        sha256: in hexadecimal.
        chip_checksums: of its chips; None if it has no header of a file of chips.
    """

    size_bytes: int
    sha256: str
    chip_checksums: Checksums | None


def read_content(file: BinaryIO, count: Callable[[int], None], *, of_chips: bool) -> Content:
    """Read a file from its start to its end.

    Args:
        file: open at its start.
        count: receives the number of bytes of each piece that was read.
        of_chips: whether it is a file of chips.
    """
    digest, size_bytes = hashlib.sha256(), 0
    piece = file.read(READ_BYTES)
    hasher = _chip_hasher(piece) if of_chips else None
    while piece:
        digest.update(piece)
        if hasher is not None:
            hasher.update(piece)
        size_bytes += len(piece)
        count(len(piece))
        piece = file.read(READ_BYTES)
    return Content(size_bytes, digest.hexdigest(), None if hasher is None else hasher.checksums())


def _chip_hasher(start: bytes) -> ChipHasher | None:
    """For the file that starts with these bytes; None if they are not the header of a file of chips."""
    try:
        return ChipHasher(parse_chip_header(io.BytesIO(start[:MAX_HEADER_BYTES]), ""))
    except FormatError:
        return None
