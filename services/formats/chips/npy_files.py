"""Files of chips: NumPy arrays (n, 101, 101), read by position without loading the file."""

import os
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np

from amers.services.conventions import CHIP_SIZE
from amers.services.errors import FormatError
from amers.services.types import ChipArray

CHIP_DTYPES = (np.dtype(np.uint8), np.dtype("<u2"))
MAX_HEADER_BYTES = 4096
"""Bytes at the start of a file that contain the whole header of any file of chips."""

# NumPy raises these for a garbled header: it evaluates the header as a literal, then tokenizes it.
_HEADER_ERRORS = (ValueError, TypeError, KeyError, SyntaxError, MemoryError, RecursionError, TokenError)


@dataclass(frozen=True)
class ChipFile:
    """The layout of one file of chips.

    Attributes:
        name: name of the file, for messages.
        dtype: uint8 or little-endian uint16.
        count: number of chips.
        offset: bytes before the first chip.
    """

    name: str
    dtype: np.dtype[Any]
    count: int
    offset: int

    @property
    def chip_bytes(self) -> int:
        """Size of one chip in bytes."""
        return CHIP_SIZE * CHIP_SIZE * self.dtype.itemsize

    def byte_range(self, row: int, count: int) -> tuple[int, int]:
        """Position of the first byte, and number of bytes, of consecutive chips.

        Raises:
            FormatError: the file ends before the last of these chips.
        """
        if row < 0 or count < 0 or row + count > self.count:
            raise FormatError(
                f"{self.name}: {count} chips from row {row} requested, the file has {self.count} chips"
            )
        return self.offset + row * self.chip_bytes, count * self.chip_bytes

    def decode(self, data: bytes, row: int, count: int) -> ChipArray:
        """Chips (count, 101, 101) of the bytes of their `byte_range`.

        Raises:
            FormatError: bytes are missing.
        """
        if len(data) != count * self.chip_bytes:
            raise FormatError(
                f"{self.name}: truncated: {len(data)} bytes read for {count} chips from row {row}, "
                f"{count * self.chip_bytes} expected"
            )
        return np.frombuffer(data, self.dtype).reshape(count, CHIP_SIZE, CHIP_SIZE)


def parse_chip_header(file: IO[bytes], name: str) -> ChipFile:
    """The layout of a file of chips, from its header.

    Args:
        file: at its first byte; `MAX_HEADER_BYTES` of it are enough.
        name: name of the file, for messages.

    Raises:
        FormatError: the file is not a NumPy file of chips.
    """
    try:
        version = np.lib.format.read_magic(file)
        if version != (1, 0):
            raise ValueError(f"version {version} of the NumPy format found, (1, 0) expected")
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    except _HEADER_ERRORS as error:
        raise FormatError(f"{name}: cannot be read as a NumPy array: {error}") from error
    if len(shape) != 3 or shape[1:] != (CHIP_SIZE, CHIP_SIZE) or fortran:
        order = " in column-major order" if fortran else ""
        raise FormatError(f"{name}: shape {shape}{order} found, (n, {CHIP_SIZE}, {CHIP_SIZE}) expected")
    if dtype not in CHIP_DTYPES:
        raise FormatError(f"{name}: {dtype} found, uint8 or uint16 (little-endian) expected")
    return ChipFile(name, dtype, shape[0], file.tell())


def read_chip_file(path: Path, name: str) -> ChipFile:
    """The layout of a file of chips, checked against the size of the file.

    Args:
        path: of the file.
        name: name of the file, for messages.

    Raises:
        FormatError: the file is not a NumPy file of chips, or is truncated.
    """
    try:
        with path.open("rb") as file:
            layout = parse_chip_header(file, name)
            size = os.fstat(file.fileno()).st_size
    except OSError as error:
        raise FormatError(f"{name}: cannot be read as a NumPy array: {error}") from error
    if size != layout.offset + layout.count * layout.chip_bytes:
        raise FormatError(
            f"{name}: {size} bytes found, {layout.offset + layout.count * layout.chip_bytes} expected "
            f"for its {layout.count} chips"
        )
    return layout


def chip_file_header(dtype: np.dtype[Any], count: int) -> bytes:
    """The bytes before the first chip of a file of `count` chips."""
    header = BytesIO()
    np.lib.format.write_array_header_1_0(
        header,
        {
            "descr": np.lib.format.dtype_to_descr(dtype),
            "fortran_order": False,
            "shape": (count, CHIP_SIZE, CHIP_SIZE),
        },
    )
    return header.getvalue()
