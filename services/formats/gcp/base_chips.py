"""Chips of points from GCPLib and the Copernicus database, each read as a small ortho-image.

Their layouts are those of public software that writes or reads them; no delivered chip was available.
"""

import math
import re
from dataclasses import dataclass, replace
from datetime import UTC, datetime, time
from pathlib import Path

import numpy as np

from amers.services.errors import FormatError, InputError
from amers.services.formats.gcp.copernicus import COPERNICUS_KEY, copernicus_chips
from amers.services.formats.gcp.csv_points import PIXEL_ORIGINS
from amers.services.formats.gcp.gcplib import GcplibRecord, gcplib_records, is_gcplib
from amers.services.formats.images.bands import PixelCodes
from amers.services.formats.images.raster import map_grid_of, open_raster
from amers.services.formats.images.signatures import DRIVER_OF_SIGNATURE
from amers.services.formats.members import folder_member
from amers.services.formats.text_files import read_text
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window
from amers.services.map_grid import MapGrid
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Acquisition, FloatImage

ABSENT = "its chip is not in the folder"
UNREADABLE = "its chip cannot be read"
WRONG_SIZE = "the size of its chip is not the stated one"
WRONG_TYPE = "the type of the pixels of its chip is unknown"
NO_MAP = "the map of its chip is unknown"
"""Why a chip is not used."""

_MAX_SIDE = 1024
"""Largest side of a chip, pixels; chips of these bases have some 60."""
_MAX_BYTES = 16 * _MAX_SIDE**2
_RAW_TYPES = {"BYTE": "u1", "I*2": "<i2", "UI*2": "<u2", "R*4": "<f4"}
"""Types of pixels that the chip reader of the USGS accepts; its files are little-endian."""
_COPERNICUS_FOLDER = "L1C_chips"
"""Where the archives of the Copernicus database have their chips, beside its document."""
_NODATA = 0
"""Value of pixels without data, as in the images of Landsat and Sentinel-2."""
_NOON = time(12, tzinfo=UTC)
"""Time of an image of which the date is known."""


@dataclass(frozen=True)
class RawLayout:
    """How the pixels of a headerless chip lie in its file and on the map.

    Attributes:
        type: of the pixels, as the record states it.
        lines, samples: size, as the record states it.
        grid: the map of a chip of that size; None when unknown.
    """

    type: str
    lines: float
    samples: float
    grid: MapGrid | None


@dataclass(frozen=True)
class BaseChip:
    """The file of a chip of another base.

    Attributes:
        point_id: of its point.
        path: of the file.
        acquisition: of the images that it may come from: bases do not name the image of a chip.
        raw: layout of a headerless file; None for a GeoTIFF on a map.
    """

    point_id: str
    path: Path
    acquisition: Acquisition
    raw: RawLayout | None = None


def read_base_chips(path: Path, folder: Path, pixel_origin: str | None = None) -> list[BaseChip]:
    """The chips that the points of a base name.

    Args:
        path: GCPLib, or a file of the Copernicus database.
        folder: of the chips.
        pixel_origin: what reference line and sample of a GCPLib count from, which it does not state: a
            name of `PIXEL_ORIGINS`.

    Raises:
        FormatError: the file has neither of these formats, its content is wrong, or the name of a chip
            leads out of the folder.
        InputError: the origin of the pixels is missing, unknown, or given for a base that has none.
    """
    text = read_text(path)
    if not folder.is_dir():
        raise InputError(f"{folder}: expected the folder of the chips")
    if is_gcplib(text):
        if pixel_origin not in PIXEL_ORIGINS:
            raise InputError(
                f"{path.name}: reference line and sample of its chips are counted from an origin that "
                f"the file does not state, {pixel_origin or 'nothing'} given; state it (--chip-origin): "
                + ", ".join(PIXEL_ORIGINS)
            )
        first = PIXEL_ORIGINS[pixel_origin]
        return [_gcplib_chip(record, folder, first) for record in gcplib_records(text, path.name)]
    if f'"{COPERNICUS_KEY}"' in text:
        if pixel_origin is not None:
            raise InputError(
                f"{path.name}: its chips are GeoTIFF, which state their origin; leave --chip-origin out"
            )
        return [
            BaseChip(
                point_id,
                _copernicus_file(folder, name),
                Acquisition(f"GRI-{number:02d}", "Sentinel-2", incidence_deg=0.0, azimuth_deg=0.0),
            )
            for point_id, number, name in copernicus_chips(text, path.name)
        ]
    raise FormatError(
        f"{path.name}: expected a base with chips (--chips), USGS GCPLib or the Copernicus GCP "
        "database; give images of other points (--images)"
    )


