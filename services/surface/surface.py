"""A surface from overlapping scenes: pairs selected, matched in tiles, aligned and fused."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from amers.services.errors import CoverageError
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.surface.coarse import AGREES_CELLS, CoarseSearch
from amers.services.surface.match import Reason, Reasons
from amers.services.surface.options import SurfaceOptions
from amers.services.surface.pairs import BEST_BASE, LEAST_SHOWN, Pair, candidate_pairs, pairs_over
from amers.services.surface.stages import Stages, fuse_task
from amers.services.surface.tiles import (
    LARGEST_TILE,
    Tile,
    grid_over,
    largest_volume,
    tiles_of,
    windows_of,
)
from amers.services.tasks import Work
from amers.services.types import Array, BoolArray, FloatImage, Progress, no_progress, part_of

Water = Callable[[Array], BoolArray]
"""Which places (n, 2), longitude and latitude, are water."""

_DEFAULT = SurfaceOptions()


@dataclass(frozen=True)
class SurfaceTile:
    """A part of a surface.

    Attributes:
        window: of the grid.
        height_m, sigma_m: (lines, samples) above the ellipsoid, and one standard deviation; NaN for
            none.
        views: (lines, samples) uint8, number of images in which a height was found; 0 where it was
            filled.
        reason: (lines, samples) uint8, a `Reason`: why a cell has no height.
    """

    window: Window
    height_m: FloatImage
    sigma_m: FloatImage
    views: Reasons
    reason: Reasons


@dataclass(frozen=True)
class Surface:
    """A surface whose pairs are matched and aligned; `surface_tiles` fuses them.

    Attributes:
        stages: with the grid, the scenes, the pairs, and the work that keeps the disparities.
        shift_m: (p, 3) by which each pair was moved onto the others: x, y and height.
        sigma_m: (p,) noise of the heights of each pair, one standard deviation.
        tiles: parts of the grid.
    """

    stages: Stages
    shift_m: Array
    sigma_m: Array
    tiles: tuple[Tile, ...]

    @property
    def grid(self) -> MapGrid:
        """Its cells."""
        return self.stages.grid

    @property
    def pairs(self) -> tuple[Pair, ...]:
        """That it is made of."""
        return self.stages.pairs


def make_surface(
    scenes: Sequence[Scene],
    options: SurfaceOptions = _DEFAULT,
    *,
    grid: MapGrid | None = None,
    windows: Sequence[Window] | None = None,
    work: Work | None = None,
    progress: Progress = no_progress,
) -> Surface:
    """Match the pairs of some scenes over a grid of the ground, and align them.

    Args:
        scenes: two or more, with models that agree: registered, or of one adjusted block.
        options: of the surface.
        grid: projected and north-up; by default in the UTM zone, over what two scenes show.
        windows: parts of the grid that are made, which may overlap; by default all of it.
        work: computes the tasks and keeps their results; by default in this process, in memory.
        progress: receives the fraction done and a message.

    Raises:
        CoverageError: no two scenes see the same ground, or nothing of it was matched.
    """
    work = work or Work()
    heights_m = _heights_m(scenes, options)
    candidates = candidate_pairs(scenes, heights_m, options.bases)
    grid = grid or grid_over(scenes, candidates, options.gsd_m)
    search = CoarseSearch(scenes, candidates, heights_m, options)
    coarse = search.over(grid, windows, work, part_of(progress, 0.0, 0.2))
    # What is within the noise of a pair agrees: that of a smaller base is as much larger.
    noisier = np.array([max(1.0, BEST_BASE / pair.base_to_height) for pair in candidates])
    fits = coarse.agreement(AGREES_CELLS * float(grid.step_xy[0, 1]) * noisier)
    shown = [
        replace(pair, merit=float(fit / noise), fit=float(fit))
        for pair, fit, noise in zip(candidates, fits, noisier, strict=True)
    ]
    windows = windows or windows_of(grid.shape, LARGEST_TILE)
    best = pairs_over(shown, grid, windows, options.pairs, LEAST_SHOWN)
    used = sorted({number for numbers in best for number in numbers})
    pairs, coarse = [shown[number] for number in used], coarse.of(used)
    volume = largest_volume(grid, scenes, pairs, options)
    tiles = tuple(
        replace(tile, pairs=tuple(used.index(number) for number in numbers))
        for window, numbers in zip(windows, best, strict=True)
        for tile in tiles_of(grid, window, coarse.around, volume)
    )
    stages = Stages(tuple(scenes), tuple(pairs), grid, options, work)
    stages.match(tiles, part_of(progress, 0.2, 0.6))
    shift_m, sigma_m = stages.align(tiles, coarse.offset_m, part_of(progress, 0.8, 0.2))
    return Surface(stages, shift_m, sigma_m, tiles)


def surface_grid(scenes: Sequence[Scene], options: SurfaceOptions = _DEFAULT) -> MapGrid:
    """The grid that a surface of some scenes has by default.

    Raises:
        CoverageError: no two scenes see the same ground.
    """
    candidates = candidate_pairs(scenes, _heights_m(scenes, options), options.bases)
    return grid_over(scenes, candidates, options.gsd_m)


def surface_tiles(
    surface: Surface, progress: Progress = no_progress, water: Water | None = None
) -> Iterator[SurfaceTile]:
    """The tiles of a surface, fused as many at once as the work is ahead.

    Args:
        surface: matched and aligned.
        progress: receives the fraction done.
        water: the reason of empty cells there; None where no water is stated.
    """
    stages, ahead = surface.stages, surface.stages.work.ahead
    for first in range(0, len(surface.tiles), ahead):
        progress(first / len(surface.tiles), f"fuse: {first} of {len(surface.tiles)}")
        group = surface.tiles[first : first + ahead]
        place = (surface.shift_m, surface.sigma_m)
        tasks = [(f"fuse/{tile.name}", partial(stages.fuse_arguments, tile, *place)) for tile in group]
        stages.work.run(fuse_task, tasks)
        for tile in group:
            found = stages.work.kept[f"fuse/{tile.name}"]
            made = SurfaceTile(
                tile.window, found["height_m"], found["sigma_m"], found["views"], found["reason"]
            )
            yield made if water is None else _with_water(made, surface.grid, water)


def _with_water(tile: SurfaceTile, grid: MapGrid, water: Water) -> SurfaceTile:
    """The same tile, whose empty cells say where they are water."""
    empty = np.argwhere(tile.reason != Reason.FOUND)
    reason = tile.reason.copy()
    on_water = empty[water(grid.lon_lat(empty + [float(tile.window.line), float(tile.window.sample)]))]
    reason[on_water[:, 0], on_water[:, 1]] = Reason.WATER
    return replace(tile, reason=reason)


def _heights_m(scenes: Sequence[Scene], options: SurfaceOptions) -> tuple[float, float]:
    """Heights to look for: the stated ones, or those that all models are meant for."""
    ranges = np.array([scene.model.height_range_m for scene in scenes])
    low, high = float(ranges[:, 0].max()), float(ranges[:, 1].min())
    if not low < high:
        raise CoverageError(
            f"the models of the scenes are meant for different heights, {ranges.round().tolist()} m: "
            "they do not show the same ground"
        )
    if options.heights_m is None:
        return low, high
    stated_low, stated_high = options.heights_m
    if stated_high <= low or stated_low >= high:
        raise CoverageError(
            f"heights from {stated_low:g} to {stated_high:g} m are stated, the models of the scenes are "
            f"meant for {low:.0f} to {high:.0f} m above the ellipsoid: check the heights"
        )
    # Models say nothing of what is beyond their heights.
    return max(low, stated_low), min(high, stated_high)
