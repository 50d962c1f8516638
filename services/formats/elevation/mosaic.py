"""Many files of heights as one terrain, read by windows with few files open at a time."""

from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from amers.services.datums import DatumShift
from amers.services.errors import FormatError, VerticalDatumError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.elevation.heights import HeightDatum, HeightsByCaller
from amers.services.formats.elevation.tiles import Heights, HeightTile, Sigmas, read_tile
from amers.services.formats.images.lattices import Placed, placed_on
from amers.services.formats.pieces import Source
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.statements import Statements
from amers.services.terrain import Terrain
from amers.services.types import FloatImage, IntArray

MOST_OPEN = 32
"""Tiles that are open at a time."""


@dataclass
class Mosaic:
    """Heights of many tiles on one grid, or their standard deviations, metres; an `ImageSource`.

    Where tiles overlap, the first with a height there counts.

    Attributes:
        shape: lines and samples.
        grid: common to all tiles.
        places: of the tiles, in their order.
        caller: what the caller states of all of them.
        has_sigmas: it has the standard deviations of surfaces, in place of their heights.
    """

    shape: tuple[int, int]
    grid: MapGrid
    places: tuple[Placed, ...]
    caller: HeightsByCaller
    has_sigmas: bool = False
    _open: OrderedDict[FilePlace, Heights | Sigmas] = field(
        default_factory=OrderedDict, repr=False, compare=False
    )

    def read(self, window: Window) -> FloatImage:
        """Heights of a window; NaN where no tile has any."""
        out = np.full((window.lines, window.samples), np.nan, dtype=np.float32)
        begin = np.array([window.line, window.sample])
        end = begin + [window.lines, window.samples]
        lows, highs = self._reaches
        for number in np.flatnonzero(((lows < end) & (highs >= begin)).all(axis=1)):
            place = self.places[number]
            low, high = np.maximum(begin, place.low), np.minimum(end, highs[number] + 1)
            part = out[tuple(slice(a, b) for a, b in zip(low - begin, high - begin, strict=True))]
            missing = np.isnan(part)
            if missing.any():
                part[missing] = self._of_tile(place, low, high)[missing]
            if not np.isnan(out).any():
                break
        return out

    @cached_property
    def _reaches(self) -> tuple[IntArray, IntArray]:
        """First and last nodes (n, 2) of the tiles."""
        lows = np.array([place.low for place in self.places])
        return lows, np.array([place.high for place in self.places])

    def __getstate__(self) -> dict[str, object]:
        """Files are opened again in another process."""
        return vars(self) | {"_open": OrderedDict()}

    def _of_tile(self, place: Placed, low: IntArray, high: IntArray) -> FloatImage:
        """Heights of a tile at the nodes of the common grid from `low` to before `high`."""
        lines, samples = (int(size) for size in high - low)
        values = self._values(place.path)
        if place.is_aligned:
            line, sample = (int(node) for node in low - place.low)
            return values.read(Window(line, sample, lines, samples))
        nodes = np.indices((lines, samples)).reshape(2, -1).T + low
        # In the vertical datum of the tile, which is that of all.
        terrain = Terrain(place.grid, values)
        height_m = terrain.height_m(self.grid.lon_lat(nodes.astype(np.float64)))
        return height_m.reshape(lines, samples).astype(np.float32)

    def _values(self, path: FilePlace) -> Heights | Sigmas:
        if path in self._open:
            self._open.move_to_end(path)
        else:
            tile = read_tile(path, self.caller)
            self._open[path] = tile.sigmas if self.has_sigmas and tile.sigmas else tile.heights
            while len(self._open) > MOST_OPEN:
                self._open.popitem(last=False)[1].close()
        return self._open[path]


def mosaic_of(
    path: Source, files: list[FilePlace], caller: HeightsByCaller
) -> tuple[HeightTile, MapGrid, Mosaic, Statements]:
    """Many files of heights on the lattice of the finest of them.

    Args:
        path: of the folder or the list, for messages.
        files: of the tiles.
        caller: what the caller states of all of them.

    Returns:
        The tile whose lattice it is, with sigmas only where all tiles have them, the common grid, the
        heights, and the statements of all files.

    Raises:
        FormatError, VerticalDatumError: a file cannot be used, two files cover the same ground, or their
            vertical datums differ.
    """
    tiles: dict[FilePlace, HeightTile] = {}
    known: dict[tuple[str, str], tuple[DatumShift, HeightDatum]] = {}
    for file in files:
        tiles[file] = read_tile(file, caller, known=known)
        tiles[file].heights.close()
    _check_alike(path, tiles)
    finest = min(tiles.values(), key=lambda tile: tile.grid.gsd_m)
    if not all(tile.sigmas for tile in tiles.values()):
        finest = replace(finest, sigmas=None)
    grid, places = placed_on(finest.grid, {file: tile.grid for file, tile in tiles.items()})
    statements = tuple(statement for tile in tiles.values() for statement in tile.statements)
    return finest, grid, Mosaic(grid.shape, grid, places, caller), statements


def _check_alike(path: Source, tiles: dict[FilePlace, HeightTile]) -> None:
    """Refuse tiles above different datums, and two tiles of the same ground."""
    (one, first), *others = tiles.items()
    for file, tile in others:
        if tile.datum.origin != first.datum.origin:
            raise VerticalDatumError(
                f"{path}: {one.name} has {first.datum.origin}, {file.name} {tile.datum.origin}: one "
                "vertical datum expected; keep the files of one datum together"
            )
    seen: dict[tuple[object, ...], FilePlace] = {}
    for file, tile in tiles.items():
        grid = tile.grid
        key = (grid.crs, grid.shape, *(round(float(value), 9) for value in grid.origin_xy))
        if key in seen:
            raise FormatError(
                f"{path}: {seen[key].name} and {file.name} cover the same ground; only files of heights "
                "expected: keep others, such as qualities and masks, apart"
            )
        seen[key] = file
