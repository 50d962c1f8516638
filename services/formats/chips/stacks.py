"""The chips of many points as one file, made piece by piece: never more than one piece is in memory."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from io import RawIOBase
from typing import Any
from zipfile import ZIP_STORED, ZipFile

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy
from typing_extensions import Buffer

from services.conventions import CHIP_SIZE
from services.types import ChipArray, ChipSource, ControlPoints, IntArray

CHIPS_AT_ONCE = 256
"""Chips of one piece: 5 MB of 16 bits."""


@dataclass(frozen=True)
class ChipRun:
    """Chips that lie one after the other in a file of the storage."""

    file: str
    row: int
    count: int


def chip_runs(points: ControlPoints) -> list[ChipRun]:
    """Where the chips of points lie, in the order of points and views; neighbours are read together."""
    counts = np.diff(points.views.start)
    runs: list[ChipRun] = []
    for file, row, count in zip(points.chip_file, points.chip_row, counts, strict=True):
        name, row, count = points.chip_files[file], int(row), int(count)
        last = runs[-1] if runs else None
        follows = last is not None and (last.file, last.row + last.count) == (name, row)
        if last is not None and follows and last.count + count <= CHIPS_AT_ONCE:
            runs[-1] = ChipRun(name, last.row, last.count + count)
        else:
            runs.append(ChipRun(name, row, count))
    return runs


def chip_table(points: ControlPoints) -> dict[str, npt.NDArray[Any]]:
    """What each chip of some points shows, a row for each, by the names of columns.

    Returns:
        `point_id`, `view` (int64); `lon_lat_h` (n, 3) of the point, degrees and metres; `gsd_m`,
        `incidence_deg`, `azimuth_deg`, `sun_elevation_deg`, `sun_azimuth_deg` (NaN when unknown);
        `image_id`, `sensor` (texts); `acquired_at` (UTC, NaT when unknown).
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
        "image_id": _of_images([image.image_id for image in images], views.image, "U1"),
        "sensor": _of_images([image.sensor for image in images], views.image, "U1"),
        "acquired_at": _of_images(times, views.image, "datetime64[us]"),
        "sun_elevation_deg": _of_images([i.sun_elevation_deg for i in images], views.image, "f8"),
        "sun_azimuth_deg": _of_images([i.sun_azimuth_deg for i in images], views.image, "f8"),
    }


def read_runs(runs: Iterable[ChipRun], chips: ChipSource) -> Iterator[ChipArray]:
    """The chips of runs, one run after the other."""
    for run in runs:
        yield chips.read(run.file, run.row, run.count)


def stream_chips_npz(points: ControlPoints, chips: ChipSource) -> Iterator[bytes]:
    """The chips of points with what they show, as a NumPy archive without pickled objects.

    Arrays are those of `chip_table`, and `chips` (n, 101, 101): raw values, 0 is nodata; of 16 bits
    where some are.

    Raises:
        FormatError: chips are not where the store says; with the first piece, if with the first chips.
    """
    runs = chip_runs(points)
    dtype = _dtype(runs, chips)
    sink = _Sink()
    with ZipFile(sink, "w", ZIP_STORED) as archive:
        with archive.open("chips.npy", "w", force_zip64=True) as member:
            shape = (int(points.views.start[-1]), CHIP_SIZE, CHIP_SIZE)
            npy.write_array_header_1_0(
                member, {"descr": dtype.str, "fortran_order": False, "shape": shape}
            )
            for piece in read_runs(runs, chips):
                member.write(np.ascontiguousarray(piece, dtype).data.cast("B"))
                yield from sink.taken()
        for name, column in chip_table(points).items():
            with archive.open(f"{name}.npy", "w") as member:
                npy.write_array(member, column, allow_pickle=False)
    yield from sink.taken()


class _Sink(RawIOBase):
    """A file that cannot go back; what is written to it is taken from it piece by piece."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, piece: Buffer, /) -> int:
        self._pieces.append(bytes(piece))
        return len(self._pieces[-1])

    def taken(self) -> list[bytes]:
        """What was written since this was last called."""
        pieces, self._pieces = self._pieces, []
        return pieces


def _dtype(runs: list[ChipRun], chips: ChipSource) -> np.dtype[Any]:
    """The type that holds the chips of all files; one chip of each is read to know."""
    kinds = {run.file: chips.read(run.file, run.row, 1).dtype for run in runs}
    return np.result_type(*kinds.values()) if kinds else np.dtype(np.uint8)


def _of_images(values: list[Any], image: IntArray, dtype: str) -> npt.NDArray[Any]:
    """A value of the images of chips."""
    if dtype == "U1":
        return np.array(values, dtype=np.str_)[image] if values else np.zeros(0, dtype=dtype)
    return np.array(values, dtype=dtype)[image]
