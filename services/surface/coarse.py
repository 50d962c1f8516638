"""Search with coarse pixels: the pairs that agree, and the height range of the surface."""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from amers.services.errors import CoverageError
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.surface.match import DenseMatcher, Reason
from amers.services.surface.options import SurfaceOptions
from amers.services.surface.pair_surface import cells_of_pair, match_pair
from amers.services.surface.pairs import Pair, pairs_over
from amers.services.surface.tiles import LARGEST_TILE, MARGIN_CELLS, coarser, part_of_grid, windows_of
from amers.services.tasks import Arrays, Work
from amers.services.types import Array, BoolArray, FloatImage, IntArray, Progress

COARSE = 4
"""Pixels of the images for each pixel of this search."""
AGREES_CELLS = 3.0
"""Distance of a height of a pair from the median of all up to which it agrees, cells of the surface: 1 m
for images of 0.35 m, which tells good pairs from those of other seasons in one town."""
_REACH_CELLS = 1.5
_BELOW_M, _ABOVE_M = 10.0, 30.0
"""Heights below and above those found that are looked for later: coarse pixels do not show towers."""
_FEWEST = 4
_MOST_CELLS = 1_000_000
"""Cells of a pair that tell its offset: all of images of 4,000 x 4,000 pixels, a part of larger ones, so
that memory does not grow with them."""
_AROUND_CELLS = 8
"""Cells around a window of the surface that this search looks at."""
TRIED = 3
"""Pairs that are tried with coarse pixels, for each one that is used."""


@dataclass(frozen=True)
class CoarseHeights:
    """What the search with coarse pixels found; it is read part by part.

    Attributes:
        grid: of its cells.
        windows: parts of the grid.
        looks: numbers of the pairs that were matched on each part.
        pairs: numbers of those that count; arrays with a row for each have this order.
        kept: heights and where they were looked for, by the name of part and pair.
    """

    grid: MapGrid
    windows: Sequence[Window]
    looks: Sequence[tuple[int, ...]]
    pairs: tuple[int, ...]
    kept: Mapping[str, Arrays]

    def of(self, pairs: Sequence[int]) -> "CoarseHeights":
        """The same of some pairs."""
        return replace(self, pairs=tuple(self.pairs[number] for number in pairs))

    @property
    def is_empty(self) -> bool:
        """Whether no pair has a height anywhere."""
        return not any(
            np.isfinite(heights).any()
            for row in range(len(self.windows))
            for _, heights, _ in self._found(row)
        )

    @cached_property
    def offset_m(self) -> Array:
        """Height (p,) by which each pair lies above the median of all; NaN for a pair without any."""
        step = math.ceil(math.sqrt(math.prod(self.grid.shape) / _MOST_CELLS))
        off_m: list[list[FloatImage]] = [[] for _ in self.pairs]
        for row in range(len(self.windows)):
            found = [(number, heights[::step, ::step]) for number, heights, _ in self._found(row)]
            middle = _middle([heights for _, heights in found])
            for number, heights in found:
                off = heights - middle
                off_m[number].append(off[np.isfinite(off)])
        known = [np.concatenate(parts) if parts else np.empty(0) for parts in off_m]
        return np.array([np.median(values) if len(values) else np.nan for values in known])

    def agreement(self, within_m: Array) -> Array:
        """Share (p,) of the cells where each pair was matched in which it agrees with the median of all.

        Cells that no pair has do not count.

        Args:
            within_m: (p,) distance up to which each pair agrees.
        """
        agree, seen = np.zeros(len(self.pairs)), np.zeros(len(self.pairs))
        for row in range(len(self.windows)):
            found = list(self._found(row))
            middle = _middle([heights for _, heights, _ in found])
            for number, heights, looked_at in found:
                off_m = np.abs(heights - self.offset_m[number] - middle)
                seen[number] += (looked_at & np.isfinite(middle)).sum()
                agree[number] += (off_m < within_m[number]).sum()
        return agree / np.maximum(seen, 1)

    def around(self, tile: MapGrid) -> tuple[float, float] | None:
        """Heights to look for on a tile of the surface; None where none was found on or next to it."""
        corners = np.array([[-0.5, -0.5], np.array(tile.shape) - 0.5])
        at = self.grid.line_sample_of_xy(tile.xy(corners))
        first = np.floor(at.min(axis=0)).astype(int) - 4
        last = np.ceil(at.max(axis=0)).astype(int) + 5
        begin, end = self._bounds
        known = [np.empty(0, dtype=np.float32)]
        for row in np.flatnonzero((begin < last).all(axis=1) & (end > first).all(axis=1)):
            inner = np.maximum(first - begin[row], 0), last - begin[row]
            place = np.s_[inner[0][0] : inner[1][0], inner[0][1] : inner[1][1]]
            for _, heights, _ in self._found(int(row)):
                part = heights[place]
                known.append(part[np.isfinite(part)])
        values = np.concatenate(known)
        if len(values) < _FEWEST:
            return None
        # One height in two hundred may be wrong on either side.
        low, high = np.quantile(values, [0.005, 0.995])
        return float(low) - _BELOW_M, float(high) + _ABOVE_M

    @cached_property
    def _bounds(self) -> tuple[IntArray, IntArray]:
        """First line and sample (n, 2) of every part, and those after its last ones."""
        begin = np.array([(w.line, w.sample) for w in self.windows])
        return begin, begin + np.array([(w.lines, w.samples) for w in self.windows])

    def _found(self, row: int) -> Iterator[tuple[int, FloatImage, BoolArray]]:
        """Place of each pair in `pairs`, heights (lines, samples) on a part, where it was matched."""
        for number, pair in enumerate(self.pairs):
            if pair in self.looks[row]:
                arrays = self.kept[_name(self.windows[row], pair)]
                if arrays:
                    yield number, arrays["heights"], arrays["looked_at"]


