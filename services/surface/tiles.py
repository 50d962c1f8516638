"""The grid of a surface and its tiles, each small enough for the memory of a process."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid, utm_of, xy_of_lon_lat
from amers.services.surface.options import SurfaceOptions
from amers.services.surface.pairs import Pair

TILE_BYTES = 600_000_000
"""Memory of the costs of a tile: with images and results, a process stays below 1 GB."""
LARGEST_TILE = 1024
_SMALLEST_TILE = 128
MARGIN_CELLS = 24
"""Cells around a tile that are matched too, so that paths do not begin at its border."""

HeightsAround = Callable[[MapGrid], tuple[float, float] | None]
"""Lowest and highest surface of a part of the grid; None where nothing was found."""


@dataclass(frozen=True)
class Tile:
    """A part of the grid.

    Attributes:
        window: of the grid.
        heights_m: that are looked for there; None where nothing was found around it.
        pairs: numbers of those that it is made of, ascending.
    """

    window: Window
    heights_m: tuple[float, float] | None
    pairs: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """Names the tile among those of its grid."""
        w = self.window
        return f"{w.line:06d}-{w.sample:06d}-{w.lines}-{w.samples}"


def grid_over(scenes: Sequence[Scene], pairs: Sequence[Pair], gsd_m: float | None) -> MapGrid:
    """The north-up grid over what the pairs show, in the UTM zone of its middle.

    Args:
        scenes: of the pairs.
        pairs: of them.
        gsd_m: side of a cell; None takes the ground sampling of the finest image in two digits.
    """
    finest_m = min(scene_gsd_m(scenes[pair.first]) for pair in pairs)
    side_m = gsd_m or float(f"{finest_m:.2g}")
    outline = np.concatenate([pair.overlap for pair in pairs])
    lon, lat = outline.mean(axis=0)
    crs = utm_of((lon + 180.0) % 360.0 - 180.0, lat)
    xy = xy_of_lon_lat(crs, outline)
    first, last = np.floor(xy.min(axis=0) / side_m), np.ceil(xy.max(axis=0) / side_m)
    samples, lines = (int(n) for n in last - first)
    origin = np.array([first[0] + 0.5, last[1] - 0.5]) * side_m
    return MapGrid(crs, origin, np.array([[0.0, side_m], [-side_m, 0.0]]), (lines, samples))


def part_of_grid(grid: MapGrid, window: Window, margin: int) -> MapGrid:
    """A window of a grid with cells around it, as a grid of its own."""
    first = np.array([window.line, window.sample], dtype=np.float64) - margin
    shape = (window.lines + 2 * margin, window.samples + 2 * margin)
    return MapGrid(grid.crs, grid.xy(first[None, :])[0], grid.step_xy, shape)


def coarser(grid: MapGrid, times: int) -> MapGrid:
    """The grid over the same ground whose cells are some times as long and as wide."""
    origin = grid.xy(np.full((1, 2), (times - 1) / 2.0))[0]
    shape = tuple(math.ceil(n / times) for n in grid.shape)
    return MapGrid(grid.crs, origin, grid.step_xy * times, (shape[0], shape[1]))


def windows_of(shape: tuple[int, int], side: int) -> list[Window]:
    """Windows of a grid of about equal sizes, at most `side` cells wide and high."""
    parts = [np.linspace(0, n, math.ceil(n / side) + 1).round().astype(int).tolist() for n in shape]
    return [
        Window(top, left, bottom - top, right - left)
        for top, bottom in pairwise(parts[0])
        for left, right in pairwise(parts[1])
    ]


def largest_volume(
    grid: MapGrid, scenes: Sequence[Scene], pairs: Sequence[Pair], options: SurfaceOptions
) -> float:
    """Squared cells times metres of height of the largest tile whose costs fit into the memory.

    Args:
        grid: of the surface.
        scenes: of the pairs.
        pairs: that the surface is made of.
        options: of the surface.
    """
    gsds_m = [scene_gsd_m(scenes[pair.first]) for pair in pairs]
    px_per_m = max(pair.base_to_height / gsd_m for pair, gsd_m in zip(pairs, gsds_m, strict=True))
    cell_px = float(grid.step_xy[0, 1]) / min(gsds_m)
    # Rows lie askew to the map: the square around a turned square is twice as large.
    return TILE_BYTES / options.matcher.bytes_per_disparity() / (2.0 * cell_px**2 * px_per_m)


def tiles_of(grid: MapGrid, window: Window, around: HeightsAround, volume: float) -> Iterator[Tile]:
    """Tiles of a window of the grid.

    Args:
        grid: of the surface.
        window: of it.
        around: what is known of the heights.
        volume: of the largest tile; see `largest_volume`.
    """
    waiting = [window]
    while waiting:
        part = waiting.pop(0)
        heights_m = around(part_of_grid(grid, part, MARGIN_CELLS))
        heights_m = heights_m or around(part_of_grid(grid, part, 4 * LARGEST_TILE))
        if heights_m is None:
            yield Tile(part, None)
            continue
        side = max(part.lines, part.samples)
        squares = float(side + 2 * MARGIN_CELLS) ** 2
        if squares * (heights_m[1] - heights_m[0]) <= volume or side <= _SMALLEST_TILE:
            yield Tile(part, heights_m)
            continue
        inner = windows_of((part.lines, part.samples), math.ceil(side / 2))
        waiting[:0] = [replace(w, line=w.line + part.line, sample=w.sample + part.sample) for w in inner]
