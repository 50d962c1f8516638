"""The copies of tiles as scenes, the frame that their dates give, and the points of every tile."""

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.spatial import cKDTree

from amers.app.errors import InputError
from amers.app.usecases.base.request import BaseOptions, area_km2
from amers.app.usecases.base.search import spacing_m, widened
from amers.app.usecases.base.windows import WindowReader
from amers.services.errors import AmersError, NotEnoughPoints
from amers.services.formats.images.scenes import read_scene
from amers.services.geodesy import metres_per_degree
from amers.services.imagery.archives import ArchiveImage
from amers.services.imagery.scene import Scene
from amers.services.production.chip_sampling import COARSE_FACTOR
from amers.services.production.date_choice import TileArea
from amers.services.production.date_frames import DateFrames, DateShifts, date_frames
from amers.services.production.joined_points import TilePoints, still_found
from amers.services.production.ortho_production import (
    GroundHeights,
    OrthoPointOptions,
    OrthoPoints,
    produce_ortho_points,
    shifts_of_scenes,
)
from amers.services.tasks import Work
from amers.services.types import Array, BoolArray, Progress, part_of

_TIE_POINTS = 80
"""Squares whose corners show by how much a date lies off another."""
_MOST_FIRST = 3
"""Dates of a tile whose details become points: later ones where clouds or swaths hide the first."""
_ENOUGH = 0.8
"""Share of the squares that have points, from which on no other date is tried."""
_LEAST_SQUARES = 6.0
"""Squares along the side of a region: points around a small one show the shifts of images, too."""
_EMPTY = 0.6
"""Distance of a square's centre from all points, sides of a square, from which on it has none."""
_LEAST_VIEWS = 2
_LOCAL_SIGMA_PX = 0.1
"""Least error of details where two orbits agree, pixels of the image. Two dates of Berlin have 0.09
(`pytest -s tests/journeys/test_real_base.py`); orbits look from two sides, and would show errors of the
terrain that was used for the images."""


@dataclass(frozen=True)
class BaseTile:
    """The images of a tile.

    Attributes:
        area: that it gives.
        scenes: their copies, opened.
        images: what their items state.
    """

    area: TileArea
    scenes: list[Scene]
    images: list[ArchiveImage]

    def take(self, rows: Sequence[int]) -> "BaseTile":
        """The tile with some of its images."""
        return replace(
            self, scenes=[self.scenes[row] for row in rows], images=[self.images[row] for row in rows]
        )


@dataclass(frozen=True)
class PlacedDates:
    """The dates of a base and their frames.

    Attributes:
        tiles: with the images that are found in each other.
        dates: names.
        frames: of the dates.
        left_out: words for images that are not found.
    """

    tiles: list[BaseTile]
    dates: list[str]
    frames: DateFrames
    left_out: list[str]

    def move_m(self, image: ArchiveImage) -> Array:
        """(2,) east, north, from an image into the frame of the base."""
        return np.asarray(-self.frames.error_m[self.dates.index(image.date)])


def opened_tiles(
    areas: Sequence[TileArea], chosen: dict[str, list[int]], reader: WindowReader, stack: ExitStack
) -> list[BaseTile]:
    """The copies of all tiles that have images, the clearest of the most accurate first.

    Raises:
        InputError: there is none.
    """
    tiles = []
    for area in areas:
        images = {number: reader.candidates.images[number] for number in chosen[area.tile]}
        order = sorted(
            images, key=lambda n: (-round(reader.clear(n) / images[n].accuracy.total_m, 3), images[n].id)
        )
        scenes = []
        for number in order:
            image = images[number]
            scene = read_scene(reader.path(number), sigma_m=image.accuracy.total_m)
            stack.callback(scene.image.close)  # type: ignore[attr-defined]
            acquisition = replace(
                scene.acquisition,
                sensor=image.platform,
                acquired_at=image.acquired,
                image_id=image.id,
                sun_elevation_deg=image.sun_deg[0],
                sun_azimuth_deg=image.sun_deg[1],
            )
            scenes.append(replace(scene, acquisition=acquisition))
        if scenes:
            tiles.append(BaseTile(area, scenes, [images[number] for number in order]))
    if not tiles:
        words = "; ".join(reader.left_out[:3])
        raise InputError(
            f"no image of the region can be used: {words}; allow more (--min-clear, --max-cloud)"
        )
    return tiles


def placed_dates(
    tiles: Sequence[BaseTile], heights: GroundHeights, gsd_m: float, work: Work, progress: Progress
) -> PlacedDates:
    """The frame of all dates, from the shifts of the images of every tile against its first."""
    few = OrthoPointOptions(gsd_m, COARSE_FACTOR * gsd_m, points=_TIE_POINTS)
    used: list[BaseTile] = []
    ties: list[tuple[str, str, Array]] = []
    left_out: list[str] = []
    for number, tile in enumerate(tiles):
        part = part_of(progress, number / len(tiles), 1.0 / len(tiles))
        tile, shift_m = _tied(tile, heights, few, work, part)
        found = np.isfinite(shift_m[:, 0])
        for image, is_found in zip(tile.images, found.tolist(), strict=True):
            if not is_found:
                left_out.append(f"{image.id}: too few of its details are found")
        rows = np.flatnonzero(found).tolist()
        used.append(tile.take(rows))
        ties += [(tile.images[0].date, tile.images[row].date, shift_m[row]) for row in rows[1:]]
    of_date = {image.date: image for tile in used for image in tile.images}
    dates = sorted(of_date)
    shifts = DateShifts(
        np.array([dates.index(first) for first, _, _ in ties], dtype=np.int64),
        np.array([dates.index(other) for _, other, _ in ties], dtype=np.int64),
        np.array([shift_m for _, _, shift_m in ties]).reshape(-1, 2),
    )
    images = [of_date[date] for date in dates]
    frames = date_frames([one.accuracy for one in images], [one.orbit for one in images], shifts)
    return PlacedDates(used, dates, frames, left_out)


