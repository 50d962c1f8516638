"""GDAL datasets: opened by the driver of their first bytes, with errors that name the file."""

import atexit
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from weakref import WeakSet

import rasterio
from rasterio.errors import RasterioError

from amers.services.errors import FormatError
from amers.services.formats.addresses import Address, FilePlace, RangeFile
from amers.services.formats.images.signatures import DRIVER_OF_SIGNATURE

_SIGNATURE_BYTES = max(map(len, DRIVER_OF_SIGNATURE))

# Outside of such an environment GDAL's cache grows to a twentieth of the machine's memory.
GDAL_CACHE = {"GDAL_CACHEMAX": 64_000_000}
GDAL_OPTIONS = GDAL_CACHE | {
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    "GDAL_NUM_THREADS": 1,
    "OPJ_NUM_THREADS": 1,
    "GTIFF_REPORT_COMPD_CS": "YES",
}

_failed = threading.local()
_OPEN: WeakSet[rasterio.DatasetReader] = WeakSet()


def open_dataset(path: FilePlace) -> rasterio.DatasetReader:
    """Open a GeoTIFF, JPEG 2000 or NITF file with its driver; a path that is a URL is refused.

    Raises:
        FormatError: it is another kind of file, or cannot be read.
    """
    return _dataset_at(path) if isinstance(path, Address) else _dataset_of_file(path)


@contextmanager
def as_format_error(path: FilePlace, expected: str) -> Iterator[None]:
    """Convert errors of the driver, and failures below it, into a FormatError that names the file."""
    _failed.reason = error = None
    try:
        yield
    except RasterioError as raised:
        error = raised
    if _failed.reason is not None:
        raise _failed.reason from None
    if error is not None:
        raise FormatError(f"{path}: truncated or damaged, {expected} expected: {error}") from error


def _dataset_of_file(path: Path) -> rasterio.DatasetReader:
    resolved = path.resolve()
    if "://" in str(path) or str(path).startswith("/vsi") or not resolved.is_file():
        raise FormatError(f"{path}: expected the name of an existing image file")
    try:
        with path.open("rb") as file:
            driver = _driver(file.read(_SIGNATURE_BYTES), path)
    except OSError as error:
        raise FormatError(f"{path}: cannot be opened: {error.strerror}") from error
    with as_format_error(path, f"a readable {driver} image"):
        return rasterio.open(resolved, driver=driver)


def _dataset_at(address: Address) -> rasterio.DatasetReader:
    file = address.open()
    driver = _driver(file.read(_SIGNATURE_BYTES), address)

    def opened(name: str, mode: str = "rb") -> RangeFile:
        """What GDAL reads from; it knows the file by its last name only."""
        return _FileForGdal(file.address, file.size, file.version)

    with as_format_error(address, f"a readable {driver} image"):
        dataset = rasterio.open(address.name, driver=driver, opener=opened)
    _OPEN.add(dataset)
    return dataset


class _FileForGdal(RangeFile):
    """A file that ends where it cannot be read: errors cannot pass through GDAL."""

    def readinto(self, buffer: Any) -> int:
        """As of the base; the reason of a failure waits for `as_format_error`."""
        try:
            return super().readinto(buffer)
        except FormatError as error:
            _failed.reason = error
            return 0


def _driver(start: bytes, path: FilePlace) -> str:
    """The GDAL driver for a file, by its first bytes."""
    for signature, driver in DRIVER_OF_SIGNATURE.items():
        if start.startswith(signature):
            return driver
    raise FormatError(f"{path}: expected a GeoTIFF, JPEG 2000 or NITF image, found another kind of file")


@atexit.register
def _close_all() -> None:
    """Close what would call Python when Python is gone, and crash."""
    for dataset in list(_OPEN):
        dataset.close()
