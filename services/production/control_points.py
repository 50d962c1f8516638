"""Control from older blocks: their points, matched by chips in the images of a new block."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from amers.services.adjustment.control_ground import ControlGround, joined_ground
from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.errors import NotEnoughPoints
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import CachedImage
from amers.services.matching.control_points import ChipSearch, MatchingOptions, match_points
from amers.services.matching.correlate import FOUND
from amers.services.matching.multi_image import chip_inside
from amers.services.tasks import Arrays, Work
from amers.services.types import (
    ChipSource,
    ControlPoints,
    Frame,
    IntArray,
    Observations,
    Progress,
    joined_observations,
)

_LARGEST_RADIUS_PX = 150
_MARGIN_PX = 4
"""Added to the search radius: images that agree still differ by a few chip pixels."""
_MIN_FOUND = 3
"""Fewest control points that place a block."""


@dataclass(frozen=True)
class ControlBlock:
    """An older block that a new one is placed by.

    Attributes:
        name: for messages and reports.
        points: of the block.
        chips: of the points.
    """

    name: str
    points: ControlPoints
    chips: ChipSource


def find_control(
    scenes: Sequence[Scene],
    frame: Frame,
    blocks: Sequence[ControlBlock],
    *,
    first_point: int,
    work: Work,
    progress: Progress,
) -> tuple[Observations, ControlGround]:
    """Points of older blocks in the images of a new one, as observations and known ground.

    The images agree with each other, so that all of them show the ground displaced by the frames of both
    blocks, within which the chips are searched.

    Args:
        scenes: with models that agree.
        frame: of the scenes on the Earth.
        blocks: at least one.
        first_point: number of the first point of the observations.
        work: computes the tasks and keeps their results.
        progress: receives the fraction done.

    Returns:
        The points that two images or more show.

    Raises:
        NotEnoughPoints: fewer than three points of the blocks are found.
    """
    searches = [_search(scenes, frame, block) for block in blocks]

    def arguments(number: int, image: int) -> tuple[Any, ...]:
        search = searches[number]
        shown = search.block.points.take(search.shown[image])
        return scenes[image], shown, search.block.chips, search.gsd_m, search.radius_px

    both = [(number, image) for number in range(len(blocks)) for image in range(len(scenes))]
    tasks = [(_name(number, image), partial(arguments, number, image)) for number, image in both]
    work.run(control_task, tasks, progress)

    observations: list[Observations] = []
    ground: list[ControlGround] = []
    for number, search in enumerate(searches):
        results = [work.kept[_name(number, image)] for image in range(len(scenes))]
        found, rows = _found(search, results)
        first = first_point + sum(map(len, ground))
        observations.append(replace(found, point=first + found.point))
        ground.append(_known(search.block, rows, first))
    count = sum(map(len, ground))
    if count < _MIN_FOUND:
        names = ", ".join(block.name for block in blocks)
        raise NotEnoughPoints(count, _MIN_FOUND, f"control points of {names} in two images or more")
    return joined_observations(observations), joined_ground(ground)


@dataclass(frozen=True)
class _Search:
    """What is searched of a block: chips of one sampling, how far, and for each image which points."""

    block: ControlBlock
    gsd_m: float
    radius_px: int
    shown: list[IntArray]


def _search(scenes: Sequence[Scene], frame: Frame, block: ControlBlock) -> _Search:
    """Chips within three standard deviations of both frames, where images show them whole."""
    points = block.points
    gsd_m = float(points.views.gsd_m.min())
    has_chip = np.zeros(len(points), dtype=np.bool_)
    of_point = np.repeat(np.arange(len(points)), np.diff(points.views.start))
    has_chip[of_point[points.views.gsd_m == gsd_m]] = True
    variance_m2 = [np.nan_to_num(np.diagonal(of.covariance_m2)).max() for of in (frame, *points.frames)]
    needed_px = MAX_ERROR_SIGMAS * np.sqrt(variance_m2[0] + max(variance_m2[1:])) / gsd_m
    radius_px = int(min(np.ceil(needed_px) + _MARGIN_PX, _LARGEST_RADIUS_PX))
    shown = []
    for scene in scenes:
        inside = chip_inside(scene.model, scene.image.shape, points.lon_lat_h, gsd_m, radius_px)
        shown.append(np.flatnonzero(inside & has_chip))
    return _Search(block, gsd_m, radius_px, shown)


def _found(search: _Search, results: Sequence[Arrays]) -> tuple[Observations, IntArray]:
    """Observations of the points that two images or more show, numbered from 0, and their rows."""
    of_image = zip(search.shown, results, strict=True)
    point = np.concatenate([rows[one["row"]] for rows, one in of_image])
    image = np.repeat(np.arange(len(results)), [len(one["row"]) for one in results])
    count = np.bincount(point, minlength=len(search.block.points))
    order = np.lexsort((image, point))
    order = order[count[point[order]] >= 2]
    rows, number = np.unique(point[order], return_inverse=True)
    line_sample = np.concatenate([one["line_sample"] for one in results])[order]
    sigma_px = np.concatenate([one["sigma_px"] for one in results])[order]
    return Observations(number.astype(np.int64), image[order], line_sample, sigma_px), rows


def control_task(
    scene: Scene, points: ControlPoints, chips: ChipSource, gsd_m: float, radius_px: int
) -> Arrays:
    """The points of a block that one image shows: rows, positions and sigmas."""
    if len(points) == 0:
        return {"row": np.empty(0, np.int64), "line_sample": np.empty((0, 2)), "sigma_px": np.empty(0)}
    search = ChipSearch(CachedImage(scene.image), scene.model, scene.acquisition, gsd_m, radius_px)
    matches = match_points(search, points, chips, MatchingOptions())
    rows = np.flatnonzero(matches.reason == FOUND)
    return {
        "row": rows,
        "line_sample": matches.line_sample[rows],
        "sigma_px": matches.sigma_px[rows],
    }


def _known(block: ControlBlock, rows: IntArray, first: int) -> ControlGround:
    points = block.points
    return ControlGround(
        point=first + np.arange(len(rows)),
        lon_lat_h=points.lon_lat_h[rows],
        covariance_m2=points.covariance_m2[rows],
        source=points.block[rows],
        frames=points.frames,
        names=tuple(f"{block.name}:{identity}" for identity in points.id[rows]),
    )


def _name(block: int, image: int) -> str:
    return f"control/{block:02d}-{image:06d}"
