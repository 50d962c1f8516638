"""Working copies, in small tiles, of images that cannot be read by windows."""

import errno
import os
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rasterio
import rasterio.shutil

from amers.services.errors import FormatError
from amers.services.formats.addresses import Address, FilePlace
from amers.services.formats.images.datasets import GDAL_OPTIONS, as_format_error
from amers.services.formats.images.layout import MIB, READ_BY_WINDOWS_BYTES, largest_piece_bytes

LARGEST_PIECE_BYTES = 1024 * MIB
"""Largest strip or tile of an image: it is unpacked in memory."""
LARGEST_COPY_BYTES = 4096 * MIB
"""Largest image that is unpacked into a working copy."""
LEAST_FREE_BYTES = 16 * MIB
"""A disk with less is taken for the reason when no copy can be written."""
_TILES = {
    "driver": "GTiff",
    "tiled": "YES",
    "blockxsize": "512",
    "blockysize": "512",
    "compress": "DEFLATE",
    "zlevel": "1",
    "bigtiff": "IF_SAFER",
}


@dataclass
class Pixels:
    """The dataset that the pixels of an image are read from: its file, or a copy of it.

    Attributes:
        path: of the file, or its address.
        file: the dataset of the file.
        is_copied: whether the first reading makes a copy.
    """

    path: FilePlace
    file: rasterio.DatasetReader
    is_copied: bool
    _copy: rasterio.DatasetReader | None = field(default=None, repr=False)

    @property
    def dataset(self) -> rasterio.DatasetReader:
        """What windows are read from.

        Raises:
            FormatError: the file cannot be unpacked.
            OSError: the disk of temporary files is full.
        """
        if not self.is_copied:
            return self.file
        if self._copy is None:
            self._copy = _copied(self.path, self.file)
        return self._copy

    def close(self) -> None:
        """Close both."""
        self.file.close()
        if self._copy is not None:
            self._copy.close()


def open_pixels(path: FilePlace, dataset: rasterio.DatasetReader) -> Pixels:
    """Where the pixels of an image are read: in a working copy where its strips or tiles are large.

    Raises:
        FormatError: they are too large to be unpacked.
    """
    piece = _largest_piece_bytes(path, dataset)
    if piece <= READ_BY_WINDOWS_BYTES:
        return Pixels(path, dataset, is_copied=False)
    pixels = dataset.width * dataset.height
    whole = sum(pixels * np.dtype(kind).itemsize for kind in dataset.dtypes)
    if piece > LARGEST_PIECE_BYTES or whole > LARGEST_COPY_BYTES:
        raise FormatError(
            f"{path}: the largest strip or tile unpacks to {piece / MIB:,.0f} MiB, in an image of "
            f"{whole / MIB:,.0f} MiB; at most {READ_BY_WINDOWS_BYTES // MIB} MiB expected, or "
            f"{LARGEST_PIECE_BYTES // MIB:,} MiB in an image of {LARGEST_COPY_BYTES // MIB:,} MiB: "
            "write it in tiles (gdal_translate -co TILED=YES)"
        )
    return Pixels(path, dataset, is_copied=True)


def _largest_piece_bytes(path: FilePlace, dataset: rasterio.DatasetReader) -> int:
    """Bytes that the largest strip or tile unpacks to, as GDAL reads it and as the file is packed.

    A JPEG 2000 image is unpacked by parts of its tiles, whatever their size.
    """
    if dataset.driver.startswith("JP2"):
        return 0
    shapes = zip(dataset.block_shapes, dataset.dtypes, strict=True)
    shown = max(lines * samples * np.dtype(kind).itemsize for (lines, samples), kind in shapes)
    return max(shown, 0 if isinstance(path, Address) else largest_piece_bytes(path))


def _copied(path: FilePlace, dataset: rasterio.DatasetReader) -> rasterio.DatasetReader:
    """A copy of all pixels and masks; its file has no name any more and ends with the dataset."""
    with tempfile.TemporaryDirectory(prefix="amers-pixels-") as folder:
        copy = Path(folder) / "copy.tif"
        try:
            with (
                as_format_error(path, "readable pixels"),
                rasterio.Env(**GDAL_OPTIONS, GDAL_TIFF_INTERNAL_MASK="YES"),
            ):
                rasterio.shutil.copy(dataset, copy, **_TILES)
                return rasterio.open(copy, driver="GTiff")
        except FormatError:
            if shutil.disk_usage(folder).free < LEAST_FREE_BYTES:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(copy)) from None
            raise
