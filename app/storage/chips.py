"""The chips of the storage, read by position."""

import io
import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from app.storage.folder import RangeReader, Storage
from services.conventions import CHIP_SIZE
from services.errors import FormatError

OPEN_CHIP_FILES = 64
LONGEST_HEADER = 4096


@dataclass(frozen=True)
class _ChipFile:
    reader: RangeReader
    first_byte: int
    dtype: np.dtype[Any]
    n_chips: int


class StoredChips:
    """The chips of the storage, as a `services.types.ChipSource`; files are named by their keys.

    Files stay open and their headers parsed; a read is one `pread`, or one request for a range of bytes.
    Safe to share between threads.
    """

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._open: OrderedDict[str, _ChipFile] = OrderedDict()
        self._lock = threading.Lock()

    def read(self, file: str, row: int, count: int) -> npt.NDArray[Any]:
        """Consecutive chips of one file.

        Returns:
            (count, 101, 101) uint8 or uint16; 0 is nodata.

        Raises:
            FormatError: the file is not one of chips, or ends before the last of them.
        """
        with self._lock:
            chips = self._find(file)
            size = count * CHIP_SIZE * CHIP_SIZE * chips.dtype.itemsize
            if not 0 <= row <= row + count <= chips.n_chips:
                raise FormatError(
                    f"{file} holds {chips.n_chips} chips; {count} asked for from row {row}"
                )
            start = chips.first_byte + size // max(count, 1) * row
            raw = chips.reader.read(start, size)
        if len(raw) != size:
            raise FormatError(f"{file} ends too early: {len(raw)} of {size} bytes from row {row}")
        return np.frombuffer(raw, chips.dtype).reshape(count, CHIP_SIZE, CHIP_SIZE)

    def close(self) -> None:
        """Close all files."""
        with self._lock:
            while self._open:
                self._open.popitem()[1].reader.close()

    def _find(self, file: str) -> _ChipFile:
        chips = self._open.pop(file, None) or _open_chips(self._storage.reader(file), file)
        self._open[file] = chips
        if len(self._open) > OPEN_CHIP_FILES:
            self._open.popitem(last=False)[1].reader.close()
        return chips


def _open_chips(reader: RangeReader, key: str) -> _ChipFile:
    """The file with its header parsed; it is closed again if it is none of chips."""
    try:
        return _parsed(reader, key.rsplit("/", 1)[-1])
    except BaseException:
        reader.close()
        raise


def _parsed(reader: RangeReader, name: str) -> _ChipFile:
    header = io.BytesIO(reader.read(0, LONGEST_HEADER))
    try:
        version = npy.read_magic(header)
        read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[version]
        shape, fortran, dtype = read_header(header)
    except (ValueError, KeyError) as error:
        raise FormatError(f"{name} is not a NumPy file: {error}") from error
    if (
        fortran
        or len(shape) != 3
        or shape[1:] != (CHIP_SIZE, CHIP_SIZE)
        or dtype.str not in ("|u1", "<u2")
    ):
        raise FormatError(f"{name} is not a file of chips: shape {shape}, {dtype.str}")
    return _ChipFile(reader, header.tell(), dtype, shape[0])
