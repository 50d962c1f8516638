"""The stages of a surface: pairs matched, aligned and fused, each in tasks of one tile."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.map_grid import MapGrid
from amers.services.surface.fill import filled_gaps
from amers.services.surface.fuse import (
    AROUND_PX,
    DISPARITY_SIGMA_PX,
    DISTANCES,
    alignment_sums,
    fuse,
    noise_of_distances,
    roughness_m,
)
from amers.services.surface.match import Reason, Reasons
from amers.services.surface.options import SurfaceOptions
from amers.services.surface.pair_surface import PairSurface, cells_of_pair, match_task, pair_surface
from amers.services.surface.pairs import Pair
from amers.services.surface.tiles import MARGIN_CELLS, Tile, coarser, part_of_grid
from amers.services.tasks import Arrays, Work
from amers.services.types import Array, FloatImage, IntArray, Progress, part_of

_REACH_CELLS = 1.0
"""Distance of the points around a cell of which the median is its height."""
_ALIGNED_CELLS = 2
"""Cells of the surface along each side of one that pairs are aligned by."""
_ROUNDS = 3
"""Rounds of alignment: offsets first, then positions."""
_FEWEST_CELLS = 1000
"""Cells that have to agree before a pair is moved."""


@dataclass(frozen=True)
class Stages:
    """What all tasks of the fine stages share."""

    scenes: tuple[Scene, ...]
    pairs: tuple[Pair, ...]
    grid: MapGrid
    options: SurfaceOptions
    work: Work

    def match(self, tiles: Sequence[Tile], progress: Progress) -> None:
        """Keep the disparities of every pair on every tile."""
        tasks = [
            (_pair_name(tile, number), partial(self._match_arguments, tile, self.pairs[number]))
            for tile in tiles
            if tile.heights_m is not None
            for number in tile.pairs
        ]
        self.work.run(match_task, tasks, progress)

    def align(self, tiles: Sequence[Tile], offset_m: Array, progress: Progress) -> tuple[Array, Array]:
        """Shifts (p, 3) of the pairs, and the noise (p,) of their heights."""
        count = len(self.pairs)
        px_per_m = np.array([self._px_per_m(tiles, number) for number in range(count)])
        least = np.nan_to_num(DISPARITY_SIGMA_PX / px_per_m, nan=np.inf)
        sigma_m = least
        shift = np.zeros((count, 3))
        shift[:, 2] = -np.nan_to_num(offset_m)
        for turn in range(_ROUNDS if count > 1 else 0):
            names = [f"align/{turn}-{tile.name}" for tile in tiles]
            tasks = [
                (name, partial(self.fuse_arguments, tile, shift, sigma_m))
                for name, tile in zip(names, tiles, strict=True)
            ]
            self.work.run(align_task, tasks, part_of(progress, turn / _ROUNDS, 1.0 / _ROUNDS))
            normal, right, distances = (
                self._summed(names, part) for part in ("normal", "right", "distances")
            )
            for number in np.flatnonzero(normal[:, 2, 2] >= _FEWEST_CELLS):
                shift[number] += np.linalg.solve(normal[number], right[number])
            sigma_m = np.maximum(least, noise_of_distances(distances))
            shift -= np.average(shift, axis=0, weights=sigma_m**-2.0)
        return shift, sigma_m

    def _summed(self, names: Sequence[str], part: str) -> npt.NDArray[Any]:
        """The sum of an array of some results, one of which is open at a time."""
        total = np.array(self.work.kept[names[0]][part])
        for name in names[1:]:
            total += self.work.kept[name][part]
        return total

    def fuse_arguments(self, tile: Tile, shift_m: Array, sigma_m: Array) -> tuple[Any, ...]:
        """What `fuse_task` and `align_task` take."""
        found = [(number, self._surface(tile, number)) for number in tile.pairs]
        known = [(number, surface) for number, surface in found if surface is not None]
        images = np.array(
            [(self.pairs[n].first, self.pairs[n].second) for n, _ in known], dtype=np.int64
        ).reshape(-1, 2)
        numbers = np.array([number for number, _ in known], dtype=np.int64)
        surfaces = [surface for _, surface in known]
        part = part_of_grid(self.grid, tile.window, self._around.cells)
        pairs = PairsOfTile(numbers, images, shift_m[numbers], sigma_m[numbers], len(self.pairs))
        return surfaces, part, pairs, self._around

    @property
    def _around(self) -> "Around":
        """What filling and roughness look at."""
        finest_m = min(scene_gsd_m(scene) for scene in self.scenes)
        half = round(AROUND_PX / 2.0 * finest_m / float(self.grid.step_xy[0, 1]))
        return Around(self.options.fill_cells, 1 + 2 * max(half, 2))

    def _match_arguments(self, tile: Tile, pair: Pair) -> tuple[Any, ...]:
        part = part_of_grid(self.grid, tile.window, MARGIN_CELLS)
        scenes = self.scenes[pair.first], self.scenes[pair.second]
        return scenes, part, tile.heights_m, 1.0, self.options.matcher

    def _surface(self, tile: Tile, number: int) -> PairSurface | None:
        return None if tile.heights_m is None else pair_surface(self.work.kept[_pair_name(tile, number)])

    def _px_per_m(self, tiles: Sequence[Tile], number: int) -> float:
        # One after the other: each keeps files of the work folder open.
        surfaces = (self._surface(tile, number) for tile in tiles if number in tile.pairs)
        known = [abs(surface.px_per_m) for surface in surfaces if surface is not None]
        return float(np.median(known)) if known else math.nan


@dataclass(frozen=True)
class Around:
    """The cells that count around one.

    Attributes:
        fill_cells: fill gaps from heights at most this many cells away; 0 leaves gaps open.
        rough_cells: side of the square whose roughness counts, an odd number.
    """

    fill_cells: int
    rough_cells: int

    @property
    def cells(self) -> int:
        """Cells around a tile that are looked at."""
        return max(self.fill_cells, self.rough_cells // 2) + 2


def _pair_name(tile: Tile, number: int) -> str:
    return f"pairs/{tile.name}-{number:03d}"


@dataclass(frozen=True)
class PairsOfTile:
    """The pairs that show a tile.

    Attributes:
        numbers: (k,) of them among all pairs.
        images: (k, 2) numbers of their images.
        shift_m, sigma_m: (k, 3), (k,); see `Surface`.
        count: number of all pairs.
    """

    numbers: IntArray
    images: IntArray
    shift_m: Array
    sigma_m: Array
    count: int

    def cells(
        self, surfaces: Sequence[PairSurface], tile: MapGrid, reach: float
    ) -> tuple[FloatImage, list[Reasons]]:
        """Heights (k, lines, samples) of the pairs in the cells of the tile, and their reasons."""
        cells = [
            cells_of_pair(surface, tile, shift_m, reach)
            for surface, shift_m in zip(surfaces, self.shift_m, strict=True)
        ]
        return np.stack([heights for heights, _ in cells]), [why for _, why in cells]


def align_task(
    surfaces: Sequence[PairSurface], tile: MapGrid, pairs: PairsOfTile, around: Around
) -> Arrays:
    """What tells how the pairs lie off their fused surface on one tile; see `alignment_sums`."""
    normal, right = np.zeros((pairs.count, 3, 3)), np.zeros((pairs.count, 3))
    distances = np.zeros((pairs.count, DISTANCES), dtype=np.int64)
    if len(surfaces) > 1:
        tile = coarser(tile, _ALIGNED_CELLS)
        heights, _ = pairs.cells(surfaces, tile, _REACH_CELLS / _ALIGNED_CELLS)
        fused = fuse(heights, pairs.sigma_m, pairs.images)
        sums = alignment_sums(heights, fused.height_m, float(tile.step_xy[0, 1]))
        normal[pairs.numbers], right[pairs.numbers], distances[pairs.numbers] = sums
    return {"normal": normal, "right": right, "distances": distances}


def fuse_task(
    surfaces: Sequence[PairSurface], tile: MapGrid, pairs: PairsOfTile, around: Around
) -> Arrays:
    """The fused heights of a tile, without the cells around it that they need."""
    inside = np.s_[around.cells : -around.cells, around.cells : -around.cells]
    if not surfaces:
        lines, samples = (n - 2 * around.cells for n in tile.shape)
        unknown = np.full((lines, samples), np.nan, dtype=np.float32)
        nothing = np.zeros((lines, samples), dtype=np.uint8)
        reason = nothing + np.uint8(Reason.OUTSIDE)
        return {"height_m": unknown, "sigma_m": unknown, "views": nothing, "reason": reason}
    heights, reasons = pairs.cells(surfaces, tile, _REACH_CELLS)
    reason = np.max(reasons, axis=0)
    fused = fuse(heights, pairs.sigma_m, pairs.images)
    height_m, sigma_m = fused.height_m, fused.sigma_m
    if (fused.agree > 1).any():
        # What one pair of several sees is no more certain than what is around it.
        unsure = fused.agree < 2
        sure = np.where(unsure, np.float32(np.nan), height_m)
        other_m, other_sigma_m = filled_gaps(sure, sigma_m, around.fill_cells)
        replaced = unsure & np.isfinite(other_m)
        height_m = np.where(replaced, other_m, height_m)
        sigma_m = np.where(replaced, other_sigma_m, sigma_m)
        fused.views[replaced] = 0
    height_m, sigma_m = filled_gaps(height_m, sigma_m, around.fill_cells)
    sigma_m = np.hypot(sigma_m, roughness_m(height_m, around.rough_cells))
    reason[np.isfinite(height_m)] = Reason.FOUND
    return {
        "height_m": height_m[inside],
        "sigma_m": sigma_m[inside],
        "views": fused.views[inside],
        "reason": reason[inside],
    }