def _tied(
    tile: BaseTile, heights: GroundHeights, options: OrthoPointOptions, work: Work, progress: Progress
) -> tuple[BaseTile, Array]:
    """A tile with the first image in which most others are found, and their shifts (n, 2) against it."""
    best: tuple[BaseTile, Array] | None = None
    count = 0
    for row in range(min(_MOST_FIRST, len(tile.scenes))):
        turned = tile.take([row, *(i for i in range(len(tile.scenes)) if i != row)])
        shift_m = shifts_of_scenes(turned.scenes, heights, options, progress, work)
        found = int(np.isfinite(shift_m[:, 0]).sum())
        if best is None or found > count:
            best, count = (turned, shift_m), found
        if 2 * count > len(tile.scenes):
            break
    assert best is not None, "a tile has an image"
    return best


def points_of_tiles(
    placed: PlacedDates,
    heights: GroundHeights,
    reader: WindowReader,
    recent: frozenset[str],
    *,
    work: Work,
    progress: Progress,
) -> list[TilePoints]:
    """The points of every tile, with the way into the frame of the base.

    Args:
        placed: tiles and frames of the dates.
        heights: of the ground.
        reader: of the images.
        recent: ids of images of which one must show a point, where two could; see `still_found`.
        work: computes the tasks.
        progress: receives the fraction done and a message.

    Raises:
        NotEnoughPoints: no tile has any.
    """
    gsd_m = reader.archive.gsd_m
    size_km2 = sum(area_km2(tile.area.polygon) for tile in placed.tiles)
    step_m = spacing_m(reader.options, reader.archive, size_km2)
    options = _point_options(reader.options, gsd_m, step_m)
    if placed.frames.orbits > 1:
        options = replace(options, local_sigma_px=_LOCAL_SIGMA_PX)
    parts = []
    for number, tile in enumerate(placed.tiles):
        part = part_of(progress, number / len(placed.tiles), 1.0 / len(placed.tiles))
        for row, production in _productions(tile, heights, options, step_m, work=work, progress=part):
            move_m = placed.move_m(tile.images[row])
            latest = [scene for scene in tile.scenes if scene.acquisition.image_id in recent]
            rows = still_found(production, latest)
            parts.append(TilePoints(production, rows, tile.area.polygon, move_m))
    if not parts:
        what = "points that most dates show; give a larger region, more dates or a smaller --min-share"
        raise NotEnoughPoints(0, 6, what)
    return parts


def _point_options(options: BaseOptions, gsd_m: float, step_m: float) -> OrthoPointOptions:
    return OrthoPointOptions(
        gsd_m,
        COARSE_FACTOR * gsd_m,
        spacing_m=step_m,
        min_views=_LEAST_VIEWS,
        min_share=options.min_share,
    )


def _without_views(error: AmersError) -> None:
    """Go on without an image that shows too little of the squares that are searched."""


def _productions(
    tile: BaseTile,
    heights: GroundHeights,
    options: OrthoPointOptions,
    step_m: float,
    *,
    work: Work,
    progress: Progress,
) -> list[tuple[int, OrthoPoints]]:
    """Points of a tile: of its first image, then of others in squares that have none."""
    made: list[tuple[int, OrthoPoints]] = []
    side_m = 1000.0 * math.sqrt(area_km2(tile.area.polygon))
    around = widened(tile.area.polygon, max(step_m, _LEAST_SQUARES * step_m - side_m) / 2.0)
    scale = np.array(metres_per_degree(tile.area.polygon.centroid.y, 0.0))
    known = np.empty((0, 2))

    def wanted(lon_lat: Array) -> BoolArray:
        inside = np.asarray(shapely.contains_xy(around, lon_lat))
        if not len(known):
            return inside
        apart_m, _ = cKDTree(known * scale).query(lon_lat * scale)
        return np.asarray(inside & (apart_m > _EMPTY * step_m))

    squares = area_km2(tile.area.polygon) * 1e6 / step_m**2
    for row in range(min(_MOST_FIRST, len(tile.scenes))):
        scenes = [tile.scenes[row], *(s for i, s in enumerate(tile.scenes) if i != row)]
        part = part_of(progress, row / _MOST_FIRST, 1.0 / _MOST_FIRST)
        try:
            production = produce_ortho_points(
                scenes, heights, options, part, wanted=wanted, not_found=_without_views, work=work
            )
        except NotEnoughPoints:
            continue
        made.append((row, production))
        known = np.concatenate([known, production.points.lon_lat_h[:, :2]])
        if len(known) >= _ENOUGH * squares:
            break
    return made
