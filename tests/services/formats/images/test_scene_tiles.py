"""A raw image as tiles: every level shows the image where it is."""

import json
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from amers.services.formats.images.tiles import TILE_PX, TileIndex, format_tile_index, write_tiles
from amers.services.imagery.source import ArrayImage, FloatImage

the_loss_of_jpeg = 3.0
most_places_off = 0.01


def scene(lines: int, samples: int) -> FloatImage:
    line, sample = np.indices((lines, samples))
    return (900.0 + 300.0 * np.sin(line / 60.0) * np.cos(sample / 45.0)).astype(np.float32)


def level_of(path: Path, index: TileIndex, number: int) -> npt.NDArray[np.uint8]:
    """A level put together from its tiles."""
    content, level = path.read_bytes(), index.levels[number]
    tiles = [
        cv2.imdecode(np.frombuffer(content[at : at + size], np.uint8), cv2.IMREAD_GRAYSCALE)
        for at, size in level.tiles
    ]
    columns = -(-level.samples // TILE_PX)
    rows = [np.hstack(tiles[row : row + columns]) for row in range(0, len(tiles), columns)]
    return np.vstack(rows)


@pytest.mark.parametrize("shape", [(1, 1), (300, 511), (512, 512), (513, 1025), (1400, 2301)])
@pytest.mark.long
def test_each_level_is_the_mean_of_the_one_before(tmp_path: Path, shape: tuple[int, int]) -> None:
    index = write_tiles(ArrayImage(scene(*shape)), tmp_path / "tiles.bin")
    assert (index.lines, index.samples) == shape
    assert len(index.levels[-1].tiles) == 1
    for number in range(len(index.levels)):
        shown = level_of(tmp_path / "tiles.bin", index, number).astype(float)
        assert shown.shape == (index.levels[number].lines, index.levels[number].samples)
        half = 2**number
        # The centre of a pixel of this level, in pixels of the image.
        line, sample = (half * (np.arange(size) + 0.5) - 0.5 for size in shown.shape)
        line, sample = np.minimum(line, shape[0] - 1.0), np.minimum(sample, shape[1] - 1.0)
        there = 900.0 + 300.0 * np.sin(line[:, None] / 60.0) * np.cos(sample / 45.0)
        if min(shape) > 100:
            slope, level = np.polyfit(there.ravel(), shown.ravel(), 1)
            off = np.abs(shown - (slope * there + level)) > the_loss_of_jpeg
            assert slope > 0.0
            assert off.mean() < most_places_off


def test_ground_without_data_is_black_and_saturated_pixels_are_white(tmp_path: Path) -> None:
    pixels = scene(200, 200)
    pixels[:100] = np.nan
    pixels[150:] = np.inf
    index = write_tiles(ArrayImage(pixels), tmp_path / "tiles.bin")
    shown = level_of(tmp_path / "tiles.bin", index, 0)
    assert shown[:90].max() <= the_loss_of_jpeg
    assert shown[160:].min() >= 255 - the_loss_of_jpeg
    assert level_of_nothing(tmp_path).max() == 0


def level_of_nothing(folder: Path) -> npt.NDArray[np.uint8]:
    nothing = np.full((40, 30), np.nan, dtype=np.float32)
    index = write_tiles(ArrayImage(nothing), folder / "nothing.bin")
    return level_of(folder / "nothing.bin", index, 0)


def test_the_index_is_json(tmp_path: Path) -> None:
    index = write_tiles(ArrayImage(scene(600, 700)), tmp_path / "tiles.bin")
    read = json.loads(format_tile_index(index))
    assert (read["lines"], read["samples"], read["tile_px"]) == (600, 700, TILE_PX)
    sizes = [size for level in read["levels"] for _, size in level["tiles"]]
    assert sum(sizes) == (tmp_path / "tiles.bin").stat().st_size
