"""A search with coarse pixels: which pairs agree, and between which heights the surface lies."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from amers.services.errors import CoverageError
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.surface.match import Reason
from amers.services.surface.options import SurfaceOptions
from amers.services.surface.pair_surface import cells_of_pair, match_task, pair_surface
from amers.services.surface.pairs import Pair, pairs_over
from amers.services.surface.tiles import LARGEST_TILE, MARGIN_CELLS, coarser, part_of_grid, windows_of
from amers.services.tasks import Work
from amers.services.types import Array, BoolArray, FloatImage, Progress

COARSE = 4
"""Pixels of the images for each pixel of this search."""
AGREES_CELLS = 3.0
"""Distance of a height of a pair from the median of all up to which it agrees, cells of the surface: 1 m
for images of 0.35 m, which tells good pairs from those of other seasons in one town."""
_REACH_CELLS = 1.5
_BELOW_M, _ABOVE_M = 10.0, 30.0
"""Heights below and above those found that are looked for later: coarse pixels do not show towers."""
_FEWEST = 4
_AROUND_CELLS = 8
"""Cells around a window of the surface that this search looks at."""
TRIED = 3
"""Pairs that are tried with coarse pixels, for each one that is used."""


@dataclass(frozen=True)
class CoarseHeights:
    """What the search with coarse pixels found.

    Attributes:
        grid: of its cells.
        heights: (p, lines, samples) of the pairs; NaN where they have none.
        looked_at: (p, lines, samples) where each pair was matched.
    """

    grid: MapGrid
    heights: FloatImage
    looked_at: BoolArray

    def of(self, pairs: Sequence[int]) -> "CoarseHeights":
        """The same of some pairs."""
        return CoarseHeights(self.grid, self.heights[list(pairs)], self.looked_at[list(pairs)])

    @property
    def middle(self) -> FloatImage:
        """Median (lines, samples) of the pairs."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # cells that no pair shows
            return np.asarray(np.nanmedian(self.heights, axis=0))

    @property
    def offset_m(self) -> Array:
        """Height (p,) by which each pair lies above the median of all; NaN for a pair without any."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)
            return np.asarray(np.nanmedian(self.heights - self.middle, axis=(1, 2)))

    def agreement(self, within_m: float) -> Array:
        """Share (p,) of the cells where each pair was matched in which it agrees with the median of all.

        Cells that no pair has do not count.
        """
        middle = self.middle
        off_m = np.abs(self.heights - self.offset_m[:, None, None] - middle)
        seen = (self.looked_at & np.isfinite(middle)).sum(axis=(1, 2))
        return np.asarray((off_m < within_m).sum(axis=(1, 2)) / np.maximum(seen, 1))

    def around(self, tile: MapGrid) -> tuple[float, float] | None:
        """Heights to look for on a tile of the surface; None where none was found on or next to it."""
        corners = np.array([[-0.5, -0.5], np.array(tile.shape) - 0.5])
        at = self.grid.line_sample_of_xy(tile.xy(corners))
        first = np.maximum(np.floor(at.min(axis=0)).astype(int) - 4, 0)
        last = np.ceil(at.max(axis=0)).astype(int) + 5
        part = self.heights[:, first[0] : last[0], first[1] : last[1]]
        known = part[np.isfinite(part)]
        if len(known) < _FEWEST:
            return None
        # One height in two hundred may be wrong on either side.
        low, high = np.quantile(known, [0.005, 0.995])
        return float(low) - _BELOW_M, float(high) + _ABOVE_M


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
        looks = [(w, n) for w, own in zip(windows, of_windows, strict=True) for n in own]
        tasks = [(_name(w, n), partial(self._arguments, coarse, w, self.pairs[n])) for w, n in looks]
        work.run(match_task, tasks, progress)
        heights = np.full((len(self.pairs), *coarse.shape), np.nan, dtype=np.float32)
        looked_at = np.zeros(heights.shape, dtype=np.bool_)
        for w, number in looks:
            found = pair_surface(work.kept[_name(w, number)])
            if found is not None:
                place = np.s_[w.line : w.line + w.lines, w.sample : w.sample + w.samples]
                cells, why = cells_of_pair(found, part_of_grid(coarse, w, 0), np.zeros(3), _REACH_CELLS)
                heights[number][place] = cells
                looked_at[number][place] = why != Reason.OUTSIDE
        if not np.isfinite(heights).any():
            low_m, high_m = self.heights_m
            raise CoverageError(
                "no pair of scenes was matched anywhere: check that the scenes show the same ground "
                f"between {low_m:.0f} and {high_m:.0f} m, and that their models agree (register them "
                "first)"
            )
        return CoarseHeights(coarse, heights, looked_at)

    def _arguments(self, coarse: MapGrid, window: Window, pair: Pair) -> tuple[Any, ...]:
        matcher = self.options.matcher
        small = replace(matcher, smallest_patch_px=matcher.smallest_patch_px // COARSE)
        part = part_of_grid(coarse, window, MARGIN_CELLS // 2)
        scenes = self.scenes[pair.first], self.scenes[pair.second]
        return scenes, part, self.heights_m, float(COARSE), small


def _coarse(window: Window, shape: tuple[int, int]) -> Window:
    """The window of the grid of this search around one of the surface."""
    first = [max(n // COARSE - _AROUND_CELLS, 0) for n in (window.line, window.sample)]
    ends = (window.line + window.lines, window.sample + window.samples)
    last = [min(-(-n // COARSE) + _AROUND_CELLS, most) for n, most in zip(ends, shape, strict=True)]
    return Window(first[0], first[1], last[0] - first[0], last[1] - first[1])


def _name(window: Window, number: int) -> str:
    place = f"{window.line:06d}-{window.sample:06d}-{window.lines}-{window.samples}"
    return f"coarse/{place}-{number:03d}"