def _middle(heights: Sequence[FloatImage]) -> FloatImage:
    """Median (lines, samples) of the heights of some pairs; NaN where none has one."""
    if not heights:
        return np.empty((0, 0), dtype=np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # cells that no pair shows
        return np.asarray(np.nanmedian(np.stack(heights), axis=0))


@dataclass(frozen=True)
class CoarseSearch:
    """The search of the heights of some pairs.

    Attributes:
        scenes: of the pairs.
        pairs: of them.
        heights_m: lowest and highest surface.
        options: of the surface.
    """

    scenes: Sequence[Scene]
    pairs: Sequence[Pair]
    heights_m: tuple[float, float]
    options: SurfaceOptions

    def over(
        self, grid: MapGrid, windows: Sequence[Window] | None, work: Work, progress: Progress
    ) -> CoarseHeights:
        """The heights of all pairs over the grid of a surface, or over windows of it.

        Raises:
            CoverageError: nothing of it was matched.
        """
        coarse = coarser(grid, COARSE)
        if windows is None:
            windows = windows_of(coarse.shape, LARGEST_TILE // 2)
        else:
            windows = [_coarse(window, coarse.shape) for window in windows]
        of_windows = pairs_over(self.pairs, coarse, windows, TRIED * self.options.pairs)
        tasks = [
            (_name(window, number), partial(self._arguments, coarse, window, self.pairs[number]))
            for window, numbers in zip(windows, of_windows, strict=True)
            for number in numbers
        ]
        work.run(look_task, tasks, progress)
        found = CoarseHeights(coarse, windows, of_windows, tuple(range(len(self.pairs))), work.kept)
        if found.is_empty:
            low_m, high_m = self.heights_m
            raise CoverageError(
                "no pair of scenes was matched anywhere: check that the scenes show the same ground "
                f"between {low_m:.0f} and {high_m:.0f} m, and that their models agree (register them "
                "first)"
            )
        return found

    def _arguments(self, coarse: MapGrid, window: Window, pair: Pair) -> tuple[Any, ...]:
        matcher = self.options.matcher
        small = replace(matcher, smallest_patch_px=matcher.smallest_patch_px // COARSE)
        scenes = self.scenes[pair.first], self.scenes[pair.second]
        return scenes, part_of_grid(coarse, window, 0), self.heights_m, small


def look_task(
    scenes: tuple[Scene, Scene], cells: MapGrid, heights_m: tuple[float, float], matcher: DenseMatcher
) -> Arrays:
    """Heights (lines, samples) of a pair in some cells, and where it was matched; none without both."""
    around = part_of_grid(cells, Window(0, 0, *cells.shape), MARGIN_CELLS // 2)
    found = match_pair(scenes, around, heights_m, float(COARSE), matcher)
    if found is None:
        return {}
    heights, why = cells_of_pair(found, cells, np.zeros(3), _REACH_CELLS)
    return {"heights": heights, "looked_at": why != Reason.OUTSIDE}


def _coarse(window: Window, shape: tuple[int, int]) -> Window:
    """The window of the grid of this search around one of the surface."""
    first = [max(n // COARSE - _AROUND_CELLS, 0) for n in (window.line, window.sample)]
    ends = (window.line + window.lines, window.sample + window.samples)
    last = [min(-(-n // COARSE) + _AROUND_CELLS, most) for n, most in zip(ends, shape, strict=True)]
    return Window(first[0], first[1], last[0] - first[0], last[1] - first[1])


def _name(window: Window, number: int) -> str:
    place = f"{window.line:06d}-{window.sample:06d}-{window.lines}-{window.samples}"
    return f"coarse/{place}-{number:03d}"
