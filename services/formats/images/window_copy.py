"""Local copies of the needed parts of large images, without the pixels that a mask excludes."""

import math
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from rasterio.windows import Window as RasterWindow

from amers.services.errors import CoverageError, FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.images.datasets import GDAL_OPTIONS, as_format_error, open_dataset
from amers.services.imagery.archives import Archive
from amers.services.map_grid import continuous_xy
from amers.services.types import Array, BoolArray

_PIECE = 1024
"""Lines and samples that are in memory at a time."""
_TILE = 256
_ROUNDING_PX = 1e-3
_EDGE_DEG = 0.05
"""Length of the edges of an area that are straight on another map."""
_LARGEST = np.iinfo(np.uint16).max


@dataclass(frozen=True)
class CopiedWindow:
    """What was copied.

    Attributes:
        shape: lines and samples of the copy.
        full: lines and samples of the image.
        pixels: number of those that were read.
        valid: share of the pixels that were read with data.
        clear: share of those with data that the mask does not hide.
    """

    shape: tuple[int, int]
    full: tuple[int, int]
    pixels: int
    valid: float
    clear: float


@dataclass(frozen=True)
class WindowSource:
    """An image, and how its pixels are read.

    Attributes:
        image: its place.
        mask: place of the mask; None for none.
        archive: scale, value without data, and what of the mask hides the ground.
        offset: added to pixel values.
    """

    image: FilePlace
    mask: FilePlace | None
    archive: Archive
    offset: float = 0.0

    def hidden(self, values: Any) -> BoolArray:
        """Which values of the mask hide the ground."""
        hidden = np.isin(values, self.archive.hidden_classes)
        bits = sum(1 << bit for bit in self.archive.hidden_bits)
        return np.asarray(hidden | ((values.astype(np.int64) & bits) != 0))

    def stored(self, pixels: Any) -> Any:
        """Pixels as 16 bits: 0 has no data."""
        values = pixels.astype(np.float64)
        valid = np.isfinite(values) & (values != self.archive.nodata)
        values = np.clip(np.rint(values * self.archive.scale + self.offset), 1.0, _LARGEST - 1.0)
        return np.where(valid, values, 0.0).astype(np.uint16)


def clear_share(source: WindowSource, lon_lat: Array) -> float:
    """Share (0 to 1) of the ground of an area that the mask of an image does not hide; 1 without a mask.

    Args:
        source: the image.
        lon_lat: (n, 2) places of the area, evenly.

    Raises:
        FormatError: the mask cannot be read.
    """
    if source.mask is None:
        return 1.0
    with rasterio.Env(**GDAL_OPTIONS), open_dataset(source.mask) as mask:
        place = ~mask.transform @ continuous_xy(mask.crs.to_wkt(), lon_lat).T
        column, row = (np.floor(axis).astype(np.int64) for axis in place)
        inside = (row >= 0) & (row < mask.height) & (column >= 0) & (column < mask.width)
        if not inside.any():
            return 0.0
        first = row[inside].min(), column[inside].min()
        last = row[inside].max(), column[inside].max()
        window = RasterWindow(first[1], first[0], last[1] - first[1] + 1, last[0] - first[0] + 1)
        with as_format_error(source.mask, "a readable mask"):
            values = mask.read(1, window=window)
    shown = ~source.hidden(values[row[inside] - first[0], column[inside] - first[1]])
    return float(shown.sum() / len(lon_lat))


def copy_window(source: WindowSource, area: shapely.Geometry, path: Path) -> CopiedWindow:
    """Copy the part of an image that shows an area, as 16 bits, with 0 where the mask hides the ground.

    The file appears when it is complete. Only tiles that the area touches are read; the others in the
    window of the copy have no data.

    Args:
        source: the image and its mask on the same map.
        area: polygons, longitude and latitude.
        path: of the copy, a GeoTIFF in tiles.

    Raises:
        CoverageError: the image does not show the area.
        FormatError: a file cannot be read.
    """
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with rasterio.Env(**GDAL_OPTIONS), open_dataset(source.image) as image:
            needed = _in_pixels(image, area, source.image)
            window = _window(image, needed, source.image)
            mask = None if source.mask is None else open_dataset(source.mask)
            try:
                with rasterio.open(partial, "w", **_profile(image, window)) as out:
                    counts = _copy(source, (image, mask), window, needed, out)
            finally:
                if mask is not None:
                    mask.close()
            full = image.shape
        partial.rename(path)
    finally:
        partial.unlink(missing_ok=True)
    read, valid, clear = counts
    shape = window.height, window.width
    return CopiedWindow(shape, full, read, valid / max(read, 1), clear / max(valid, 1))


