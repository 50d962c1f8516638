"""Map tiles of a scene in one file, in which each tile is read by its position.

The file begins with a record for every tile of every zoom, the finest first, row by row: its position in
the file (8 bytes) and its size (4 bytes), least significant byte first. The tiles follow. One that the
scene covers is a JPEG of grey values; at the border it is a PNG that is transparent outside the scene.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
import numpy.typing as npt

from amers.services.errors import CoverageError, FormatError
from amers.services.formats.images.tiles import grey_values
from amers.services.imagery.source import ImageSource, sample_image
from amers.services.map_grid import MapGrid
from amers.services.orthorectification.rectify import OrthoWindow
from amers.services.orthorectification.tile_limits import TILE_PX, TileLimits, TilePlace

_QUALITY = 85
_RECORD = np.dtype([("position", "<u8"), ("size", "<u4")])
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG"
_LARGEST_TILE_BYTES = 8 * TILE_PX**2
"""More than any tile has, whatever it shows."""

MOST_REDUCED = 8
"""Largest ratio of the pixels of a tile that is drawn on demand to those of its image, of which
2048 x 2048 are then read."""

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class _Row:
    """A row of tiles, or half of one.

    Attributes:
        grey: (lines, samples) values.
        valid: (lines, samples) 1 where the scene has data, else 0.
    """

    grey: Bytes
    valid: Bytes


def write_map_tiles(
    path: Path,
    levels: Sequence[TileLimits],
    windows: Iterable[OrthoWindow],
    grey_range: tuple[float, float],
) -> None:
    """Write the tiles of a scene on the map; two rows of tiles of each zoom are in memory at most.

    Args:
        path: of the file.
        levels: from the finest zoom to the coarsest.
        windows: the tiles of the finest zoom, row by row.
        grey_range: values that become black and white.
    """
    with path.open("wb") as file:
        pyramid = _Pyramid(file, levels)
        finest = levels[0]
        tiles: list[OrthoWindow] = []
        for window in windows:
            tiles.append(window)
            if len(tiles) == finest.columns:
                pixels = np.concatenate([tile.pixels[0] for tile in tiles], axis=1)
                valid = (~np.isnan(pixels)).astype(np.uint8)
                row = finest.first_row + tiles[0].window.line // TILE_PX
                pyramid.add(0, row, _Row(grey_values(pixels, *grey_range), valid))
                tiles.clear()
        pyramid.finish()


def read_map_tile(
    read: Callable[[int, int], bytes], levels: Sequence[TileLimits], place: TilePlace
) -> bytes | None:
    """The tile at a place of the tile matrix set; None outside the limits of the scene.

    Args:
        read: bytes of the file by position and length.
        levels: that the file was written with.
        place: of the tile.

    Raises:
        FormatError: the file has no tile where its record says.
    """
    first = 0
    for level in levels:
        index = level.index(place)
        if index is not None:
            record = read((first + index) * _RECORD.itemsize, _RECORD.itemsize)
            if len(record) != _RECORD.itemsize:
                raise FormatError(f"no record of tile {index} of zoom {place.zoom} found")
            position, size = np.frombuffer(record, _RECORD)[0].tolist()
            tile = read(position, size) if size <= _LARGEST_TILE_BYTES else b""
            if len(tile) != size or not tile.startswith((_JPEG, _PNG)):
                raise FormatError(f"no tile found at byte {position}, {size} bytes of one expected")
            return tile
        first += level.rows * level.columns
    return None


def draw_map_tile(
    image: ImageSource, grid: MapGrid, place: TilePlace, grey_range: tuple[float, float]
) -> bytes:
    """A tile of an ortho-image, from its pixels: JPEG, or PNG that is transparent beyond the image.

    Args:
        image: of the map grid; only its window under the tile is read.
        grid: of its pixels.
        place: of the tile; its pixels are at most `MOST_REDUCED` times larger than those of the image.
        grey_range: values that become black and white.

    Raises:
        CoverageError: the pixels of the tile are larger.
    """
    of_tile = TileLimits(place.zoom, place.row, place.row, place.column, place.column).grid()
    ratio = of_tile.gsd_m / grid.gsd_m
    if ratio > MOST_REDUCED:
        raise CoverageError(
            f"zoom {place.zoom}: pixels {ratio:.0f} times larger than those of the image, at most "
            f"{MOST_REDUCED} expected"
        )
    places = np.indices(of_tile.shape).reshape(2, -1).T.astype(np.float64)
    line_sample = grid.line_sample(of_tile.lon_lat(places)).reshape(*of_tile.shape, 2)
    pixels = sample_image(image, line_sample, ratio)
    return _encoded(grey_values(pixels, *grey_range), (~np.isnan(pixels)).astype(np.uint8))


def tile_media_type(tile: bytes) -> str:
    """The media type of a tile."""
    return "image/jpeg" if tile.startswith(_JPEG) else "image/png"


class _Pyramid:
    """Tiles of all zooms on their way into a file."""

    def __init__(self, file: BinaryIO, levels: Sequence[TileLimits]) -> None:
        self._file = file
        self._levels = levels
        self._records = [np.zeros(level.rows * level.columns, _RECORD) for level in levels]
        self._upper_half: list[_Row | None] = [None for _ in levels]
        file.seek(sum(records.nbytes for records in self._records))
        self._empty = self._append(_encoded(*np.zeros((2, TILE_PX, TILE_PX), dtype=np.uint8)))

    def add(self, level: int, row: int, tiles: _Row) -> None:
        """Write the next row of tiles of a level, and those of coarser levels that it completes."""
        self._write(level, row, tiles)
        if level + 1 == len(self._levels):
            return
        below = self._levels[level + 1]
        half = _halved(tiles, self._levels[level].first_column % 2, below.columns)
        if row % 2 == 0:
            self._upper_half[level] = half
            if row < self._levels[level].last_row:
                return
            upper, lower = half, _nothing(half)
        else:
            upper, lower = self._upper_half[level] or _nothing(half), half
        self._upper_half[level] = None
        whole = _Row(
            *(np.concatenate(pair) for pair in ((upper.grey, lower.grey), (upper.valid, lower.valid)))
        )
        self.add(level + 1, row // 2, whole)

    def finish(self) -> None:
        """Write the records to the start of the file."""
        self._file.seek(0)
        for records in self._records:
            self._file.write(records.tobytes())

    def _write(self, level: int, row: int, tiles: _Row) -> None:
        limits = self._levels[level]
        first = (row - limits.first_row) * limits.columns
        for column in range(limits.columns):
            part = np.s_[:, column * TILE_PX : (column + 1) * TILE_PX]
            grey, valid = tiles.grey[part], tiles.valid[part]
            record = self._append(_encoded(grey, valid)) if valid.any() else self._empty
            self._records[level][first + column] = record

    def _append(self, content: bytes) -> tuple[int, int]:
        position = self._file.tell()
        self._file.write(content)
        return position, len(content)


def _encoded(grey: Bytes, valid: Bytes) -> bytes:
    if valid.all():
        done, encoded = cv2.imencode(
            ".jpg", np.ascontiguousarray(grey), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        )
    else:
        done, encoded = cv2.imencode(".png", np.dstack([grey, grey, grey, valid * np.uint8(255)]))
    assert done, "a tile can be a JPEG or a PNG"
    return encoded.tobytes()


def _halved(tiles: _Row, missing: int, columns: int) -> _Row:
    """Means of the valid ones of 2 x 2 pixels; valid where at least two of them are.

    Args:
        tiles: a row of tiles.
        missing: 1 if the row begins with the right half of a tile of the result.
        columns: of tiles in the result.
    """
    left = missing * TILE_PX
    right = 2 * columns * TILE_PX - left - tiles.grey.shape[1]
    valid = np.pad(tiles.valid, [(0, 0), (left, right)]).astype(np.uint16)
    grey = np.pad(tiles.grey, [(0, 0), (left, right)]) * valid
    count, total = _of_squares(valid), _of_squares(grey)
    mean = (total + count // 2) // np.maximum(count, 1)
    return _Row(mean.astype(np.uint8), (count >= 2).astype(np.uint8))


def _of_squares(values: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Sums over 2 x 2 pixels."""
    lines = values[::2] + values[1::2]
    return lines[:, ::2] + lines[:, 1::2]


def _nothing(half: _Row) -> _Row:
    return _Row(np.zeros_like(half.grey), np.zeros_like(half.valid))
