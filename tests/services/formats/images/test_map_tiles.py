"""Tiles on the map in one file, each found by its position."""

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from amers.services.errors import FormatError
from amers.services.formats.images.map_tiles import read_map_tile, tile_media_type, write_map_tiles
from amers.services.imagery.source import Window
from amers.services.orthorectification.rectify import OrthoWindow
from amers.services.orthorectification.tile_limits import TILE_PX, TileLimits, TilePlace
from amers.services.types import FloatImage

FINEST = TileLimits(10, first_row=301, last_row=305, first_column=511, last_column=513)
LEVELS = [FINEST, FINEST.coarser(), FINEST.coarser().coarser()]


def windows(pixels: FloatImage) -> Iterator[OrthoWindow]:
    """The tiles of an image, row by row."""
    for line in range(0, pixels.shape[0], TILE_PX):
        for sample in range(0, pixels.shape[1], TILE_PX):
            part = pixels[None, line : line + TILE_PX, sample : sample + TILE_PX]
            yield OrthoWindow(Window(line, sample, TILE_PX, TILE_PX), part, 0.0)


def reader(path: Path) -> Callable[[int, int], bytes]:
    content = path.read_bytes()
    return lambda start, length: content[start : start + length]


@pytest.fixture
def tiles(tmp_path: Path) -> Path:
    """A ramp to the east, without data in the first tile and a half."""
    shape = (TILE_PX * FINEST.rows, TILE_PX * FINEST.columns)
    pixels = np.broadcast_to(np.linspace(0.0, 1.0, shape[1], dtype=np.float32), shape).copy()
    pixels[:, : TILE_PX * 3 // 2] = np.nan
    write_map_tiles(tmp_path / "a.tiles", LEVELS, windows(pixels), (0.0, 1.0))
    return tmp_path / "a.tiles"


def decoded(tile: bytes | None) -> np.ndarray:
    assert tile is not None
    return np.asarray(cv2.imdecode(np.frombuffer(tile, np.uint8), cv2.IMREAD_UNCHANGED))


def test_tiles_are_grey_inside_and_transparent_outside_of_the_scene(tiles: Path) -> None:
    empty, half, whole = (
        read_map_tile(reader(tiles), LEVELS, TilePlace(10, 303, column)) for column in (511, 512, 513)
    )
    assert decoded(empty)[:, :, 3].max() == 0
    assert tile_media_type(half or b"") == "image/png"
    alpha = decoded(half)[:, :, 3]
    assert (alpha[:, : TILE_PX // 2].max(), alpha[:, TILE_PX // 2 :].min()) == (0, 255)
    assert tile_media_type(whole or b"") == "image/jpeg"
    np.testing.assert_allclose(decoded(whole).mean(axis=0), np.linspace(170, 255, TILE_PX), atol=3)


def test_coarser_tiles_lie_where_their_four_finer_ones_do(tiles: Path) -> None:
    for row in range(150, 153):
        below = decoded(read_map_tile(reader(tiles), LEVELS, TilePlace(9, row, 256)))
        half = TILE_PX // 2
        if row == 150:
            assert below[:half, :, 3].max() == 0, "above the first row of the finer ones"
            below = below[half:]
        grey = below[:, :, 0] if below.ndim == 3 else below
        np.testing.assert_allclose(grey[:, half:].mean(axis=0), np.linspace(170, 255, half), atol=3)
    corner = decoded(read_map_tile(reader(tiles), LEVELS, TilePlace(8, 75, 127)))
    assert corner[:, :, 3].max() == 0


def test_there_is_no_tile_outside_of_the_limits(tiles: Path) -> None:
    for place in (
        (10, 300, 512),
        (10, 303, 510),
        (10, 303, 514),
        (7, 37, 64),
        (11, 303, 512),
        (10, -1, -1),
    ):
        assert read_map_tile(reader(tiles), LEVELS, TilePlace(*place)) is None


def test_a_damaged_file_is_named_and_no_large_piece_of_it_is_read(tiles: Path) -> None:
    content, place = bytearray(tiles.read_bytes()), TilePlace(10, 301, 513)
    content[2 * 12 + 8 : 3 * 12] = b"\xff\xff\xff\xff"
    lengths = []

    def read(start: int, length: int) -> bytes:
        lengths.append(length)
        return bytes(content[start : start + length])

    with pytest.raises(FormatError, match="of one expected"):
        read_map_tile(read, LEVELS, place)
    assert max(lengths) < 1_000_000
    with pytest.raises(FormatError, match="no record"):
        read_map_tile(lambda start, length: b"", LEVELS, place)
