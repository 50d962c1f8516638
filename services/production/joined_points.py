"""Points of several tiles of ortho-images, joined to one block in one frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.spatial import cKDTree

from amers.services.errors import NotEnoughPoints
from amers.services.geodesy import ecef_from_lon_lat_h, move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import render_chip
from amers.services.matching.multi_image import chip_inside, nearly_whole
from amers.services.production.ortho_production import GroundHeights, OrthoPoints
from amers.services.types import Acquisition, Array, ChipArray, ControlPoints, Frame, IntArray, Views

_LEAST_IMAGES = 2
_LATEST = 2
"""Latest images that must contradict a point."""


@dataclass(frozen=True)
class TilePoints:
    """The points of one tile, and what becomes of them.

    Attributes:
        production: with the positions of its first image.
        rows: (n,) of its points that are taken.
        polygon: longitude and latitude; points beyond it belong to other tiles.
        move_m: (2,) east, north, from the first image into the frame of the block.
    """

    production: OrthoPoints
    rows: IntArray
    polygon: shapely.Geometry
    move_m: Array


def joined_points(
    tiles: Sequence[TilePoints], heights: GroundHeights, frame: Frame, min_distance_m: float
) -> tuple[ControlPoints, Callable[[int], ChipArray]]:
    """The points of all tiles, and from their rows to their chips.

    Chips stay as they are: they show the same detail, wherever the frame places it. Heights are those of
    the ground where the points come to lie.

    Args:
        tiles: of one block; of points nearer to each other than `min_distance_m`, the first stays.
        heights: of the ground.
        frame: of the block.
        min_distance_m: on the ground.

    Raises:
        NotEnoughPoints: no point lies in its polygon, on ground of known height.
    """
    parts: list[ControlPoints] = []
    source: list[tuple[int, int]] = []
    placed = np.empty((0, 3))
    images: dict[str, Acquisition] = {}
    for number, tile in enumerate(tiles):
        points = tile.production.points
        move_m = np.tile([*tile.move_m, 0.0], (len(points), 1))
        lon_lat_h = move_metres(points.lon_lat_h, move_m)
        lon_lat_h[:, 2] = heights.at(lon_lat_h[:, :2])
        covariance_m2 = points.covariance_m2.copy()
        covariance_m2[:, 2, 2] = heights.sigma_m(lon_lat_h[:, :2]) ** 2
        points = replace(points, lon_lat_h=lon_lat_h, covariance_m2=covariance_m2, frames=(frame,))
        inside = np.asarray(shapely.contains_xy(tile.polygon, lon_lat_h[:, :2]))
        rows = tile.rows[(inside & np.isfinite(lon_lat_h[:, 2]))[tile.rows]]
        rows = rows[_far_from(lon_lat_h[rows], placed, min_distance_m)]
        images |= {one.image_id: one for one in points.views.images}
        parts.append(_numbered(points.take(rows), list(images)))
        source += [(number, row) for row in rows.tolist()]
        placed = np.concatenate([placed, lon_lat_h[rows]])
    if not source:
        raise NotEnoughPoints(0, 1, "points in the area, on ground of known height")

    def chips(row: int) -> ChipArray:
        number, of_tile = source[row]
        return tiles[number].production.chips(of_tile)

    return _concatenated(parts, tuple(images.values())), chips


def still_found(production: OrthoPoints, latest: Sequence[Scene]) -> IntArray:
    """Rows (n,) of the points that two images show at least, and that the latest ones do not contradict.

    A point has vanished where two or more of the latest show its whole chip, and it was found in none.

    Args:
        production: of the latest and earlier images.
        latest: images, of which the production has those that show its points.
    """
    points = production.points
    of_view = np.repeat(np.arange(len(points)), np.diff(points.views.start))
    shown = np.zeros(len(points), dtype=np.int64)
    found = np.zeros(len(points), dtype=np.bool_)
    pairs = np.unique(np.column_stack([of_view, points.views.image]), axis=0)
    images = np.bincount(pairs[:, 0], minlength=len(points))
    gsd_m = production.gsds_m[0]
    for scene in latest:
        whole = chip_inside(scene.model, scene.image.shape, points.lon_lat_h, gsd_m)
        for row in np.flatnonzero(whole).tolist():
            chip = render_chip(scene.image, scene.model, points.lon_lat_h[row], gsd_m)
            shown[row] += nearly_whole(chip)
        names = [one.image_id for one in points.views.images]
        if scene.acquisition.image_id in names:
            image = names.index(scene.acquisition.image_id)
            found[of_view[points.views.image == image]] = True
    return np.flatnonzero((images >= _LEAST_IMAGES) & (found | (shown < _LATEST)))


def _far_from(lon_lat_h: Array, placed: Array, least_m: float) -> IntArray:
    """Rows of points that no placed one is near."""
    if not len(placed):
        return np.arange(len(lon_lat_h))
    nearest_m, _ = cKDTree(ecef_from_lon_lat_h(placed)).query(ecef_from_lon_lat_h(lon_lat_h))
    return np.flatnonzero(nearest_m >= least_m)


def _numbered(points: ControlPoints, names: list[str]) -> ControlPoints:
    """Points whose images are numbered by these names."""
    views = points.views
    number = np.array([names.index(one.image_id) for one in views.images], dtype=np.int64)
    return replace(points, views=replace(views, image=number[views.image]))


def _concatenated(parts: Sequence[ControlPoints], images: tuple[Acquisition, ...]) -> ControlPoints:
    def column(name: str) -> Array:
        return np.concatenate([getattr(part, name) for part in parts])

    def of_views(name: str) -> Array:
        return np.concatenate([getattr(part.views, name) for part in parts])

    counts = np.concatenate([np.diff(part.views.start) for part in parts])
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    n = len(counts)
    views = Views(
        start=start,
        images=images,
        gsd_m=of_views("gsd_m"),
        image=of_views("image").astype(np.int64),
        incidence_deg=of_views("incidence_deg"),
        azimuth_deg=of_views("azimuth_deg"),
        health=of_views("health"),
    )
    used, number = np.unique(views.image, return_inverse=True)
    views = replace(
        views, image=number.astype(np.int64), images=tuple(images[row] for row in used.tolist())
    )
    return ControlPoints(
        id=np.arange(n, dtype=np.int64),
        lon_lat_h=column("lon_lat_h"),
        covariance_m2=column("covariance_m2"),
        block=np.zeros(n, dtype=np.int64),
        frames=parts[0].frames,
        saliency=column("saliency"),
        health=column("health"),
        views=views,
        chip_file=np.zeros(n, dtype=np.int64),
        chip_row=start[:-1].copy(),
        chip_files=("chips",),
    )
