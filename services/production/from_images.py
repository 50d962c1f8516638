"""BLOCK OF IMAGES IN -> NEW POINTS OUT: tie, adjust, refine on chips, choose, cut."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from services.adjustment.bundle import BlockAdjustment, BlockOptions, adjust_block
from services.adjustment.intersection import Intersection, intersect
from services.conventions import CHIP_SIZE
from services.errors import InputError, NotEnoughPoints
from services.geodesy import box_around, continuous, east_north_up
from services.imagery.scene import Scene, scene_gsd_m, view_direction
from services.imagery.source import render_chip
from services.matching.multi_image import (
    RefinementOptions,
    chip_inside,
    chip_saliency,
    refine_on_chips,
    stored_chip,
)
from services.matching.predict import rank_in_group
from services.matching.tie_points import FeatureOptions, find_tie_points
from services.sensors.base import SensorModel
from services.types import (
    Array,
    ChipArray,
    ControlPoints,
    IntArray,
    Observations,
    Progress,
    Views,
    no_progress,
    part_of,
)


@dataclass(frozen=True)
class ProductionOptions:
    """How points are produced.

    Attributes:
        fine_gsd_m, coarse_gsd_m: ground samplings of the chips.
        spacing_m: side of the squares of ground that get a point each; None cuts the ground into about
            `points` of them.
        points: how many points are aimed at when there is no spacing.
        candidates: how many tie points of every square are tried.
        min_views: images that must see a point.
        min_saliency: of a point's chip.
        max_sigma_m: largest horizontal standard deviation of a point within the block.
        max_sigma_up_m: largest vertical one.
        features, block, refinement: of the stages.
    """

    fine_gsd_m: float = 2.0
    coarse_gsd_m: float = 20.0
    spacing_m: float | None = None
    points: int = 300
    candidates: int = 3
    min_views: int = 2
    min_saliency: float = 0.05
    max_sigma_m: float = 3.0
    max_sigma_up_m: float = 10.0
    features: FeatureOptions = field(default_factory=FeatureOptions)
    block: BlockOptions = field(default_factory=BlockOptions)
    refinement: RefinementOptions = field(default_factory=RefinementOptions)


@dataclass(frozen=True)
class RelativeAccuracy:
    """How well the images of a block agree.

    Attributes:
        tie_points: points seen in two images or more.
        before_px: median distance between rays and tie points, with the models as delivered, pixels.
        after_px: the same with the adjusted models.
        refined_px: the same for the block's points, measured on chips.
        frame_sigma_m: how well the frame of the block is known, from what the images' models promise,
            one standard deviation a coordinate on the ground.
    """

    tie_points: int
    before_px: float
    after_px: float
    refined_px: float
    frame_sigma_m: float


@dataclass(frozen=True)
class Production:
    """The points of a block.

    Attributes:
        points: in no particular order; `chip_file` and `chip_row` are as if the chips of all points
            followed each other in one file.
        chips: from the row of a point to its chips, (views, 101, 101) uint16; 0 is nodata.
        adjustment: of the images; its models are those the points refer to.
        relative_accuracy: how well the images agree.
        outline: (m, 2) lon, lat of a rectangle that holds the points, counter-clockwise, not closed.
    """

    points: ControlPoints
    chips: Callable[[int], ChipArray]
    adjustment: BlockAdjustment
    relative_accuracy: RelativeAccuracy
    outline: Array


def produce_points(
    scenes: Sequence[Scene],
    options: ProductionOptions = ProductionOptions(),
    progress: Progress = no_progress,
) -> Production:
    """Make control points with chips out of overlapping images and nothing else.

    Tie points and one adjustment bring the images together. Salient, well spread ones are then
    measured again where it matters, chip against chip, the images adjusted on these measures, and the
    points intersected. The frame of the block is what the images' own models say on average.

    Args:
        scenes: two or more, with models as delivered.
        options: of the block.
        progress: told where the work stands.

    Raises:
        InputError: fewer than two scenes, or two of the same name.
        NotEnoughPoints: the images have too little in common.
    """
    _check(scenes)
    ties = find_tie_points(scenes, options.features, part_of(progress, 0.0, 0.5))
    if len(ties) == 0:
        raise NotEnoughPoints(
            0, options.block.min_points, "tie points: the images have nothing in common"
        )
    progress(0.5, "adjusting the block")
    first = _adjusted(scenes, [s.model for s in scenes], ties, options)
    before = intersect([s.model for s in scenes], ties, int(ties.point[-1]) + 1)

    candidates = _candidates(scenes, first, ties, options)
    measured = refine_on_chips(
        scenes,
        first.models,
        candidates,
        options.fine_gsd_m,
        options.refinement,
        progress=part_of(progress, 0.5, 0.4),
    )
    progress(0.9, "adjusting the block on its chips")
    final = _adjusted(scenes, [s.model for s in scenes], measured, options)
    kept = measured.take(final.active)
    points = intersect(final.models, _with_sigma(kept, final.sigma_px), len(candidates))
    chosen = _chosen(scenes, final, points, kept, options)
    relative = RelativeAccuracy(
        tie_points=int(np.isfinite(first.lon_lat_h[:, 0]).sum()),
        before_px=_median_px(before.residual_px),
        after_px=_median_px(first.residual_px),
        refined_px=_median_px(final.residual_px[final.active]),
        frame_sigma_m=float(np.sum([s.sigma_m**-2.0 for s in scenes]) ** -0.5),
    )
    progress(1.0, f"{len(chosen)} points")
    return _finished(scenes, final, points, kept, chosen, relative, options)


def _check(scenes: Sequence[Scene]) -> None:
    names = [scene.acquisition.image_id for scene in scenes]
    if len(names) < 2:
        raise InputError(f"{len(names)} image given, at least 2 needed to make points")
    if len(set(names)) < len(names):
        raise InputError(f"images of a block must have different names, not {', '.join(sorted(names))}")


def _adjusted(
    scenes: Sequence[Scene],
    models: Sequence[SensorModel],
    observations: Observations,
    options: ProductionOptions,
) -> BlockAdjustment:
    sigma_px = np.array([scene.sigma_m / scene_gsd_m(scene) for scene in scenes])
    shapes = [scene.image.shape for scene in scenes]
    return adjust_block(models, shapes, observations, sigma_px, options.block)


def _with_sigma(observations: Observations, scale: float) -> Observations:
    """Observations with the sigmas the adjustment found.

    It sees what two rays do across each other, not along: half the stated sigma is kept in any case.
    """
    return Observations(
        observations.point,
        observations.image,
        observations.line_sample,
        observations.sigma_px * max(scale, 0.5),
    )


def _median_px(residual: Array) -> float:
    return float(np.nanmedian(np.linalg.norm(residual, axis=1)))


def _candidates(
    scenes: Sequence[Scene], block: BlockAdjustment, ties: Observations, options: ProductionOptions
) -> Array:
    """Ground positions (n, 3) of the tie points to try: the best few of every square of ground."""
    active = ties.take(block.active)
    rays = np.bincount(active.point, minlength=len(block.lon_lat_h))
    residual = np.linalg.norm(block.residual_px[block.active], axis=1)
    worst = np.zeros(len(block.lon_lat_h))
    np.maximum.at(worst, active.point, residual)
    sigma_m = np.sqrt(np.diagonal(block.point_covariance_m2, 0, 1, 2))
    usable = np.isfinite(block.lon_lat_h[:, 0]) & (rays >= 2)
    usable &= (sigma_m[:, :2].max(axis=1) <= options.max_sigma_m) & (
        sigma_m[:, 2] <= options.max_sigma_up_m
    )
    rows = np.flatnonzero(usable)
    inside = np.zeros(len(rows), dtype=np.int64)
    for scene, model in zip(scenes, block.models, strict=True):
        inside += chip_inside(model, scene.image.shape, block.lon_lat_h[rows], options.fine_gsd_m)
    rows, inside = rows[inside >= options.min_views], inside[inside >= options.min_views]
    if len(rows) < options.block.min_points:
        raise NotEnoughPoints(
            len(rows),
            options.block.min_points,
            f"tie points whose chip of {CHIP_SIZE * options.fine_gsd_m:g} m is seen whole by "
            f"{options.min_views} images",
        )
    square = _squares(block.lon_lat_h[rows], options)
    return block.lon_lat_h[rows[rank_in_group(square, inside - worst[rows]) < options.candidates]]


def _squares(lon_lat_h: Array, options: ProductionOptions) -> IntArray:
    """Number of the square of ground every point (n, 3) lies in."""
    enu = east_north_up(lon_lat_h, np.median(continuous(lon_lat_h), axis=0))[:, :2]
    if options.spacing_m is not None:
        side = options.spacing_m
    else:
        extent = np.ptp(enu, axis=0) + 1.0
        side = float(np.sqrt(extent[0] * extent[1] / options.points))
    cell = np.floor(enu / side).astype(np.int64)
    return np.unique(cell, axis=0, return_inverse=True)[1].astype(np.int64)


def _chosen(
    scenes: Sequence[Scene],
    block: BlockAdjustment,
    points: Intersection,
    kept: Observations,
    options: ProductionOptions,
) -> list[tuple[int, float]]:
    """The best point of every square of ground, with its saliency."""
    sigma_m = np.sqrt(np.diagonal(points.covariance_m2, 0, 1, 2))
    good = np.isfinite(points.lon_lat_h[:, 0]) & (points.rays >= options.min_views)
    good &= sigma_m[:, :2].max(axis=1) <= options.max_sigma_m
    good &= sigma_m[:, 2] <= options.max_sigma_up_m
    rows = np.flatnonzero(good)
    saliency = np.zeros(len(rows))
    for number, row in enumerate(rows):
        image = kept.image[kept.point == row][0]
        chip = render_chip(
            scenes[image].image, block.models[image], points.lon_lat_h[row], options.fine_gsd_m
        )
        saliency[number] = chip_saliency(chip)
    salient = saliency >= options.min_saliency
    rows, saliency = rows[salient], saliency[salient]
    if len(rows) < options.block.min_points:
        raise NotEnoughPoints(
            len(rows), options.block.min_points, f"salient points out of {len(points.rays)} candidates"
        )
    square = _squares(points.lon_lat_h[rows], options)
    preference = points.rays[rows] + saliency
    best = np.flatnonzero(rank_in_group(square, preference) == 0)
    return [(int(rows[b]), float(saliency[b])) for b in best]


def _finished(
    scenes: Sequence[Scene],
    block: BlockAdjustment,
    intersection: Intersection,
    kept: Observations,
    chosen: list[tuple[int, float]],
    relative: RelativeAccuracy,
    options: ProductionOptions,
) -> Production:
    """Points, views and the way to their chips."""
    rows = np.array([row for row, _ in chosen])
    lon_lat_h = intersection.lon_lat_h[rows]
    image, gsd_m, start = _views(scenes, block, lon_lat_h, rows, kept, options)
    incidence, azimuth = _directions(block, lon_lat_h, image, start)
    taken = tuple(scene.acquisition for scene in scenes)
    views = Views(start, gsd_m, image, incidence, azimuth, np.ones(len(image)), taken)
    points = ControlPoints(
        id=np.arange(len(rows), dtype=np.int64),
        lon_lat_h=lon_lat_h,
        covariance_m2=intersection.covariance_m2[rows],
        saliency=np.array([saliency for _, saliency in chosen]),
        health=np.ones(len(rows)),
        views=views,
        chip_file=np.zeros(len(rows), dtype=np.int64),
        chip_row=start[:-1].copy(),
        chip_files=("chips",),
    )

    def cut(row: int) -> ChipArray:
        return np.stack(
            [
                stored_chip(render_chip(scenes[i].image, block.models[i], lon_lat_h[row], float(g)))
                for i, g in zip(
                    image[start[row] : start[row + 1]], gsd_m[start[row] : start[row + 1]], strict=True
                )
            ]
        )

    return Production(points, cut, block, relative, box_around(lon_lat_h))


def _views(
    scenes: Sequence[Scene],
    block: BlockAdjustment,
    lon_lat_h: Array,
    rows: IntArray,
    kept: Observations,
    options: ProductionOptions,
) -> tuple[IntArray, Array, IntArray]:
    """Image and ground sampling of every view, points after points, and where each point's begin."""
    whole = np.zeros((len(scenes), 2, len(rows)), dtype=bool)
    for i, (scene, model) in enumerate(zip(scenes, block.models, strict=True)):
        for g, gsd_m in enumerate((options.fine_gsd_m, options.coarse_gsd_m)):
            whole[i, g] = chip_inside(model, scene.image.shape, lon_lat_h, gsd_m)
    image, gsd, start = [], [], [0]
    for number, row in enumerate(rows):
        seen_by = kept.image[kept.point == row]
        for g, gsd_m in enumerate((options.fine_gsd_m, options.coarse_gsd_m)):
            valid = [int(i) for i in seen_by if whole[i, g, number]]
            image += valid
            gsd += [gsd_m] * len(valid)
        start.append(len(image))
    return np.array(image, dtype=np.int64), np.array(gsd), np.array(start, dtype=np.int64)


def _directions(
    block: BlockAdjustment, lon_lat_h: Array, image: IntArray, start: IntArray
) -> tuple[Array, Array]:
    """Incidence and azimuth of every view."""
    ground = np.repeat(lon_lat_h, np.diff(start), axis=0)
    incidence = np.empty(len(image))
    azimuth = np.empty(len(image))
    for i, model in enumerate(block.models):
        views = np.flatnonzero(image == i)
        incidence[views], azimuth[views] = view_direction(
            model, model.project(ground[views]), ground[views]
        )
    return incidence, azimuth
