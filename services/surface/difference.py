"""Difference of two surfaces: the later one is aligned with the earlier one and compared.

Source of the alignment: Nuth and Kääb (2011), Co-registration and bias corrections of satellite
elevation data sets for quantifying glacier thickness change; here by weighted least squares. Of its
sigma: Liang and Zeger (1986), Longitudinal data analysis using generalized linear models, where parts of
the ground are the clusters.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from amers.services.errors import CoverageError
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid, lon_lat_of_xy
from amers.services.surface.fuse import alignment_sums
from amers.services.surface.surface import SurfaceTile
from amers.services.surface.tiles import LARGEST_TILE, coarser, part_of_grid, windows_of
from amers.services.types import Array, BoolArray, FloatImage, IntArray, Progress, no_progress

_ALIGNED_CELLS = 2
"""Cells along each side of one that the alignment looks at: noise makes less of longer slopes."""
_MOST_WINDOWS, _WINDOW_CELLS = 100, 128
"""Windows that tell the alignment, spread over the ground, so that its time is bounded, and their size:
errors of surfaces are alike within tens of metres, not from one window to the next."""
_FEWEST_CELLS = 1000
"""Cells that have to agree before a surface is moved."""
_ROUNDS = 10
_STILL_M = 0.01
"""A round that moves the surface by less is the last one: a hundredth of the noise of many surfaces."""
_MOST_SIGMA_CELLS = 0.5
"""Positions that are less precise are not moved: the ground is too flat to tell them."""


class SurfaceSource(Protocol):
    """A surface that is read by windows."""

    @property
    def grid(self) -> MapGrid:
        """Of its cells, projected."""
        ...

    def read(self, window: Window) -> SurfaceTile:
        """The surface in a window of its grid."""
        ...


@dataclass(frozen=True)
class Alignment:
    """How the later surface was moved onto the earlier one.

    Attributes:
        shift_m: (3,) x, y and height, added to the later one.
        sigma_m: (3,) one standard deviation of it, from how parts of the ground differ; 0 where it was
            not moved.
        cells: number of those that agreed; 0 where it was not moved.
        moved_horizontally: False where the ground is too flat to tell.
    """

    shift_m: Array
    sigma_m: Array
    cells: int
    moved_horizontally: bool


@dataclass(frozen=True)
class DifferenceTile:
    """A part of a difference.

    Attributes:
        window: of its grid.
        difference_m: (lines, samples) height of the later above the earlier surface; NaN where one of
            them has none.
        sigma_m: (lines, samples) one standard deviation of it.
    """

    window: Window
    difference_m: FloatImage
    sigma_m: FloatImage


@dataclass(frozen=True)
class TwoSurfaces:
    """Two surfaces of the same ground at two dates."""

    earlier: SurfaceSource
    later: SurfaceSource

    @property
    def grid(self) -> MapGrid:
        """That of the coarser surface, where the other one may have heights.

        Raises:
            CoverageError: the surfaces do not overlap.
        """
        both = self.earlier.grid, self.later.grid
        own, other = both if both[0].gsd_m >= both[1].gsd_m else both[::-1]
        lines, samples = other.shape
        border = [[i, j] for i in (-0.5, lines - 0.5) for j in np.linspace(-0.5, samples - 0.5, 9)]
        border += [[i, j] for i in np.linspace(-0.5, lines - 0.5, 9) for j in (-0.5, samples - 0.5)]
        at = _places(own, other, other.xy(np.array(border)))
        first = np.maximum(np.floor(at.min(axis=0)), 0).astype(int)
        last = np.minimum(np.ceil(at.max(axis=0)) + 1, own.shape).astype(int)
        if not (last > first).all():
            raise CoverageError("the surfaces do not show the same ground")
        lines, samples = (int(n) for n in last - first)
        return part_of_grid(own, Window(int(first[0]), int(first[1]), lines, samples), 0)

    def align(self, progress: Progress = no_progress) -> Alignment:
        """The shift of the later surface by which both agree on most ground.

        Raises:
            CoverageError: the surfaces have too few heights of the same ground.
        """
        grid = coarser(self.grid, _ALIGNED_CELLS)
        windows = windows_of(grid.shape, _WINDOW_CELLS)
        windows = windows[:: math.ceil(len(windows) / _MOST_WINDOWS)]
        begin = np.array([0.0, 0.0, -self._median(grid, windows)])
        free = [0, 1, 2]
        shift_m, sigma_m = self._settled(grid, windows, begin, free, progress)
        moved = bool((sigma_m[:2] < _MOST_SIGMA_CELLS * float(self.grid.step_xy[0, 1])).all())
        if not moved:
            free = [2]
            shift_m, sigma_m = self._settled(grid, windows, begin, free, progress)
        cells = int(self._sums(grid, windows, shift_m)[2].sum())
        return Alignment(shift_m, sigma_m, cells, moved)

    def _settled(
        self,
        grid: MapGrid,
        windows: Sequence[Window],
        begin: Array,
        free: list[int],
        progress: Progress,
    ) -> tuple[Array, Array]:
        """The shift (3,) whose free coordinates no round moves any more, and its sigma (3,)."""
        shift_m, sigma_m = begin.copy(), np.zeros(3)
        for turn in range(_ROUNDS):
            progress(turn / _ROUNDS, f"align: round {turn + 1}")
            normal, right, distances = self._sums(grid, windows, shift_m)
            if distances.sum() < _FEWEST_CELLS:
                raise CoverageError(
                    f"{distances.sum()} cells of both surfaces agree within 2 m, {_FEWEST_CELLS} "
                    "needed: check that they show the same ground"
                )
            total = normal.sum(axis=0)[np.ix_(free, free)]
            step = np.linalg.lstsq(total, right.sum(axis=0)[free])[0]
            shift_m[free] += step
            if np.abs(step).max() < _STILL_M:
                break
        # Noise is in the slopes too: what a shift changes is measured, not taken from them.
        right = self._sums(grid, windows, shift_m)[1][:, free]
        inverse = np.linalg.pinv(self._changes(grid, windows, shift_m, free))
        spread = len(right) / max(len(right) - 1, 1) * right.T @ right
        sigma_m[free] = np.sqrt(np.diag(inverse @ spread @ inverse.T))
        shift_m[free] -= inverse @ right.sum(axis=0)
        return shift_m, sigma_m

    def _changes(
        self, grid: MapGrid, windows: Sequence[Window], shift_m: Array, free: list[int]
    ) -> Array:
        """Change of the sums for each metre of the free coordinates of a shift, a column for each."""
        columns, reach_m = [], float(grid.step_xy[0, 1]) / 2.0
        for number in free:
            moved = np.eye(3)[number] * reach_m
            after, before = (self._sums(grid, windows, shift_m + way)[1] for way in (moved, -moved))
            columns.append((after - before).sum(axis=0)[free] / (2.0 * reach_m))
        return np.column_stack(columns)

    def tiles(self, shift_m: Array, progress: Progress = no_progress) -> Iterator[DifferenceTile]:
        """The later surface, moved by x, y and height (3,), less the earlier one, tile by tile."""
        grid = self.grid
        windows = windows_of(grid.shape, LARGEST_TILE)
        for number, window in enumerate(windows):
            progress(number / len(windows), f"difference: {number} of {len(windows)} tiles")
            cells = part_of_grid(grid, window, 0)
            earlier, earlier_sigma_m = _on_cells(self.earlier, cells, np.zeros(3))
            later, later_sigma_m = _on_cells(self.later, cells, shift_m)
            yield DifferenceTile(window, later - earlier, np.hypot(earlier_sigma_m, later_sigma_m))

    def _sums(
        self, grid: MapGrid, windows: Sequence[Window], shift_m: Array
    ) -> tuple[Array, Array, IntArray]:
        """The sums of `alignment_sums` of n windows: (n, 3, 3), (n, 3), (n, distances)."""
        step_m, sums = float(grid.step_xy[0, 1]), []
        for window in windows:
            earlier, later = self._measured(part_of_grid(grid, window, 0), shift_m)
            sums.append(alignment_sums(later[None], earlier, step_m))
        normal, right, distances = (np.concatenate(parts) for parts in zip(*sums, strict=True))
        return normal, right, distances

    def _measured(self, cells: MapGrid, shift_m: Array) -> tuple[FloatImage, FloatImage]:
        """Heights of both in some cells, without those that were filled."""
        earlier, _ = _on_cells(self.earlier, cells, np.zeros(3), measured=True)
        later, _ = _on_cells(self.later, cells, shift_m, measured=True)
        return earlier, later

    def _median(self, grid: MapGrid, windows: Sequence[Window]) -> float:
        """Median height of the later surface above the earlier one."""
        off_m = [np.empty(0, dtype=np.float32)]
        for window in windows:
            earlier, later = self._measured(part_of_grid(grid, window, 0), np.zeros(3))
            off = later - earlier
            off_m.append(off[np.isfinite(off)])
        known = np.concatenate(off_m)
        if len(known) == 0:
            raise CoverageError("the surfaces have no heights of the same ground")
        return float(np.median(known))


def _places(grid: MapGrid, other: MapGrid, xy: Array) -> Array:
    """Line and sample (n, 2) in a grid of map positions (n, 2) of another grid."""
    if grid.crs == other.crs:
        return grid.line_sample_of_xy(xy)
    return grid.line_sample(lon_lat_of_xy(other.crs, xy))


def _on_cells(
    source: SurfaceSource, cells: MapGrid, shift_m: Array, *, measured: bool = False
) -> tuple[FloatImage, FloatImage]:
    """Heights and sigmas (lines, samples) of a surface, moved, in the cells of a grid; bilinear."""
    lines, samples = cells.shape
    centres = np.indices(cells.shape).reshape(2, -1).T.astype(np.float64)
    at = _places(source.grid, cells, cells.xy(centres) - shift_m[:2])
    unknown = np.full(cells.shape, np.nan, dtype=np.float32)
    first = np.maximum(np.floor(np.nanmin(at, axis=0)), 0).astype(int)
    last = np.minimum(np.floor(np.nanmax(at, axis=0)) + 2, source.grid.shape).astype(int)
    if not (last > first).all():
        return unknown, unknown
    size = last - first
    tile = source.read(Window(int(first[0]), int(first[1]), int(size[0]), int(size[1])))
    height_m = tile.height_m + np.float32(shift_m[2])
    if measured:
        height_m = np.where(tile.views > 0, height_m, np.float32(np.nan))
    inner = at - first
    return (
        _bilinear(height_m, inner).reshape(lines, samples),
        _bilinear(tile.sigma_m, inner).reshape(lines, samples),
    )


def _bilinear(values: FloatImage, at: Array) -> FloatImage:
    """Values (n,) between nodes at positions (n, 2); NaN outside, and next to a node without a value."""
    low = np.floor(at)
    part = at - low
    out = np.zeros(len(at), dtype=np.float64)
    for down in (0, 1):
        for right in (0, 1):
            node = (low + [down, right]).astype(np.int64)
            weight = np.abs(1.0 - down - part[:, 0]) * np.abs(1.0 - right - part[:, 1])
            inside: BoolArray = np.all((node >= 0) & (node < values.shape), axis=1)
            line, sample = np.where(inside[:, None], node, 0).T
            value = np.where(inside, values[line, sample], np.nan)
            out += np.where(weight > 0.0, weight * value, 0.0)
    return out.astype(np.float32)
