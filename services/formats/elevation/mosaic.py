"""Many files of heights as one terrain, read by windows; few of them are open at a time."""

from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from amers.services.datums import DatumShift
from amers.services.errors import FormatError, VerticalDatumError
from amers.services.formats.elevation.heights import HeightDatum, HeightsByCaller
from amers.services.formats.elevation.tiles import Heights, HeightTile, Sigmas, read_tile
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.statements import Statements
from amers.services.terrain import Terrain
from amers.services.types import FloatImage, IntArray

MOST_OPEN = 32
"""Tiles that are open at a time."""
_SAME_PX = 0.01
"""Tiles with nodes this near to the nodes of the common grid are copied, others are interpolated."""
_BORDER = 17
"""Positions along a side of a tile whose place in the common grid is computed."""


@dataclass(frozen=True)
class _Place:
    """Where a tile lies in the common grid.

    Attributes:
        path: of the file.
        grid: its own.
        is_aligned: whether its nodes are nodes of the common grid; else it is interpolated.
        low, high: (2,) first and last node of the common grid that it can reach.
    """

    path: Path
    grid: MapGrid
    is_aligned: bool
    low: tuple[int, int]
    high: tuple[int, int]


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
    places: tuple[_Place, ...]
    caller: HeightsByCaller
    has_sigmas: bool = False
    _open: OrderedDict[Path, Heights | Sigmas] = field(
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

    def _of_tile(self, place: _Place, low: IntArray, high: IntArray) -> FloatImage:
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

    def _values(self, path: Path) -> Heights | Sigmas:
        if path in self._open:
            self._open.move_to_end(path)
        else:
            tile = read_tile(path, self.caller)
            self._open[path] = tile.sigmas if self.has_sigmas and tile.sigmas else tile.heights
            while len(self._open) > MOST_OPEN:
                self._open.popitem(last=False)[1].close()
        return self._open[path]


def mosaic_of(
    path: Path, files: list[Path], caller: HeightsByCaller
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
    tiles: dict[Path, HeightTile] = {}
    known: dict[tuple[str, str], tuple[DatumShift, HeightDatum]] = {}
    for file in files:
        tiles[file] = read_tile(file, caller, known=known)
        tiles[file].heights.close()
    _check_alike(path, tiles)
    finest = min(tiles.values(), key=lambda tile: tile.grid.gsd_m)
    if not all(tile.sigmas for tile in tiles.values()):
        finest = replace(finest, sigmas=None)
    lattice = finest.grid
    reaches = [_reach(lattice, tile.grid) for tile in tiles.values()]
    low = np.min([first for first, _ in reaches], axis=0)
    high = np.max([last for _, last in reaches], axis=0)
    shape = (int(high[0] - low[0] + 1), int(high[1] - low[1] + 1))
    grid = replace(lattice, origin_xy=lattice.xy(low[None, :].astype(np.float64))[0], shape=shape)
    places = tuple(
        _Place(file, tile.grid, _is_aligned(lattice, tile.grid), _node(first - low), _node(last - low))
        for (file, tile), (first, last) in zip(tiles.items(), reaches, strict=True)
    )
    statements = tuple(statement for tile in tiles.values() for statement in tile.statements)
    return finest, grid, Mosaic(shape, grid, places, caller), statements


def _check_alike(path: Path, tiles: dict[Path, HeightTile]) -> None:
    """Refuse tiles above different datums, and two tiles of the same ground."""
    (one, first), *others = tiles.items()
    for file, tile in others:
        if tile.datum.origin != first.datum.origin:
            raise VerticalDatumError(
                f"{path}: {one.name} has {first.datum.origin}, {file.name} {tile.datum.origin}: one "
                "vertical datum expected; keep the files of one datum together"
            )
    seen: dict[tuple[object, ...], Path] = {}
    for file, tile in tiles.items():
        grid = tile.grid
        key = (grid.crs, grid.shape, *(round(float(value), 9) for value in grid.origin_xy))
        if key in seen:
            raise FormatError(
                f"{path}: {seen[key].name} and {file.name} cover the same ground; only files of heights "
                "expected: keep others, such as qualities and masks, apart"
            )
        seen[key] = file


def _is_aligned(lattice: MapGrid, own: MapGrid) -> bool:
    """Whether the nodes of a tile are nodes of the lattice."""
    if own.crs != lattice.crs:
        return False
    at = lattice.line_sample_of_xy(own.origin_xy[None, :])[0]
    stretch = np.linalg.inv(lattice.step_xy) @ own.step_xy - np.eye(2)
    off_px = np.abs(stretch) @ np.array(own.shape) + np.abs(at - np.rint(at))
    return bool((off_px < _SAME_PX).all())


def _reach(lattice: MapGrid, own: MapGrid) -> tuple[IntArray, IntArray]:
    """First and last node (2,) of the lattice that a tile can reach, half a step beyond its nodes."""
    if _is_aligned(lattice, own):
        first = np.rint(lattice.line_sample_of_xy(own.origin_xy[None, :])[0]).astype(np.int64)
        return first, first + np.array(own.shape) - 1
    axes = [np.linspace(-0.5, size - 0.5, _BORDER) for size in own.shape]
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    at = lattice.line_sample(own.lon_lat(positions))
    at = at[np.isfinite(at).all(axis=1)]
    return np.floor(at.min(axis=0)).astype(np.int64), np.ceil(at.max(axis=0)).astype(np.int64)


def _node(position: IntArray) -> tuple[int, int]:
    return int(position[0]), int(position[1])
