"""Memory failures of the libraries are recognised, whatever error they raise."""

import errno
import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import psycopg
import pytest
import rasterio

from amers.app.errors import is_no_memory, is_no_room
from amers.services.errors import FormatError

READ_LITTLE = """
import json, resource, sys
import rasterio
from rasterio.windows import Window
from amers.app.errors import is_no_memory
from amers.app.worker.limits import limit_memory
from amers.services.formats.images.datasets import as_format_error
from pathlib import Path

with rasterio.open(sys.argv[1]) as image:
    limit_memory(200 << 20)
    try:
        with as_format_error(Path("a.tif"), "an image"):
            image.read(1, window=Window(0, 0, 10, 10))
    except Exception as error:
        print(json.dumps([type(error).__name__, is_no_memory(error)]))
"""


def caused_by(cause: BaseException) -> FormatError:
    error = FormatError("a.tif: truncated or damaged")
    error.__cause__ = cause
    return error


def opencv_error(code: int) -> cv2.error:
    error = cv2.error("an error")
    error.code = code
    return error


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        np._core._exceptions._ArrayMemoryError((1 << 40,), np.dtype(np.uint8)),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        opencv_error(-4),
        psycopg.OperationalError("out of memory for query result"),
        RuntimeError("std::bad_alloc"),
        RuntimeError("can't start new thread"),
        rasterio.errors.RasterioIOError("a.tif: cannot allocate 17942446080 bytes"),
        caused_by(MemoryError()),
    ],
    ids=repr,
)
def test_a_library_without_memory_is_recognised(error: BaseException):
    assert is_no_memory(error)
    assert not is_no_room(error)


@pytest.mark.parametrize(
    "error",
    [
        FormatError("a.tif: the name 'out of memory' is not the name of a band"),
        ValueError("unusable"),
        OSError(errno.ENOSPC, "No space left on device"),
        opencv_error(-215),
        psycopg.errors.OutOfMemory("out of shared memory"),
    ],
    ids=repr,
)
def test_other_errors_are_no_lack_of_memory_of_this_process(error: BaseException):
    """What the database's server reports is the state of another process."""
    assert not is_no_memory(error)


@pytest.mark.long
def test_a_tile_that_memory_does_not_hold_is_no_damaged_file(tmp_path: Path):
    """GDAL raises its error for memory below two others, which the reader takes for a damaged file."""
    path = tmp_path / "one_tile.tif"
    profile = {"driver": "GTiff", "count": 1, "dtype": "uint16", "compress": "deflate"}
    size = {"width": 30_000, "height": 30_000, "blockxsize": 29_952, "blockysize": 29_952}
    with rasterio.open(path, "w", **profile, **size, tiled=True, sparse_ok=True):
        pass
    assert path.stat().st_size < 1000
    command = [sys.executable, "-c", READ_LITTLE, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert json.loads(done.stdout) == ["FormatError", True]


@pytest.mark.parametrize("first", [RuntimeError("the connection is lost"), MemoryError()])
def test_causes_that_form_a_ring_are_looked_at_once(first: Exception):
    """SQLAlchemy raises the errors of a lost session from themselves."""
    second = FormatError("a.tif: truncated or damaged")
    first.__cause__, second.__cause__ = second, first
    assert is_no_memory(second) is isinstance(first, MemoryError)
    second.__cause__ = second
    assert not is_no_memory(second)
