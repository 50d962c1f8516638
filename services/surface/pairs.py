"""Selection of image pairs for a surface: by angle, by the time between them, by overlap."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import shapely

from amers.services.errors import CoverageError
from amers.services.geodesy import ecef_from_east_north_up
from amers.services.imagery.scene import Scene, scene_centre, scene_footprint, scene_gsd_m
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.types import Array

BEST_BASE = 0.45
"""Base over height of the pairs that are preferred: with less, noise weighs more; with more, more of the
ground is hidden from one of both (seen on nine dates of WorldView-3 against lidar)."""
_BASE_SPREAD = 0.5
"""How fast the preference falls, as the standard deviation of the logarithm of the base."""
_HALVED_DAYS = 60.0
"""Days between two images after which a pair is half as good: seasons, leaves, cars (the same dates)."""
_USED_AGAIN = 0.8
"""What an image that another pair uses leaves of the merit of a pair: their noise is not independent."""
LEAST_SHOWN = 0.85
"""Share of the fit of the best pair that others need, once coarse pixels have shown it: worse
ones added noise to surfaces of four to ten pairs against lidar in one town."""
_LEAST_OVERLAP = 0.02
"""Share of the smaller image that both have to show."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images that see the same ground.

    Attributes:
        first, second: their numbers.
        base_to_height: distance of the sensors over their height, as the rays meet on the ground.
        days: between the images; NaN when unknown.
        overlap: outline (m, 2) of the ground that both show, lon and lat, not closed.
        merit: of the pair, 1 at best: those with the largest are used.
        fit: share of the ground where it agrees with others within its noise; see `choose_pairs`.
    """

    first: int
    second: int
    base_to_height: float
    days: float
    overlap: Array
    merit: float
    fit: float = 1.0


def candidate_pairs(
    scenes: Sequence[Scene], heights_m: tuple[float, float], bases: tuple[float, float]
) -> list[Pair]:
    """All pairs of some scenes that see the same ground under angles that give heights.

    Args:
        scenes: with refined models.
        heights_m: of the ground.
        bases: least and largest base over height.

    Raises:
        CoverageError: no two scenes see the same ground under angles that give heights.
    """
    footprints = [shapely.Polygon(scene_footprint(scene, heights_m)) for scene in scenes]
    directions = [_direction(scene, heights_m) for scene in scenes]
    candidates = []
    tried = []
    for i, j in combinations(range(len(scenes)), 2):
        overlap = shapely.intersection(footprints[i], footprints[j])
        if overlap.area < _LEAST_OVERLAP * min(footprints[i].area, footprints[j].area):
            continue
        base = _base_to_height(directions[i], directions[j])
        tried.append(f"{_name(scenes[i])} and {_name(scenes[j])}: {base:.2f}")
        if bases[0] <= base <= bases[1]:
            # The finer image is matched onto the coarser one.
            first, second = (i, j) if scene_gsd_m(scenes[i]) <= scene_gsd_m(scenes[j]) else (j, i)
            days = _days(scenes[i], scenes[j])
            outline = np.array(overlap.convex_hull.exterior.coords)[:-1]
            candidates.append(Pair(first, second, base, days, outline, _merit(base, days)))
    if not candidates:
        found = f"; base over height of {'; '.join(tried[:5])}" if tried else ""
        raise CoverageError(
            f"no two of {len(scenes)} scenes show the same ground with a base over height of "
            f"{bases[0]:g} to {bases[1]:g}{found}: add scenes of other angles, or allow other bases"
        )
    return candidates


def choose_pairs(candidates: Sequence[Pair], most: int, least: float = 0.0) -> list[Pair]:
    """The best of some pairs, of which those of images that were not used yet come first.

    Args:
        candidates: to choose from.
        most: pairs at most.
        least: share of the fit of the pair with the largest merit that others need.
    """
    chosen: list[Pair] = []
    used = Counter[int]()
    best = max(candidates, key=lambda pair: pair.merit)
    rest = [pair for pair in candidates if pair.fit >= least * best.fit]
    while rest and len(chosen) < most:
        best = max(rest, key=lambda p: p.merit * _USED_AGAIN ** (used[p.first] + used[p.second]))
        rest.remove(best)
        chosen.append(best)
        used.update((best.first, best.second))
    return chosen


def pairs_over(
    candidates: Sequence[Pair],
    grid: MapGrid,
    windows: Sequence[Window],
    most: int,
    least: float = 0.0,
) -> list[tuple[int, ...]]:
    """Numbers of the best pairs that show each of some windows of a grid, ascending.

    Args:
        candidates: to choose from.
        grid: of the windows.
        windows: parts of it.
        most: pairs at most of one window.
        least: share of the fit of the best pair of a window that others need there.
    """
    tree = shapely.STRtree([shapely.Polygon(grid.line_sample(pair.overlap)) for pair in candidates])
    chosen = []
    for w in windows:
        place = shapely.box(w.line, w.sample, w.line + w.lines, w.sample + w.samples)
        seen = np.sort(tree.query(place, predicate="intersects")).tolist()
        best = choose_pairs([candidates[n] for n in seen], most, least) if seen else []
        chosen.append(tuple(n for n in seen if candidates[n] in best))
    return chosen


def _merit(base: float, days: float) -> float:
    angle = math.exp(-0.5 * (math.log(base / BEST_BASE) / _BASE_SPREAD) ** 2)
    return angle / (1.0 + (0.0 if math.isnan(days) else days) / _HALVED_DAYS)


def _name(scene: Scene) -> str:
    return scene.acquisition.image_id


def _days(first: Scene, second: Scene) -> float:
    times = first.acquisition.acquired_at, second.acquisition.acquired_at
    if times[0] is None or times[1] is None:
        return math.nan
    return abs((times[0] - times[1]).total_seconds()) / 86400.0


def _direction(scene: Scene, heights_m: tuple[float, float]) -> Array:
    """Unit vector (3,) east, north, up towards the sensor, at the centre of the image."""
    centre = scene_centre(scene)
    centre[2] = sum(heights_m) / 2.0
    _, sight = scene.model.line_of_sight(scene.model.project(centre[None, :]))
    return np.asarray(-(ecef_from_east_north_up(centre).T @ sight[0]))


def _base_to_height(first: Array, second: Array) -> float:
    """Distance of two sensors over their height by their directions: of their horizontal parts."""
    return float(np.hypot(*(first[:2] / first[2] - second[:2] / second[2])))
