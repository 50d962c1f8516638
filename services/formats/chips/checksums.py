"""Checksums of single chips: the lower 32 bits of XXH3 of the bytes of a chip.

A chip is checked each time it is read, so a checksum must cost little beside the read: for a chip of 8
bits, XXH3 takes 0.001 ms, the CRC-32 of zlib ten times longer. Of 4,000 million damaged chips one keeps
its checksum by chance; the SHA-256 of the whole file finds that one too.
"""

import numpy as np
import numpy.typing as npt
import xxhash

from amers.services.formats.chips.npy_files import ChipFile

CHECKSUM = np.dtype("<u4")
"""How the checksums of a file are kept: one after the other, in the order of its chips."""

Checksums = npt.NDArray[np.uint32]


class ChipHasher:
    """Computes the checksums of all chips of a file, whose bytes come in pieces of any size."""

    def __init__(self, layout: ChipFile) -> None:
        self._layout = layout
        self._before = layout.offset
        self._left = layout.chip_bytes
        self._chip = xxhash.xxh3_64()
        self._checksums: list[int] = []

    def update(self, piece: bytes) -> None:
        """Take the next bytes of the file."""
        rest = memoryview(piece)[self._before :]
        self._before -= min(self._before, len(piece))
        while rest:
            part, rest = rest[: self._left], rest[self._left :]
            self._chip.update(part)
            self._left -= len(part)
            if self._left == 0:
                self._checksums.append(_lower_bits(self._chip.intdigest()))
                self._left = self._layout.chip_bytes
                self._chip.reset()

    def checksums(self) -> Checksums:
        """The checksums (n,) of the chips that were complete so far."""
        return np.array(self._checksums, dtype=CHECKSUM)


def damaged_rows(data: bytes, layout: ChipFile, row: int, expected: Checksums) -> list[int]:
    """The rows of the chips that do not have their checksums.

    Args:
        data: the bytes of consecutive chips.
        layout: of their file.
        row: of the first of these chips in the file.
        expected: the checksums of all chips of the file.
    """
    size, chips = layout.chip_bytes, memoryview(data)
    starts = range(0, len(data), size)
    computed = [_lower_bits(xxhash.xxh3_64_intdigest(chips[at : at + size])) for at in starts]
    recorded = expected[row : row + len(computed)].tolist()
    # Lists: for the few chips of a point, arrays take longer than the checksums.
    if computed == recorded:
        return []
    pairs = enumerate(zip(computed, recorded, strict=True), start=row)
    return [at for at, (found, stated) in pairs if found != stated]


def _lower_bits(digest: int) -> int:
    return digest & 0xFFFFFFFF
