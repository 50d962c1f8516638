"""Chips of blocks in the storage, read by position."""

import io
import threading
from collections import OrderedDict
from dataclasses import dataclass

from app.storage.folder import RangeReader, Storage
from services.formats.chips.npy_files import MAX_HEADER_BYTES, ChipFile, parse_chip_header
from services.types import ChipArray

OPEN_CHIP_FILES = 64


@dataclass(frozen=True)
class _OpenChipFile:
    reader: RangeReader
    layout: ChipFile


class StoredChips:
    """A `services.types.ChipSource` of the chip files in the storage, which are named by their keys.

    Files stay open with their headers parsed, so that a read is one `pread` or one range request.
    Threads may share it.
    """

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._open: OrderedDict[str, _OpenChipFile] = OrderedDict()
        self._lock = threading.Lock()

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """Consecutive chips of one file.

        Returns:
            (count, 101, 101) uint8 or uint16; 0 is nodata.

        Raises:
            FormatError: it is not a chip file, or it ends before the last requested chip.
        """
        with self._lock:
            chips = self._find(file)
            data = chips.reader.read(*chips.layout.byte_range(row, count))
        return chips.layout.decode(data, row, count)

    def close(self) -> None:
        """Close all files."""
        with self._lock:
            while self._open:
                self._open.popitem()[1].reader.close()

    def _find(self, file: str) -> _OpenChipFile:
        chips = self._open.pop(file, None) or _open_chips(self._storage.reader(file), file)
        self._open[file] = chips
        if len(self._open) > OPEN_CHIP_FILES:
            self._open.popitem(last=False)[1].reader.close()
        return chips


def _open_chips(reader: RangeReader, key: str) -> _OpenChipFile:
    """The file with its header parsed; the reader is closed when it is not a file of chips."""
    try:
        header = io.BytesIO(reader.read(0, MAX_HEADER_BYTES))
        return _OpenChipFile(reader, parse_chip_header(header, key.rsplit("/", 1)[-1]))
    except BaseException:
        reader.close()
        raise
