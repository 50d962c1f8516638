"""Chips of blocks in the storage, read by position and checked."""

import errno
import io
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from amers.app.errors import DamagedFile, NotFound
from amers.app.storage.files import RangeReader
from amers.app.storage.folder import Storage
from amers.services.errors import FormatError
from amers.services.formats.chips.checksums import CHECKSUM, Checksums, damaged_rows
from amers.services.formats.chips.npy_files import MAX_HEADER_BYTES, ChipFile, parse_chip_header
from amers.services.types import ChipArray

OPEN_CHIP_FILES = 64
ROWS_NAMED = 10

FindChecksums = Callable[[str], bytes | None]
"""The checksums of all chips of the file with a key; None if they are not recorded."""


@dataclass(frozen=True)
class _OpenChipFile:
    reader: RangeReader
    layout: ChipFile
    checksums: Checksums | None


class StoredChips:
    """The chip files in the storage, named by their keys, as a `amers.services.types.ChipSource`.

    Files stay open with their headers parsed and their checksums read, so that a read is one `pread` or
    one range request. Threads may share it.
    """

    def __init__(self, storage: Storage, find_checksums: FindChecksums) -> None:
        self._storage = storage
        self._find_checksums = find_checksums
        self._open: OrderedDict[str, _OpenChipFile] = OrderedDict()
        self._lock = threading.Lock()

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """Consecutive chips of one file, after a comparison with their checksums.

        Returns:
            (count, 101, 101) uint8 or uint16; 0 is nodata.

        Raises:
            DamagedFile: the file is missing or shorter than it was, or chips have other checksums than
                recorded.
        """
        try:
            return self._read(file, row, count)
        except DamagedFile:
            # The file may have been repaired since it was opened.
            self._forget(file)
            return self._read(file, row, count)

    def close(self) -> None:
        """Close all files."""
        with self._lock:
            while self._open:
                self._open.popitem()[1].reader.close()

    def _read(self, file: str, row: int, count: int) -> ChipArray:
        try:
            with self._lock:
                chips = self._find(file)
                data = chips.reader.read(*chips.layout.byte_range(row, count))
            decoded = chips.layout.decode(data, row, count)
        except NotFound as error:
            raise DamagedFile(file, "missing from the storage") from error
        except FormatError as error:
            raise DamagedFile(file, str(error)) from error
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            raise DamagedFile(file, "the disk cannot read it") from error
        if chips.checksums is not None:
            rows = damaged_rows(data, chips.layout, row, chips.checksums)
            if rows:
                raise DamagedFile(file, damage_of_rows(rows, chips.layout.count))
        return decoded

    def _find(self, file: str) -> _OpenChipFile:
        chips = self._open.pop(file, None) or self._open_file(file)
        self._open[file] = chips
        if len(self._open) > OPEN_CHIP_FILES:
            self._open.popitem(last=False)[1].reader.close()
        return chips

    def _open_file(self, key: str) -> _OpenChipFile:
        """The file with its header parsed; the reader is closed when it is not a file of chips."""
        reader = self._storage.reader(key)
        try:
            header = io.BytesIO(reader.read(0, MAX_HEADER_BYTES))
            layout = parse_chip_header(header, key.rsplit("/", 1)[-1])
            recorded = self._find_checksums(key)
            checksums = None if recorded is None else np.frombuffer(recorded, CHECKSUM)
            if checksums is not None and len(checksums) != layout.count:
                raise FormatError(f"{layout.count} chips in its header, {len(checksums)} recorded")
            return _OpenChipFile(reader, layout, checksums)
        except BaseException:
            reader.close()
            raise

    def _forget(self, file: str) -> None:
        with self._lock:
            chips = self._open.pop(file, None)
            if chips is not None:
                chips.reader.close()


def damage_of_rows(rows: list[int], count: int) -> str:
    """A message that names the damaged chips of a file."""
    named = ", ".join(map(str, rows[:ROWS_NAMED])) + " …" * (len(rows) > ROWS_NAMED)
    return f"{len(rows)} of its {count} chips do not have their checksums: rows {named}"
