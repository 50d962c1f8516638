"""The chips of many points as one NPZ file, generated piece by piece to bound the memory."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from io import RawIOBase
from typing import Any
from zipfile import ZIP_STORED, ZipFile

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy
from typing_extensions import Buffer

from amers.services.conventions import CHIP_SIZE
from amers.services.types import ChipArray, ChipSource, ControlPoints, IntArray

CHIPS_PER_PIECE = 256
"""Chips in memory at once: 5 MB at 16 bits."""


@dataclass(frozen=True)
class ChipRun:
    """Consecutive chips of one file of a `ChipSource`."""

    file: str
    row: int
    count: int


def chip_runs(points: ControlPoints) -> list[ChipRun]:
    """The runs of chips to read for points, in the order of points and views; neighbours are merged."""
    counts = np.diff(points.views.start)
    runs: list[ChipRun] = []
    for file, row, count in zip(points.chip_file, points.chip_row, counts, strict=True):
        name, row, count = points.chip_files[file], int(row), int(count)
        last = runs[-1] if runs else None
        follows = last is not None and (last.file, last.row + last.count) == (name, row)
        if last is not None and follows and last.count + count <= CHIPS_PER_PIECE:
            runs[-1] = ChipRun(name, last.row, last.count + count)
        else:
            runs.append(ChipRun(name, row, count))
    return runs


def chip_table(points: ControlPoints) -> dict[str, npt.NDArray[Any]]:
    """The metadata of each chip of some points: columns (n, ...) by name.

    Returns:
        `point_id`, `view` (int64); `lon_lat_h` (n, 3) of the point, degrees and metres; `gsd_m`,
        `incidence_deg`, `azimuth_deg`, `sun_elevation_deg`, `sun_azimuth_deg` (NaN when unknown);
        `image_id`, `sensor` (str); `acquired_at` (UTC, NaT when unknown).
    """
    views, images = points.views, points.views.images
    owner = np.repeat(np.arange(len(points.id)), np.diff(views.start))
    times = [
        "NaT" if image.acquired_at is None else image.acquired_at.replace(tzinfo=None)
        for image in images
    ]
    return {
        "point_id": points.id[owner],
        "view": np.arange(len(owner)) - views.start[owner],
        "lon_lat_h": points.lon_lat_h[owner],
        "gsd_m": views.gsd_m,
        "incidence_deg": views.incidence_deg,
        "azimuth_deg": views.azimuth_deg,
        "image_id": _per_chip([image.image_id for image in images], views.image, "U1"),
        "sensor": _per_chip([image.sensor for image in images], views.image, "U1"),
        "acquired_at": _per_chip(times, views.image, "datetime64[us]"),
        "sun_elevation_deg": _per_chip([i.sun_elevation_deg for i in images], views.image, "f8"),
        "sun_azimuth_deg": _per_chip([i.sun_azimuth_deg for i in images], views.image, "f8"),
    }


def read_runs(runs: Iterable[ChipRun], chips: ChipSource) -> Iterator[ChipArray]:
    """Yield the chips of each run."""
    for run in runs:
        yield chips.read(run.file, run.row, run.count)


def stream_chips_npz(points: ControlPoints, chips: ChipSource) -> Iterator[bytes]:
    """Yield the bytes of a NumPy archive with the chips of points and their metadata.

    The archive contains no pickled objects. Its arrays are those of `chip_table` and `chips`
    (n, 101, 101): raw values, 0 is nodata; uint16 when the chips of any file are, else uint8.

    Raises:
        FormatError: a file of chips is unreadable or too short; before the first piece where it is the
            file of the first chips.
    """
    runs = chip_runs(points)
    dtype = _common_dtype(runs, chips)
    sink = _Sink()
    with ZipFile(sink, "w", ZIP_STORED) as archive:
        with archive.open("chips.npy", "w", force_zip64=True) as member:
            shape = (int(points.views.start[-1]), CHIP_SIZE, CHIP_SIZE)
            npy.write_array_header_1_0(
                member, {"descr": dtype.str, "fortran_order": False, "shape": shape}
            )
            for piece in read_runs(runs, chips):
                member.write(np.ascontiguousarray(piece, dtype).data.cast("B"))
                yield from sink.drain()
        for name, column in chip_table(points).items():
            with archive.open(f"{name}.npy", "w") as member:
                npy.write_array(member, column, allow_pickle=False)
    yield from sink.drain()


class _Sink(RawIOBase):
    """A writable, non-seekable file that returns the bytes written to it piece by piece."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, piece: Buffer, /) -> int:
        self._pieces.append(bytes(piece))
        return len(self._pieces[-1])

    def drain(self) -> list[bytes]:
        """The pieces written since the last call."""
        pieces, self._pieces = self._pieces, []
        return pieces


def _common_dtype(runs: list[ChipRun], chips: ChipSource) -> np.dtype[Any]:
    """The type that holds the chips of all files; reads one chip of each file."""
    kinds = {run.file: chips.read(run.file, run.row, 1).dtype for run in runs}
    return np.result_type(*kinds.values()) if kinds else np.dtype(np.uint8)


def _per_chip(values: list[Any], image: IntArray, dtype: str) -> npt.NDArray[Any]:
    """The values of the images, one for each chip."""
    if dtype == "U1":
        return np.array(values, dtype=np.str_)[image] if values else np.zeros(0, dtype=dtype)
    return np.array(values, dtype=dtype)[image]