def open_base_chip(chip: BaseChip) -> Scene | str:
    """A chip as an ortho-image that shows one point, or why it is not used."""
    try:
        if not chip.path.is_file():
            return ABSENT
        if chip.path.stat().st_size > _MAX_BYTES:
            return WRONG_SIZE
        return _raw_scene(chip, chip.raw) if chip.raw is not None else _geotiff_scene(chip)
    except (FormatError, OSError):
        return UNREADABLE


def _copernicus_file(folder: Path, name: str) -> Path:
    """The file of a chip: in a folder, or in the folder `L1C_chips` of an unpacked archive there."""
    path = folder_member(folder, name, "the folder of the chips")
    inside = folder_member(folder, f"{_COPERNICUS_FOLDER}/{path.name}", "the folder of the chips")
    return inside if inside.is_file() and not path.is_file() else path


def _gcplib_chip(record: GcplibRecord, folder: Path, first: float) -> BaseChip:
    words, numbers = record.words, record.numbers
    lines, samples = numbers["chip_size_lines"], numbers["chip_size_samples"]
    east_m, north_m = abs(numbers["pixel_size_x"]), abs(numbers["pixel_size_y"])
    grid = None
    if record.crs is not None and east_m > 0.0 and north_m > 0.0:
        line, sample = numbers["reference_line"] - first, numbers["reference_sample"] - first
        origin_xy = [numbers["projection_x"] - sample * east_m, numbers["projection_y"] + line * north_m]
        step_xy = np.array([[0.0, east_m], [-north_m, 0.0]])
        grid = MapGrid(record.crs, np.array(origin_xy), step_xy, (int(lines), int(samples)))
    try:
        path = folder_member(folder, words["chip_name"], "the folder of the chips")
    except FormatError as error:
        raise FormatError(f"{record.where}: chip_name: {error}") from None
    taken = Acquisition(
        re.sub(r"[^A-Za-z0-9._-]", "_", f"{words['source']}-{words['chip_type']}-{record.acquired_on}"),
        words["source"],
        datetime.combine(record.acquired_on, _NOON),
        incidence_deg=0.0,
        azimuth_deg=0.0,
    )
    return BaseChip(
        words["point_id"], path, taken, RawLayout(words["data_type"].upper(), lines, samples, grid)
    )


def _raw_scene(chip: BaseChip, raw: RawLayout) -> Scene | str:
    if raw.grid is None:
        return NO_MAP
    if raw.type not in _RAW_TYPES:
        return WRONG_TYPE
    dtype, (lines, samples) = np.dtype(_RAW_TYPES[raw.type]), raw.grid.shape
    if (lines, samples) != (raw.lines, raw.samples) or not (_is_side(lines) and _is_side(samples)):
        return WRONG_SIZE
    data = chip.path.read_bytes()
    if len(data) != lines * samples * dtype.itemsize:
        return WRONG_SIZE
    pixels = np.frombuffer(data, dtype).reshape(lines, samples).astype(np.float32)
    pixels[(pixels == _NODATA) | ~np.isfinite(pixels)] = np.nan
    return _scene(chip, pixels, raw.grid)


def _geotiff_scene(chip: BaseChip) -> Scene | str:
    with chip.path.open("rb") as file:
        if DRIVER_OF_SIGNATURE.get(file.read(4)) != "GTiff":
            return UNREADABLE
    image = open_raster(chip.path)
    try:
        lines, samples = image.shape
        if not (_is_side(lines) and _is_side(samples)):
            return WRONG_SIZE
        grid = map_grid_of(image)
        if grid is None:
            return NO_MAP
        with_codes = replace(image, codes=PixelCodes(nodata=_NODATA))
        return _scene(chip, with_codes.read(Window(0, 0, lines, samples)), grid)
    finally:
        image.close()


def _is_side(pixels: int) -> bool:
    return 2 <= pixels <= _MAX_SIDE


def _scene(chip: BaseChip, pixels: FloatImage, grid: MapGrid) -> Scene:
    return Scene(ArrayImage(pixels), OrthoModel(grid), chip.acquisition, math.nan)
