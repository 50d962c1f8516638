"""Selection of the dates of a base: clear, over seasons and orbits, until all ground is seen."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from amers.services.imagery.archives import ArchiveImage
from amers.services.types import Array, IntArray

_SAMPLES_ACROSS = 24
"""Places along the longer side of an area at which views are counted."""
_AGE_PENALTY = 0.03
"""Per year before the newest image, as in the selection of images."""
_TYPICAL_SIGMA_M = 10.0
"""Stated accuracy at which an image counts half: that of Sentinel-2 and Landsat without control."""
_SECONDS_OF_A_YEAR = 365.25 * 86400.0
_PREFERENCE = 1.5
"""Of a date that a neighbouring tile uses."""
_MOST_DATES = 1.5
"""Dates beyond those asked for, as a factor, where swaths and clouds leave gaps."""


@dataclass(frozen=True)
class TileArea:
    """The part of an area that is taken from one tile of the map.

    Attributes:
        tile: its name.
        polygon: longitude and latitude.
        places: (n, 2) longitude and latitude, evenly in the polygon.
        images: (k,) numbers of its images.
    """

    tile: str
    polygon: shapely.Geometry
    places: Array
    images: IntArray


def tile_areas(
    images: Sequence[ArchiveImage], area: shapely.Geometry, margin_deg: float
) -> list[TileArea]:
    """The fewest tiles that show an area, each with its own part of it, as a greedy cover.

    Args:
        images: of all tiles.
        area: polygons, longitude and latitude.
        margin_deg: a place this close to the edge of a tile is taken from another, where one shows it.
    """
    names = sorted({image.tile for image in images})
    of_tile = {name: np.flatnonzero([image.tile == name for image in images]) for name in names}
    whole = {
        name: shapely.union_all([images[i].footprint for i in of_tile[name].tolist()]) for name in names
    }
    parts: dict[str, shapely.Geometry] = {}
    left = area
    for shrunk in (margin_deg, 0.0):
        shown = {name: whole[name].buffer(-shrunk) for name in names}
        while not left.is_empty:
            gains = {name: shown[name].intersection(left) for name in names}
            best = max(names, key=lambda name: gains[name].area)
            if gains[best].area <= 1e-6 * area.area:
                break
            parts[best] = shapely.union(parts.get(best, shapely.Polygon()), gains[best])
            left = left.difference(shown[best])
    return [
        TileArea(name, part, places_in(part), of_tile[name].astype(np.int64))
        for name, part in parts.items()
    ]


def places_in(polygon: shapely.Geometry) -> Array:
    """Places (n, 2) in a polygon, on a regular grid; one at least."""
    west, south, east, north = polygon.bounds
    step = max(east - west, north - south) / _SAMPLES_ACROSS
    lon = np.arange(west + step / 2.0, east, step)
    lat = np.arange(south + step / 2.0, north, step)
    grid = np.stack(np.meshgrid(lon, lat), axis=-1).reshape(-1, 2)
    inside = shapely.contains_xy(polygon, grid)
    if not inside.any():
        return np.array(polygon.representative_point().coords, dtype=np.float64)
    return np.asarray(grid[inside])


def choose_dates(
    area: TileArea,
    images: Sequence[ArchiveImage],
    dates: int,
    accept: Callable[[int], bool],
    preferred: frozenset[str] = frozenset(),
) -> list[int]:
    """The numbers of the images that are taken, in the order of the choice.

    The next image is the one of the largest score among those that were not tried: its clear share,
    times the ground that it shows, where ground with v views counts 1 / (1 + v), times what its season
    and orbit are worth, fewer of which were chosen before, times its accuracy and its age. Of products
    of one acquisition, the one of the latest baseline is taken.

    Args:
        area: whose images are chosen.
        images: of all tiles.
        dates: number of dates that each place needs.
        accept: reads an image; false where it is too cloudy or cannot be read.
        preferred: dates that neighbouring tiles use, which tie the tiles.
    """
    candidates = _latest_products(area, images)
    shown = {i: np.asarray(shapely.contains_xy(images[i].footprint, area.places)) for i in candidates}
    candidates = [i for i in candidates if shown[i].any()]
    views = np.zeros(len(area.places), dtype=np.int64)
    chosen: list[int] = []
    while candidates and views.min() < dates and len(chosen) < int(_MOST_DATES * dates):
        wanted = np.where(views < dates, 1.0 / (1.0 + views), 0.0)
        ground = np.array([float((wanted * shown[i]).mean()) for i in candidates])
        worth = _worth([images[i] for i in candidates], [images[i] for i in chosen], preferred)
        score = ground * worth
        if score.max() <= 0.0:
            break
        best = candidates.pop(int(np.argmax(score)))
        if accept(best):
            chosen.append(best)
            views += shown[best]
    return chosen


def _worth(
    candidates: Sequence[ArchiveImage], chosen: Sequence[ArchiveImage], preferred: frozenset[str]
) -> Array:
    """What the images are worth for a place that they show."""
    seasons = Counter(one.season for one in chosen)
    orbits = Counter(one.orbit for one in chosen)
    newest = max(one.acquired for one in candidates)
    worth = []
    for one in candidates:
        years = (newest - one.acquired).total_seconds() / _SECONDS_OF_A_YEAR
        variety = 1.0 / (1.0 + seasons[one.season]) + 1.0 / (1.0 + orbits[one.orbit])
        value = ((1.0 - one.cloud) * (1.0 - one.snow)) ** 2 * (1.0 + variety)
        value *= 1.0 / (1.0 + one.accuracy.total_m / _TYPICAL_SIGMA_M) / (1.0 + _AGE_PENALTY * years)
        worth.append(value * (_PREFERENCE if one.date in preferred else 1.0))
    return np.array(worth)


def _latest_products(area: TileArea, images: Sequence[ArchiveImage]) -> list[int]:
    """One product of every acquisition: that of the latest baseline."""
    best: dict[tuple[str, str], int] = {}
    for i in area.images.tolist():
        one = images[i]
        # Parts of a pass that two ground stations received have one day, but show other ground.
        key = (one.date, f"{one.acquired:%H:%M:%S}")
        if key not in best or images[best[key]].baseline < one.baseline:
            best[key] = i
    return sorted(best.values(), key=lambda i: images[i].id)
