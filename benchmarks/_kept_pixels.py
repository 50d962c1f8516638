"""Pixels of simulated scenes, kept so that a campaign that is run again does not render them again."""

import hashlib
from collections import OrderedDict
from functools import cache
from pathlib import Path

import numpy as np

from amers.services.simulation.tiles import TILE_PX, Tiles

_ROOT = Path(__file__).parent.parent
_DRAWN = ("scenes", "distorted_trials", "distortions", "trials", "worlds")


@cache
def _drawing() -> str:
    """A short hash of the sources that draw pixels."""
    digest = hashlib.sha256()
    drawn = [_ROOT / "benchmarks" / f"_{part}.py" for part in _DRAWN]
    for path in sorted((_ROOT / "services" / "simulation").rglob("*.py")) + drawn:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


def pixels_file(folder: Path, name: str) -> Path:
    """The file of the pixels of a scene, as the sources draw it."""
    return folder / f"pixels_{name}_{_drawing()}.npz"


def read_tiles(file: Path) -> Tiles:
    """The tiles of a scene that an earlier run rendered; none where there is no file."""
    tiles: Tiles = OrderedDict()
    if not file.exists():
        return tiles
    with np.load(file) as kept:
        pixels, known = kept["pixels"], kept["known"]
    for row, column in np.argwhere(known).tolist():
        tiles[row, column] = pixels[_of_tile(row, column)].copy()
    return tiles


def keep_tiles(tiles: Tiles, shape: tuple[int, int], file: Path) -> None:
    """Keep the tiles of a scene of lines and samples in a file."""
    pixels = np.zeros(shape, dtype=np.uint16)
    known = np.zeros([-(-size // TILE_PX) for size in shape], dtype=bool)
    for (row, column), tile in tiles.items():
        pixels[_of_tile(row, column)] = tile
        known[row, column] = True
    part = file.with_suffix(".part.npz")
    np.savez(part, pixels=pixels, known=known)
    part.replace(file)


def _of_tile(row: int, column: int) -> tuple[slice, slice]:
    starts = row * TILE_PX, column * TILE_PX
    return slice(starts[0], starts[0] + TILE_PX), slice(starts[1], starts[1] + TILE_PX)
