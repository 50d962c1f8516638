"""The views of produced points: the images that show them, and their chips."""

from collections.abc import Callable, Sequence

import numpy as np

from amers.services.errors import InputError
from amers.services.imagery.scene import Scene, view_direction
from amers.services.imagery.source import render_chip
from amers.services.matching.multi_image import chip_inside, nearly_whole, stored_chip
from amers.services.types import (
    Array,
    BoolArray,
    ChipArray,
    Observations,
    Views,
)


def check_image_names(scenes: Sequence[Scene]) -> None:
    """Raise `InputError` when two images of a block have one name."""
    names = [scene.acquisition.image_id for scene in scenes]
    if len(set(names)) < len(names):
        raise InputError(
            f"the images of a block must have different names, found {', '.join(sorted(names))}: rename "
            "one of them"
        )


def shows_chip(
    scenes: Sequence[Scene], observations: Observations, lon_lat_h: Array, gsd_m: float
) -> BoolArray:
    """Which observations (m,) are of an image that shows the whole chip of their point.

    Args:
        scenes: the images.
        observations: `point` is the row of `lon_lat_h`.
        lon_lat_h: (n, 3) the points; NaN where unknown.
        gsd_m: ground sampling of the chips, metres.
    """
    whole = np.zeros(len(observations), dtype=np.bool_)
    for image, scene in enumerate(scenes):
        rows = np.flatnonzero(observations.image == image)
        ground = lon_lat_h[observations.point[rows]]
        whole[rows] = chip_inside(scene.model, scene.image.shape, ground, gsd_m)
    return whole


def shows_nearly_whole_chip(
    scenes: Sequence[Scene], observations: Observations, lon_lat_h: Array, gsd_m: float
) -> BoolArray:
    """Which observations (m,) are of an image that shows the chip, at most a tenth of it missing.

    The arguments are those of `shows_chip`.
    """
    shown = shows_chip(scenes, observations, lon_lat_h, gsd_m)
    for row in np.flatnonzero(shown):
        scene = scenes[observations.image[row]]
        chip = render_chip(scene.image, scene.model, lon_lat_h[observations.point[row]], gsd_m)
        shown[row] = nearly_whole(chip)
    return shown


def point_views(
    scenes: Sequence[Scene], observations: Observations, lon_lat_h: Array, gsds_m: Sequence[float]
) -> Views:
    """The views of points: one for every observation and ground sampling whose chip is whole.

    Args:
        scenes: the images.
        observations: `point` is the row of `lon_lat_h`.
        lon_lat_h: (n, 3) the points.
        gsds_m: ground samplings of the chips, finest first, metres.
    """
    levels = [observations.take(shows_chip(scenes, observations, lon_lat_h, g)) for g in gsds_m]
    return views_at_levels(scenes, levels, lon_lat_h, gsds_m)


def views_at_levels(
    scenes: Sequence[Scene], levels: Sequence[Observations], lon_lat_h: Array, gsds_m: Sequence[float]
) -> Views:
    """The views of points: one for every observation of every ground sampling.

    Args:
        scenes: the images.
        levels: for each ground sampling, which images show the chips; `point` is the row of `lon_lat_h`.
        lon_lat_h: (n, 3) the points.
        gsds_m: ground samplings of the chips, finest first, metres.
    """
    point = np.concatenate([level.point for level in levels])
    gsd_m = np.repeat(np.array(gsds_m), [len(level) for level in levels])
    order = np.lexsort((gsd_m, point))
    point, gsd_m = point[order], gsd_m[order]
    image = np.concatenate([level.image for level in levels])[order]
    incidence, azimuth = np.empty(len(image)), np.empty(len(image))
    for i, scene in enumerate(scenes):
        rows = np.flatnonzero(image == i)
        ground = lon_lat_h[point[rows]]
        incidence[rows], azimuth[rows] = view_direction(scene.model, scene.model.project(ground), ground)
    return Views(
        start=np.searchsorted(point, np.arange(len(lon_lat_h) + 1)).astype(np.int64),
        gsd_m=gsd_m,
        image=image,
        incidence_deg=incidence,
        azimuth_deg=azimuth,
        health=np.ones(len(image)),
        images=tuple(scene.acquisition for scene in scenes),
    )


def chips_of(scenes: Sequence[Scene], lon_lat_h: Array, views: Views) -> Callable[[int], ChipArray]:
    """From the row of a point to the chips of its views, (views, 101, 101), cut when asked for.

    Args:
        scenes: the images of the views, with the models that the points refer to.
        lon_lat_h: (n, 3) the points.
        views: of the points.
    """

    def cut(row: int) -> ChipArray:
        rows = slice(views.start[row], views.start[row + 1])
        of_views = zip(views.image[rows], views.gsd_m[rows], strict=True)
        ground = lon_lat_h[row]
        return np.stack(
            [
                stored_chip(render_chip(scenes[i].image, scenes[i].model, ground, float(gsd_m)))
                for i, gsd_m in of_views
            ]
        )

    return cut
