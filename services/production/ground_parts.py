"""Points of a block, measured and cut out in parts of the ground with the images that show them."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import shapely

from amers.services.imagery.scene import Scene, scene_footprint
from amers.services.matching.multi_image import RefinementOptions, refine_on_chips
from amers.services.production.point_views import chips_of, point_views
from amers.services.tasks import Arrays, Work
from amers.services.types import (
    Array,
    ChipArray,
    IntArray,
    Observations,
    Progress,
    Views,
)

_POINTS = 64
"""Points of a part."""


def measure_points(
    scenes: Sequence[Scene],
    lon_lat_h: Array,
    gsd_m: float,
    options: RefinementOptions,
    *,
    work: Work,
    progress: Progress,
) -> tuple[Observations, Array]:
    """Points (n, 3) measured on chips, part by part, and their saliency (n,); see `refine_on_chips`."""
    parts, images = image_parts(scenes, lon_lat_h)

    def arguments(number: int) -> tuple[Any, ...]:
        return [scenes[i] for i in images[number]], lon_lat_h[parts[number]], gsd_m, options

    tasks = [(_measured(number), partial(arguments, number)) for number in range(len(parts))]
    work.run(measure_task, tasks, progress)
    found = [work.kept[_measured(number)] for number in range(len(parts))]
    observations = Observations(
        np.concatenate([part.start + one["point"] for part, one in zip(parts, found, strict=True)]),
        np.concatenate([of[one["image"]] for of, one in zip(images, found, strict=True)]),
        np.concatenate([one["line_sample"] for one in found]),
        np.concatenate([one["sigma_px"] for one in found]),
    )
    return observations, np.concatenate([one["saliency"] for one in found])


def image_parts(scenes: Sequence[Scene], lon_lat_h: Array) -> tuple[list[slice], list[IntArray]]:
    """The parts of points (n, 3) near each other, and rows of the images that may show each part."""
    tree = shapely.STRtree(np.array([shapely.Polygon(scene_footprint(scene)) for scene in scenes]))
    parts = [slice(first, first + _POINTS) for first in range(0, len(lon_lat_h), _POINTS)]
    return parts, [_images_near(tree, lon_lat_h[part]) for part in parts]


def _images_near(tree: shapely.STRtree, lon_lat_h: Array) -> IntArray:
    """Rows of the images whose footprints meet the rectangle around points (n, 3)."""
    around = shapely.MultiPoint(lon_lat_h[:, :2]).envelope
    turned = [shapely.transform(around, lambda xy, t=turn: xy + [t, 0.0]) for turn in (-360, 0, 360)]
    return np.unique(tree.query(np.array(turned), predicate="intersects")[1]).astype(np.int64)


def measure_task(
    scenes: Sequence[Scene],
    lon_lat_h: Array,
    gsd_m: float,
    options: RefinementOptions,
) -> Arrays:
    """The points of one part, measured on chips."""
    found = refine_on_chips(scenes, lon_lat_h, gsd_m, options)
    return {**vars(found.observations), "saliency": found.saliency}


@dataclass(frozen=True)
class CutPoints:
    """Views of points and their chips.

    Attributes:
        views: of the points.
        chips: from the row of a point to its chips, (views, 101, 101) uint16; 0 is nodata.
    """

    views: Views
    chips: Callable[[int], ChipArray]


def cut_points(
    scenes: Sequence[Scene],
    lon_lat_h: Array,
    shown: Observations,
    gsds_m: tuple[float, float],
    *,
    work: Work,
    progress: Progress,
) -> CutPoints:
    """The views of points, cut part by part.

    Args:
        scenes: with adjusted models.
        lon_lat_h: (n, 3) the points, those near each other following each other.
        shown: which images show the whole fine chip; `point` is the row of `lon_lat_h`.
        gsds_m: ground samplings of the chips, finest first, metres.
        work: computes the tasks and keeps their results.
        progress: receives the fraction done.
    """
    firsts = np.append(np.arange(0, len(lon_lat_h), _POINTS), len(lon_lat_h))
    parts = [slice(first, last) for first, last in itertools.pairwise(firsts.tolist())]
    images = []
    of_parts = []
    for part, rows in zip(parts, itertools.pairwise(np.searchsorted(shown.point, firsts)), strict=True):
        own = shown.take(np.arange(*rows))
        images.append(np.unique(own.image))
        of_parts.append(
            replace(own, point=own.point - part.start, image=np.searchsorted(images[-1], own.image))
        )

    def arguments(number: int) -> tuple[Any, ...]:
        own = [scenes[i] for i in images[number]]
        return own, lon_lat_h[parts[number]], of_parts[number], gsds_m

    tasks = [(_cut(number), partial(arguments, number)) for number in range(len(parts))]
    work.run(cut_task, tasks, progress)
    found = [work.kept[_cut(number)] for number in range(len(parts))]
    counts = np.concatenate([np.diff(arrays["start"]) for arrays in found])
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)

    def joined(name: str) -> Array:
        return np.concatenate([arrays[name] for arrays in found])

    views = Views(
        start=start,
        gsd_m=joined("gsd_m"),
        image=np.concatenate([of[arrays["image"]] for of, arrays in zip(images, found, strict=True)]),
        incidence_deg=joined("incidence_deg"),
        azimuth_deg=joined("azimuth_deg"),
        health=np.ones(start[-1]),
        images=tuple(scene.acquisition for scene in scenes),
    )

    def chips(row: int) -> ChipArray:
        arrays = found[row // _POINTS]
        of_part = row % _POINTS
        return np.asarray(arrays["chips"][arrays["start"][of_part] : arrays["start"][of_part + 1]])

    return CutPoints(views, chips)


def cut_task(
    scenes: Sequence[Scene], lon_lat_h: Array, shown: Observations, gsds_m: tuple[float, float]
) -> Arrays:
    """Views and chips of the points of one part."""
    views = point_views(scenes, shown, lon_lat_h, gsds_m)
    cut = chips_of(scenes, lon_lat_h, views)
    return {
        "start": views.start,
        "gsd_m": views.gsd_m,
        "image": views.image,
        "incidence_deg": views.incidence_deg,
        "azimuth_deg": views.azimuth_deg,
        "chips": np.concatenate([cut(row) for row in range(len(lon_lat_h))]),
    }


def _measured(part: int) -> str:
    return f"measures/{part:06d}"


def _cut(part: int) -> str:
    return f"points/{part:06d}"
