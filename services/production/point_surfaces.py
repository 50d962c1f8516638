"""Surface heights at the points of a block: dense matching of image pairs around each point."""

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from amers.services.errors import ComputationError, CoverageError
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid, utm_of, xy_of_lon_lat
from amers.services.production.ground_parts import image_parts
from amers.services.surface.match import REASON_LABELS, Reason
from amers.services.surface.options import SurfaceOptions
from amers.services.surface.surface import make_surface, surface_tiles
from amers.services.surface.tiles import MARGIN_CELLS
from amers.services.tasks import Arrays, Work
from amers.services.types import Array, Progress, SurfaceHeights

_SIDE_CELLS = 64
"""Side of the square around a point whose surface is made."""
_BELOW_M, _ABOVE_M = 50.0, 150.0
"""Heights below the lowest point and above the highest one that are looked for: valleys, towers."""
NOT_ASKED = "no pairs of images were to be used"
TOO_STEEP = "the ground is too steep for the approximation of the models"


def surfaces_at(
    scenes: Sequence[Scene],
    lon_lat_h: Array,
    pairs: int,
    *,
    of_models_m2: Array | float = 0.0,
    work: Work,
    progress: Progress,
) -> tuple[SurfaceHeights, Mapping[str, int]]:
    """The height of the surface at the positions of points, above the ellipsoid.

    The height of a point is that of the content of its chips, an average over roofs and trees. Its
    surface is what stands at its longitude and latitude.

    Args:
        scenes: with models that agree.
        lon_lat_h: (n, 3) the points, those near each other following each other.
        pairs: of images at most at one place; 0 leaves all heights unknown.
        of_models_m2: (n,) variance of heights there by the models, which a surface takes over.
        work: computes the tasks and keeps their results.
        progress: receives the fraction done.

    Returns:
        NaN where no two images show the place under angles that give heights, nothing was matched, or
        the ground is too steep for the approximation of the models; and the number of points without a
        height by the reason.
    """
    if pairs == 0:
        return SurfaceHeights(*np.full((2, len(lon_lat_h)), np.nan)), {NOT_ASKED: len(lon_lat_h)}
    parts, images = image_parts(scenes, lon_lat_h)

    def arguments(number: int) -> tuple[Any, ...]:
        return [scenes[i] for i in images[number]], lon_lat_h[parts[number]], pairs

    names = [f"surfaces/{number:06d}" for number in range(len(parts))]
    work.run(surface_task, [(name, partial(arguments, i)) for i, name in enumerate(names)], progress)
    found = [work.kept[name] for name in names]
    height_m, sigma_m, why = (
        np.concatenate([one[name] for one in found]) for name in ("height_m", "sigma_m", "why")
    )
    heights = SurfaceHeights(height_m, np.sqrt(sigma_m**2 + of_models_m2))
    return heights, dict(Counter(why[np.isnan(height_m)].tolist()).most_common())


def surface_task(scenes: Sequence[Scene], lon_lat_h: Array, pairs: int) -> Arrays:
    """The surface at the points of one part."""
    height_m, sigma_m = np.full(len(lon_lat_h), np.nan), np.full(len(lon_lat_h), np.nan)
    labels = np.array([*REASON_LABELS.values(), TOO_STEEP])
    why = np.full(len(lon_lat_h), labels[Reason.OUTSIDE], dtype=labels.dtype)
    heights = lon_lat_h[:, 2]
    options = SurfaceOptions(
        heights_m=(float(heights.min()) - _BELOW_M, float(heights.max()) + _ABOVE_M), pairs=pairs
    )
    grid = _grid_around(lon_lat_h, min(scene_gsd_m(scene) for scene in scenes))
    cells = np.rint(grid.line_sample(lon_lat_h[:, :2])).astype(np.int64)
    windows = [
        Window(line - _SIDE_CELLS // 2, sample - _SIDE_CELLS // 2, _SIDE_CELLS, _SIDE_CELLS)
        for line, sample in cells.tolist()
    ]
    near_each_other = len(windows) * (_SIDE_CELLS + 2 * MARGIN_CELLS) ** 2 > np.prod(grid.shape)
    try:
        surface = make_surface(scenes, options, grid=grid, windows=None if near_each_other else windows)
    except CoverageError:
        return {"height_m": height_m, "sigma_m": sigma_m, "why": why}
    except ComputationError:
        return {"height_m": height_m, "sigma_m": sigma_m, "why": np.full_like(why, TOO_STEEP)}
    for tile in surface_tiles(surface):
        first = np.array([tile.window.line, tile.window.sample])
        own = cells - first
        rows = np.flatnonzero(((own >= 0) & (own < tile.height_m.shape)).all(axis=1))
        height_m[rows] = tile.height_m[own[rows, 0], own[rows, 1]]
        sigma_m[rows] = tile.sigma_m[own[rows, 0], own[rows, 1]]
        why[rows] = labels[tile.reason[own[rows, 0], own[rows, 1]]]
    return {"height_m": height_m, "sigma_m": sigma_m, "why": why}


def _grid_around(lon_lat_h: Array, side_m: float) -> MapGrid:
    """The north-up grid over points (n, 3) and the squares around them, in their UTM zone."""
    crs = utm_of(*lon_lat_h[0, :2].tolist())
    xy = xy_of_lon_lat(crs, lon_lat_h[:, :2])
    first = np.floor(xy.min(axis=0) / side_m) - _SIDE_CELLS
    last = np.ceil(xy.max(axis=0) / side_m) + _SIDE_CELLS
    samples, lines = (last - first).astype(int).tolist()
    origin = np.array([first[0], last[1]]) * side_m
    return MapGrid(crs, origin, np.array([[0.0, side_m], [-side_m, 0.0]]), (lines, samples))
