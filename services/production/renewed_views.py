"""New views of the points of a block from registered scenes; positions do not change.

New points of the same scenes join them at the end.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from amers.services.adjustment.block_accuracy import positive_part
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.production.new_points import NewPoints
from amers.services.production.point_views import chips_of, shows_nearly_whole_chip, views_at_levels
from amers.services.types import (
    Array,
    ChipArray,
    ChipSource,
    ControlPoints,
    IntArray,
    Observations,
    SurfaceHeights,
    Views,
    point_chips,
)

MAX_SCENE_TO_CHIP = 1.25
"""A scene this many times coarser than a chip still shows what the chip is sampled for."""


@dataclass(frozen=True)
class SeeingScene:
    """A registered scene and the points that it saw.

    Attributes:
        scene: with its registered model.
        seen: (k,) int64 rows of the points, ascending.
    """

    scene: Scene
    seen: IntArray


@dataclass(frozen=True)
class RenewedViews:
    """Points with new views.

    Attributes:
        points: the points given, with their views and the new ones.
        chips: from the row of a point to its chips, (views, 101, 101) uint16; 0 is nodata.
        gained: for each scene (k,) the rows of the points that have a view of it.
    """

    points: ControlPoints
    chips: Callable[[int], ChipArray]
    gained: tuple[IntArray, ...]


def with_new_views(
    points: ControlPoints, chips: ChipSource, scenes: Sequence[SeeingScene]
) -> RenewedViews:
    """Points with the views that they have, and those of the scenes that saw them, at each sampling.

    A chip shows what the registered model puts at the point, as those of the block's own images do. A
    scene that is much coarser than a chip adds none, and neither does one that shows it incompletely.

    Args:
        points: of one block.
        chips: of these points.
        scenes: registered on these points.
    """
    gsds_m = np.unique(points.views.gsd_m)
    images = [one.scene for one in scenes]
    levels = [_shown(scenes, points.lon_lat_h, float(gsd_m)) for gsd_m in gsds_m]
    new = views_at_levels(images, levels, points.lon_lat_h, gsds_m.tolist())
    cut = chips_of(images, points.lon_lat_h, new)
    views, order = _merged(points.views, new)

    def all_chips(row: int) -> ChipArray:
        chips_of_point = point_chips(points, chips, row).astype(np.uint16, copy=False)
        n_old, n_new = (int(np.diff(of.start)[row]) for of in (points.views, new))
        if n_new:
            chips_of_point = np.concatenate([chips_of_point, cut(row)])
        place = order[views.start[row] : views.start[row + 1]]
        is_new = place >= len(points.views.image)
        first_new = len(points.views.image) + new.start[row] - n_old
        merged: ChipArray = chips_of_point[place - np.where(is_new, first_new, points.views.start[row])]
        return merged

    of_view = np.repeat(np.arange(len(points)), np.diff(new.start))
    gained = tuple(np.unique(of_view[new.image == image]) for image in range(len(scenes)))
    return RenewedViews(replace(points, views=views), all_chips, gained)


def with_new_points(renewed: RenewedViews, new: NewPoints) -> RenewedViews:
    """Points with new views followed by new points of the same block and scenes.

    The frame states what the new points share where that is more than the others do: scenes may see the
    new ones alone.
    """
    first, second = renewed.points, new.points
    n = len(first)
    images = first.views.images
    row_of = {image.image_id: row for row, image in enumerate(images)}
    rows = np.array([row_of[image.image_id] for image in second.views.images])
    second_views = replace(second.views, image=rows[second.views.image], images=images)
    frame, shared_m2 = first.frames[0], second.frames[0].shared_m2
    covering_m2 = frame.shared_m2 + positive_part(shared_m2 - frame.shared_m2)
    points = ControlPoints(
        id=np.arange(n + len(second), dtype=np.int64),
        views=_one_after_the_other(first.views, second_views),
        frames=(replace(frame, shared_m2=covering_m2),),
        chip_files=(),
        surface=_all_surfaces(first, second),
        **{
            name: np.concatenate([getattr(first, name), getattr(second, name)])
            for name in (
                "lon_lat_h",
                "covariance_m2",
                "block",
                "saliency",
                "health",
                "chip_file",
                "chip_row",
            )
        },
    )

    def chips(row: int) -> ChipArray:
        return renewed.chips(row) if row < n else new.chips(row - n)

    return RenewedViews(points, chips, renewed.gained)


def _one_after_the_other(first: Views, second: Views) -> Views:
    """The views of points followed by those of others, of the same images."""
    columns = {
        name: np.concatenate([getattr(first, name), getattr(second, name)])
        for name in ("gsd_m", "image", "incidence_deg", "azimuth_deg", "health")
    }
    start = np.concatenate([first.start, first.start[-1] + second.start[1:]])
    return Views(start=start, images=first.images, **columns)


def _all_surfaces(first: ControlPoints, second: ControlPoints) -> SurfaceHeights | None:
    """The surface at all points; unknown where one part states none."""
    if first.surface is None and second.surface is None:
        return None
    parts = [
        one.surface or SurfaceHeights(np.full(len(one), np.nan), np.full(len(one), np.nan))
        for one in (first, second)
    ]
    return SurfaceHeights(
        np.concatenate([one.height_m for one in parts]), np.concatenate([one.sigma_m for one in parts])
    )


def _shown(scenes: Sequence[SeeingScene], lon_lat_h: Array, gsd_m: float) -> Observations:
    """The points that each scene saw, and shows with nearly whole chips of one ground sampling."""
    fine_enough = [
        one.seen if scene_gsd_m(one.scene) <= MAX_SCENE_TO_CHIP * gsd_m else one.seen[:0]
        for one in scenes
    ]
    point = np.concatenate(fine_enough)
    image = np.repeat(np.arange(len(scenes)), [len(seen) for seen in fine_enough])
    nowhere = Observations(point, image, np.full((len(point), 2), np.nan), np.full(len(point), np.nan))
    images = [one.scene for one in scenes]
    return nowhere.take(shows_nearly_whole_chip(images, nowhere, lon_lat_h, gsd_m))


def _merged(old: Views, new: Views) -> tuple[Views, IntArray]:
    """The views of both, old ones first at every ground sampling; and where each comes from.

    The second is the row of each view among the rows of the old views followed by those of the new.
    """
    n = len(old.start) - 1
    point = np.concatenate([np.repeat(np.arange(n), np.diff(of.start)) for of in (old, new)])
    gsd_m = np.concatenate([old.gsd_m, new.gsd_m])
    order = np.lexsort((gsd_m, point))
    counts = np.diff(old.start) + np.diff(new.start)
    merged = Views(
        start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        gsd_m=gsd_m[order],
        image=np.concatenate([old.image, len(old.images) + new.image])[order],
        incidence_deg=np.concatenate([old.incidence_deg, new.incidence_deg])[order],
        azimuth_deg=np.concatenate([old.azimuth_deg, new.azimuth_deg])[order],
        health=np.concatenate([old.health, new.health])[order],
        images=(*old.images, *new.images),
    )
    return merged, order