def copy_heights(place: FilePlace, area: shapely.Geometry, path: Path) -> int:
    """Copy the part of a file of heights that shows an area; the number of pixels read.

    Raises:
        CoverageError: the file does not show the area.
        FormatError: it cannot be read.
    """
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with rasterio.Env(**GDAL_OPTIONS), open_dataset(place) as image:
            window = _window(image, _in_pixels(image, area, place), place)
            profile = _profile(image, window) | {
                "dtype": image.dtypes[0],
                "nodata": image.nodata,
                "predictor": 3 if image.dtypes[0].startswith("float") else 2,
            }
            with rasterio.open(partial, "w", **profile) as out:
                for piece in _pieces(window):
                    with as_format_error(place, "readable heights"):
                        values = image.read(1, window=piece)
                    out.write(values, 1, window=_relative(piece, window))
        partial.rename(path)
    finally:
        partial.unlink(missing_ok=True)
    return int(window.height * window.width)


def _in_pixels(image: Any, area: shapely.Geometry, place: FilePlace) -> shapely.Geometry:
    """An area on the ground in columns and rows of an image."""
    if image.crs is None or image.transform.is_identity:
        raise FormatError(f"{place}: no map found, an ortho-image on a map expected")
    crs, to_pixels = image.crs.to_wkt(), ~image.transform

    def column_row(lon_lat: Array) -> Array:
        return np.column_stack(to_pixels @ continuous_xy(crs, lon_lat).T)

    return shapely.transform(shapely.segmentize(area, _EDGE_DEG), column_row)


def _window(image: Any, area: shapely.Geometry, place: FilePlace) -> Any:
    """The pixels of an image that an area in its columns and rows reaches."""
    left, top, right, bottom = area.bounds
    first = max(0, math.floor(top + _ROUNDING_PX)), max(0, math.floor(left + _ROUNDING_PX))
    last = (
        min(image.height, math.ceil(bottom - _ROUNDING_PX)),
        min(image.width, math.ceil(right - _ROUNDING_PX)),
    )
    if last[0] <= first[0] or last[1] <= first[1]:
        raise CoverageError(f"{place}: does not show the area; expected an image of it")
    return RasterWindow(first[1], first[0], last[1] - first[1], last[0] - first[0])


def _profile(image: Any, window: Any) -> dict[str, Any]:
    return {
        "driver": "GTiff",
        "width": window.width,
        "height": window.height,
        "count": 1,
        "dtype": "uint16",
        "nodata": 0,
        "crs": image.crs,
        "transform": rasterio.windows.transform(window, image.transform),
        "tiled": True,
        "blockxsize": _TILE,
        "blockysize": _TILE,
        "compress": "DEFLATE",
        "predictor": 2,
        "zlevel": 1,
    }


def _copy(
    source: WindowSource, files: tuple[Any, Any], window: Any, area: shapely.Geometry, out: Any
) -> tuple[int, int, int]:
    """Copy piece by piece; numbers of pixels, of those with data, and of those not hidden."""
    total = valid = clear = 0
    image, mask = files
    for piece in _pieces(window):
        last = piece.col_off + piece.width, piece.row_off + piece.height
        if not shapely.intersects(area, shapely.box(piece.col_off, piece.row_off, *last)):
            continue
        with as_format_error(source.image, "readable pixels"):
            pixels = source.stored(image.read(1, window=piece))
        total, valid = total + pixels.size, valid + int((pixels > 0).sum())
        if mask is not None:
            pixels[source.hidden(_mask_values(mask, image, piece, source.mask))] = 0
        clear += int((pixels > 0).sum())
        out.write(pixels, 1, window=_relative(piece, window))
    return total, valid, clear


def _mask_values(mask: Any, image: Any, piece: Any, place: FilePlace | None) -> Any:
    """The value of a mask at each pixel of a piece of its image."""
    if mask.crs != image.crs:
        raise FormatError(f"{place}: {mask.crs} found, the map of its image, {image.crs}, expected")
    to_mask = ~mask.transform @ image.transform
    column = to_mask.a * (piece.col_off + np.arange(piece.width) + 0.5) + to_mask.c
    row = to_mask.e * (piece.row_off + np.arange(piece.height) + 0.5) + to_mask.f
    column = np.clip(np.floor(column), 0, mask.width - 1).astype(np.int64)
    row = np.clip(np.floor(row), 0, mask.height - 1).astype(np.int64)
    needed = RasterWindow(column[0], row[0], column[-1] - column[0] + 1, row[-1] - row[0] + 1)
    with as_format_error(place or Path(), "a readable mask"):
        values = mask.read(1, window=needed)
    return values[np.ix_(row - row[0], column - column[0])]


def _pieces(window: Any) -> Iterator[Any]:
    """A window in pieces whose borders are those of tiles of the image."""
    for top in range(window.row_off // _PIECE * _PIECE, window.row_off + window.height, _PIECE):
        for left in range(window.col_off // _PIECE * _PIECE, window.col_off + window.width, _PIECE):
            first = max(top, window.row_off), max(left, window.col_off)
            last = (
                min(top + _PIECE, window.row_off + window.height),
                min(left + _PIECE, window.col_off + window.width),
            )
            yield RasterWindow(first[1], first[0], last[1] - first[1], last[0] - first[0])


def _relative(piece: Any, window: Any) -> Any:
    return RasterWindow(
        piece.col_off - window.col_off, piece.row_off - window.row_off, piece.width, piece.height
    )
