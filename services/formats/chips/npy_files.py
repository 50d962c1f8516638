"""Files of chips: plain NumPy arrays (n, 101, 101), read by position without loading them."""

import os
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tokenize import TokenError

import numpy as np
import numpy.typing as npt

from services.conventions import CHIP_SIZE
from services.errors import FormatError
from services.types import ChipArray

CHIP_DTYPES = (np.dtype(np.uint8), np.dtype("<u2"))

# What NumPy lets through when a header is garbled: it evaluates a literal, then tokenizes it.
_HEADER_ERRORS = (ValueError, TypeError, KeyError, SyntaxError, MemoryError, RecursionError, TokenError)


@dataclass(frozen=True)
class ChipFile:
    """The layout of one file of chips.

    Attributes:
        dtype: uint8 or uint16.
        count: number of chips.
        offset: bytes before the first chip.
    """

    dtype: npt.DTypeLike
    count: int
    offset: int

    @property
    def chip_bytes(self) -> int:
        """Size of one chip."""
        return CHIP_SIZE * CHIP_SIZE * np.dtype(self.dtype).itemsize


def read_chip_file(path: Path, name: str) -> ChipFile:
    """The layout of a file of chips, checked against its size.

    Args:
        path: the file.
        name: what to call it in messages.

    Raises:
        FormatError: when it is not a NumPy file of chips or is truncated.
    """
    try:
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            if version != (1, 0):
                raise ValueError(f"version {version} of the NumPy format, (1, 0) expected")
            shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
            offset, size = file.tell(), os.fstat(file.fileno()).st_size
    except (*_HEADER_ERRORS, OSError) as error:
        raise FormatError(f"{name}: cannot be read as a NumPy array: {error}") from error
    if len(shape) != 3 or shape[1:] != (CHIP_SIZE, CHIP_SIZE) or fortran:
        order = ", column by column" if fortran else ""
        raise FormatError(f"{name}: shape {shape}{order} found, (n, {CHIP_SIZE}, {CHIP_SIZE}) expected")
    if dtype not in CHIP_DTYPES:
        raise FormatError(f"{name}: {dtype} found, uint8 or uint16 (little-endian) expected")
    chips = ChipFile(dtype, shape[0], offset)
    if size != offset + chips.count * chips.chip_bytes:
        raise FormatError(
            f"{name}: {size} bytes found, {offset + chips.count * chips.chip_bytes} expected "
            f"for its {chips.count} chips"
        )
    return chips


def chip_file_header(dtype: npt.DTypeLike, count: int) -> bytes:
    """The bytes before the first chip in a file of `count` chips."""
    header = BytesIO()
    np.lib.format.write_array_header_1_0(
        header,
        {
            "descr": np.lib.format.dtype_to_descr(np.dtype(dtype)),
            "fortran_order": False,
            "shape": (count, CHIP_SIZE, CHIP_SIZE),
        },
    )
    return header.getvalue()


def read_chips(descriptor: int, layout: ChipFile, name: str, row: int, count: int) -> ChipArray:
    """Consecutive chips of an open file, by one `pread`.

    Returns:
        (count, 101, 101).

    Raises:
        FormatError: when the file does not hold them.
    """
    if row < 0 or count < 0 or row + count > layout.count:
        raise FormatError(f"{name}: chips {row} to {row + count} asked, {layout.count} in the file")
    data = os.pread(descriptor, count * layout.chip_bytes, layout.offset + row * layout.chip_bytes)
    if len(data) != count * layout.chip_bytes:
        raise FormatError(f"{name}: truncated while reading chips {row} to {row + count}")
    return np.frombuffer(data, layout.dtype).reshape(count, CHIP_SIZE, CHIP_SIZE)
