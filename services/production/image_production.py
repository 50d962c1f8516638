"""Production of points from a block of images: tie, adjust, measure on chips, select, cut."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from amers.services.adjustment.block_problem import BlockOptions
from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.control_ground import ControlGround, joined_ground
from amers.services.adjustment.intersection import intersect, residuals_and_derivatives
from amers.services.adjustment.known_images import KnownImages
from amers.services.adjustment.observation_noise import found_noise
from amers.services.adjustment.parameters import image_parameters
from amers.services.conventions import CHIP_SIZE
from amers.services.errors import InputError, NotEnoughPoints
from amers.services.geodesy import box_around
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.matching.ground_features import FeatureOptions
from amers.services.matching.multi_image import RefinementOptions, chip_inside
from amers.services.matching.predict import rank_in_group
from amers.services.production.block_residuals import ImageFit, PointFits, image_fits, point_fits
from amers.services.production.chip_sampling import chip_samplings_m
from amers.services.production.control import Control, MeasuredPoints, with_control
from amers.services.production.ground_cells import GroundGrid
from amers.services.production.ground_parts import cut_points, measure_points
from amers.services.production.height_control import ortho_heights
from amers.services.production.image_passes import dates_of_points, image_passes
from amers.services.production.point_squares import point_squares, ties_in_squares
from amers.services.production.point_surfaces import surfaces_at
from amers.services.production.point_views import check_image_names, shows_chip
from amers.services.production.tie_points import find_tie_points, joined_ties
from amers.services.quality.density import GroundMask
from amers.services.statements import Statements
from amers.services.tasks import Effort, Work
from amers.services.types import (
    Array,
    BoolArray,
    ChipArray,
    ControlPoints,
    Frame,
    IntArray,
    Observations,
    Progress,
    no_progress,
    part_of,
)

_ROUNDS_OF_NOISE = 2
"""Adjustments with the noise that the residuals of the one before show."""


@dataclass(frozen=True)
class ProductionOptions:
    """How points are produced.

    Attributes:
        fine_gsd_m, coarse_gsd_m: ground samplings of the chips, metres; by default that of the coarsest
            image in two digits, and four times that.
        spacing_m: side of the squares that get one point each, metres.
        points: desired number of points; --spacing-m overrides it.
        candidates: number of tie points of every square that are tried.
        min_views: smallest number of images that show a point.
        min_saliency: smallest saliency of a point's chip.
        max_sigma_m: largest horizontal standard deviation of a point within the block.
        max_sigma_up_m: largest vertical standard deviation of a point within the block.
        surface_pairs: largest number of image pairs from which the surface height at a point is
            computed; 0 computes no surface heights.
        slope: a priori standard deviation of drift and skew of an image, pixels per pixel; the block
            corrects it by what it finds.
        features, block, refinement: of the stages.
    """

    fine_gsd_m: float | None = None
    coarse_gsd_m: float | None = None
    spacing_m: float | None = None
    points: int = 300
    candidates: int = 3
    min_views: int = 2
    min_saliency: float = 0.05
    max_sigma_m: float = 3.0
    max_sigma_up_m: float = 10.0
    surface_pairs: int = 10
    slope: float = 1e-4
    features: FeatureOptions = field(default_factory=FeatureOptions)
    block: BlockOptions = field(default_factory=BlockOptions)
    refinement: RefinementOptions = field(default_factory=RefinementOptions)


@dataclass(frozen=True)
class RelativeAccuracy:
    """How well the images of a block agree.

    Attributes:
        tie_points: number of points seen in two images or more.
        before_px: median distance between rays and tie points, with the models as delivered, pixels.
        after_px: the same with the adjusted models.
        refined_px: the same for the points of the block, measured on chips.
        frame: accuracy of the frame of the block on the Earth, from the stated accuracy of the models.
    """

    tie_points: int
    before_px: float
    after_px: float
    refined_px: float
    frame: Frame


@dataclass(frozen=True)
class Production:
    """The points of a block.

    Attributes:
        points: in no particular order; `chip_file` and `chip_row` assume one file with the chips of all
            points, in their order.
        chips: from the row of a point to its chips, (views, 101, 101) uint16; 0 is nodata.
        adjustment: of the images; the points refer to its models.
        relative_accuracy: how well the images agree.
        gsds_m: ground samplings of fine and of coarse chips, metres.
        outline: (m, 2) lon, lat of a rectangle that contains the points, counter-clockwise, not closed.
        control: what was found of the known ground; `adjustment` tells which of it agrees.
        image_fits: how every image fits.
        point_fits: how the points fit, in their order.
        effort: what every stage took; "adjustment" is all that is not done in tasks.
        without_surface: number of points without a height of the surface, by the reason.
        statements: of the files, as far as the caller adds them.
    """

    points: ControlPoints
    chips: Callable[[int], ChipArray]
    gsds_m: tuple[float, float]
    adjustment: BlockAdjustment
    relative_accuracy: RelativeAccuracy
    outline: Array
    control: ControlGround
    image_fits: tuple[ImageFit, ...]
    point_fits: PointFits
    effort: Mapping[str, Effort]
    without_surface: Mapping[str, int]
    statements: Statements = ()


def produce_points(
    scenes: Sequence[Scene],
    options: ProductionOptions = ProductionOptions(),
    progress: Progress = no_progress,
    *,
    control: Control = Control(),
    excluded: GroundMask | None = None,
    work: Work | None = None,
) -> Production:
    """Control points with chips, produced from overlapping images alone.

    Tie points and one adjustment bring the images into agreement. Salient, well-distributed tie points
    are then measured again chip by chip, the images adjusted on these measures, and the points
    intersected. The frame of the block is the mean of what the models of the images state, and of the
    control if there is any.

    Args:
        scenes: two or more, with models as delivered.
        options: of the block.
        progress: receives the fraction done.
        control: what places the block on the Earth.
        excluded: ground that gets no points.
        work: computes the tasks and keeps their results; by default in this process, in memory.

    Raises:
        InputError: fewer than two scenes, two of the same name, or the samplings are wrong.
        NotEnoughPoints: the images have too little in common.
    """
    _check_scenes(scenes)
    begun = time.thread_time()
    work = work or Work()
    passes = image_passes([scene.acquisition for scene in scenes])
    gsds_m = chip_samplings_m(scenes, options.fine_gsd_m, options.coarse_gsd_m)
    images = _Images(scenes, passes, options, gsds_m, control.neighbour, work)
    ties, flat, tied = _tied(images, control, part_of(progress, 0.0, 0.5))
    candidates = _candidates(images, tied, ties, excluded)
    measured = _measured(images, tied, candidates, control, progress)
    progress(0.8, "adjusting the block on its chips")
    measured, adjustment = images.adjusted_with_noise(measured)
    chosen = _chosen(images, measured, adjustment, excluded)
    points, chips, missing = _cut_out(images, adjustment, chosen, part_of(progress, 0.8, 0.2))
    progress(1.0, f"{len(points)} points")
    return Production(
        points,
        chips,
        gsds_m,
        adjustment,
        _relative_accuracy(tied, adjustment, before_px=_residual_px(scenes, ties, flat)),
        box_around(points.lon_lat_h),
        measured.known,
        image_fits(scenes, measured.measures, adjustment),
        point_fits(chosen.rows, measured.measures, adjustment),
        {**work.effort, "adjustment": Effort(1, time.thread_time() - begun)},
        missing,
    )


@dataclass(frozen=True)
class _Measured:
    """Candidates, and behind them the points of the control.

    Attributes:
        measures: on chips.
        known: ground of some points.
        saliency: (n,) of the candidates.
    """

    measures: Observations
    known: ControlGround
    saliency: Array


@dataclass(frozen=True)
class _Images:
    """The images of a block with their models as delivered, and how they are adjusted.

    Attributes:
        scenes: of the block.
        of_passes: masks of images that may share errors.
        options: of the block.
        gsds_m: ground samplings of fine and of coarse chips, metres.
        neighbour: images of an adjusted block; None without one.
        work: computes the tasks.
    """

    scenes: Sequence[Scene]
    of_passes: Sequence[BoolArray]
    options: ProductionOptions
    gsds_m: tuple[float, float]
    neighbour: KnownImages | None
    work: Work

    def adjusted(self, observations: Observations, control: ControlGround) -> BlockAdjustment:
        """The block adjustment of the images."""
        images = [
            image_parameters(
                scene.acquisition.image_id,
                scene.model,
                scene.image.shape,
                shift_px=scene.sigma_m / scene_gsd_m(scene),
                slope_px=self.options.slope * max(scene.image.shape) / 2.0,
            )
            for scene in self.scenes
        ]
        return adjust_block(
            images,
            observations,
            control=control,
            neighbour=self.neighbour,
            passes=self.of_passes,
            options=self.options.block,
            work=self.work,
        )

    def adjusted_with_noise(self, measured: _Measured) -> tuple[_Measured, BlockAdjustment]:
        """The measures with the noise that their residuals show, and the block adjustment on them."""
        measures, known = measured.measures, measured.known
        adjustment = self.adjusted(measures, known)
        for _ in range(_ROUNDS_OF_NOISE):
            by_hand = known.marks(measures.point)
            correlated = adjustment.active & ~by_hand
            used, residual_px = measures.take(correlated), adjustment.residual_px[correlated]
            noise = found_noise(used, adjustment.models, adjustment.lon_lat_h, residual_px)
            if noise.own2_px2 == 0.0:
                # What is in proportion to the stated sigmas is in the scale of the adjustment.
                break
            sigma_px = np.where(by_hand, measures.sigma_px, noise.applied(measures.sigma_px))
            measures = replace(measures, sigma_px=sigma_px)
            adjustment = self.adjusted(measures, known)
        return replace(measured, measures=measures), adjustment

    def placed(self, adjustment: BlockAdjustment) -> list[Scene]:
        """The scenes with their adjusted models."""
        pairs = zip(self.scenes, adjustment.models, strict=True)
        return [replace(scene, model=model) for scene, model in pairs]


def _tied(
    images: _Images, control: Control, progress: Progress
) -> tuple[Observations, ControlGround, BlockAdjustment]:
    """Tie points, the known heights of some, and the adjustment of the block on both."""

    def adjusted(ties: Observations) -> tuple[ControlGround, BlockAdjustment]:
        flat = joined_ground([ortho_heights(images.scenes, ties, one) for one in control.heights])
        return flat, images.adjusted(ties, flat)

    options, passes, work = images.options, images.of_passes, images.work
    features = options.features.for_chips(max(map(scene_gsd_m, images.scenes)), images.gsds_m[0])
    ties = find_tie_points(images.scenes, passes, features, work, part_of(progress, 0.0, 0.5))
    if len(ties) == 0:
        why = "tie points: the images have nothing in common"
        raise NotEnoughPoints(0, options.block.min_points, why)
    progress(0.5, "adjusting the block")
    flat, tied = adjusted(ties)
    ground = tied.lon_lat_h[np.isfinite(tied.lon_lat_h[:, 0])]
    squares, second = _grid(ground, options), part_of(progress, 0.5, 0.5)
    scenes = images.placed(tied)
    more = ties_in_squares(scenes, passes, squares, ground, features, work=work, progress=second)
    if len(more):
        ties = joined_ties(ties, more)
        flat, tied = adjusted(ties)
    return ties, flat, tied


def _measured(
    images: _Images, tied: BlockAdjustment, candidates: Array, control: Control, progress: Progress
) -> _Measured:
    """Candidates (n, 3) and the control, measured in the images as tie points have adjusted them."""
    scenes, options, work = images.placed(tied), images.options, images.work
    measures, saliency = measure_points(
        scenes,
        candidates,
        images.gsds_m[0],
        options.refinement,
        work=work,
        progress=part_of(progress, 0.5, 0.25),
    )
    measures, known = with_control(
        scenes,
        MeasuredPoints(candidates, tied.frames[0], images.gsds_m[0], measures),
        control,
        work=work,
        progress=part_of(progress, 0.75, 0.05),
    )
    return _Measured(measures, known, saliency)


@dataclass(frozen=True)
class _Chosen:
    """The points that are kept.

    Attributes:
        rows: (k,) of an adjustment.
        saliency: (k,) of their chips.
        shown: their measures that become views; `point` is 0 to k - 1.
    """

    rows: IntArray
    saliency: Array
    shown: Observations


def _chosen(
    images: _Images, measured: _Measured, adjustment: BlockAdjustment, excluded: GroundMask | None
) -> _Chosen:
    """The best point of every square, of those that images show whole and that are not excluded.

    Points of the control, candidates that nothing measures, and those that have moved onto excluded
    ground are not chosen.
    """
    measures, options = measured.measures, images.options
    active = measures.take(adjustment.active & (measures.point < len(measured.saliency)))
    whole = shows_chip(images.placed(adjustment), active, adjustment.lon_lat_h, images.gsds_m[0])
    shown = active.take(whole)
    saliency = np.append(measured.saliency, np.zeros(len(measured.known)))[: len(adjustment.lon_lat_h)]
    if excluded is not None:
        saliency[excluded(adjustment.lon_lat_h[:, :2])] = 0.0
    dates = dates_of_points(shown, images.of_passes, len(saliency))
    rows = _select_points(adjustment, saliency, shown, dates, options)
    shown = shown.take(np.isin(shown.point, rows))
    return _Chosen(rows, saliency[rows], replace(shown, point=np.searchsorted(rows, shown.point)))


def _check_scenes(scenes: Sequence[Scene]) -> None:
    if len(scenes) < 2:
        raise InputError(f"{len(scenes)} image given, at least 2 needed to make points")
    check_image_names(scenes)


def _residual_px(scenes: Sequence[Scene], ties: Observations, flat: ControlGround) -> Array:
    """Residuals (m, 2) with the models as delivered, where rays intersect or lie on a known height."""
    models = [scene.model for scene in scenes]
    lon_lat_h = intersect(models, ties, int(ties.point[-1]) + 1).lon_lat_h
    lon_lat_h[flat.point] = flat.lon_lat_h
    return residuals_and_derivatives(models, ties, lon_lat_h)[0]


def _relative_accuracy(
    tied: BlockAdjustment, adjustment: BlockAdjustment, *, before_px: Array
) -> RelativeAccuracy:
    """How well the images agree: before (m, 2), on tie points, on chips."""
    return RelativeAccuracy(
        tie_points=int(np.isfinite(tied.lon_lat_h[:, 0]).sum()),
        before_px=_median_px(before_px),
        after_px=_median_px(tied.residual_px),
        refined_px=_median_px(adjustment.residual_px[adjustment.active]),
        frame=adjustment.frames[0],
    )


def _median_px(residual: Array) -> float:
    return float(np.nanmedian(np.linalg.norm(residual, axis=1)))


def _candidates(
    images: _Images, block: BlockAdjustment, ties: Observations, excluded: GroundMask | None
) -> Array:
    """Ground positions (n, 3) of the tie points to try, the best of every square, square by square."""
    options, fine_m = images.options, images.gsds_m[0]
    active = ties.take(block.active)
    rays = np.bincount(active.point, minlength=len(block.lon_lat_h))
    residual = np.linalg.norm(block.residual_px[block.active], axis=1)
    largest_residual = np.zeros(len(block.lon_lat_h))
    np.maximum.at(largest_residual, active.point, residual)
    sigma_m = np.sqrt(np.diagonal(block.point_covariance_m2, 0, 1, 2))
    usable = np.isfinite(block.lon_lat_h[:, 0]) & (rays >= 2) & _precise(sigma_m, options)
    rows = np.flatnonzero(usable)
    if excluded is not None:
        rows = rows[~excluded(block.lon_lat_h[rows, :2])]
    n_whole = np.zeros(len(rows), dtype=np.int64)
    for scene in images.placed(block):
        n_whole += chip_inside(scene.model, scene.image.shape, block.lon_lat_h[rows], fine_m)
    rows, n_whole = rows[n_whole >= options.min_views], n_whole[n_whole >= options.min_views]
    if len(rows) < options.block.min_points:
        raise NotEnoughPoints(
            len(rows),
            options.block.min_points,
            f"tie points whose chip of {CHIP_SIZE * fine_m:g} m lies completely inside "
            f"{options.min_views} images",
        )
    square = _squares(block.lon_lat_h[rows], options)
    preference = n_whole - largest_residual[rows]
    best = rank_in_group(square, preference) < options.candidates
    return block.lon_lat_h[rows[best][np.argsort(square[best], kind="stable")]]


def _precise(sigma_m: Array, options: ProductionOptions) -> BoolArray:
    """Which points, by their sigmas (n, 3) east, north, up, are precise enough."""
    horizontal = sigma_m[:, :2].max(axis=1) <= options.max_sigma_m
    return np.asarray(horizontal & (sigma_m[:, 2] <= options.max_sigma_up_m))


def _squares(lon_lat_h: Array, options: ProductionOptions) -> IntArray:
    """Number (n,) of the square of ground that every point (n, 3) lies in."""
    return _grid(lon_lat_h, options).cell_of(lon_lat_h[:, :2])


def _grid(lon_lat_h: Array, options: ProductionOptions) -> GroundGrid:
    return point_squares(lon_lat_h, options.spacing_m, options.points)


def _select_points(
    points: BlockAdjustment,
    saliency: Array,
    shown: Observations,
    dates: IntArray,
    options: ProductionOptions,
) -> IntArray:
    """Row (n,), ascending, of the best point of every square of ground.

    `saliency` and `dates` are those of all points; `shown` are the measures in images that show the
    whole fine chip: those that become views.
    """
    sigma_m = np.sqrt(np.diagonal(points.point_covariance_m2, 0, 1, 2))
    views = np.bincount(shown.point, minlength=len(points.lon_lat_h))
    usable = np.isfinite(points.lon_lat_h[:, 0]) & (views >= options.min_views)
    usable &= saliency >= options.min_saliency
    rows = np.flatnonzero(usable & _precise(sigma_m, options))
    if len(rows) < options.block.min_points:
        raise NotEnoughPoints(
            len(rows), options.block.min_points, f"salient points out of {len(saliency)} candidates"
        )
    square = _squares(points.lon_lat_h[rows], options)
    return rows[rank_in_group(square, dates[rows] + views[rows] + saliency[rows]) == 0]


def _cut_out(
    images: _Images, adjustment: BlockAdjustment, chosen: _Chosen, progress: Progress
) -> tuple[ControlPoints, Callable[[int], ChipArray], Mapping[str, int]]:
    """The chosen points as those of one chip file, the chips of each, and why surfaces are missing."""
    rows, n = chosen.rows, len(chosen.rows)
    scenes, places = images.placed(adjustment), adjustment.lon_lat_h[rows]
    options, work = images.options, images.work
    of_models_m2, search = adjustment.point_shared_m2[rows, 2, 2], part_of(progress, 0.0, 0.5)
    surface, missing = surfaces_at(
        scenes, places, options.surface_pairs, of_models_m2=of_models_m2, work=work, progress=search
    )
    cut = cut_points(
        scenes, places, chosen.shown, images.gsds_m, work=work, progress=part_of(progress, 0.5, 0.5)
    )
    points = ControlPoints(
        id=np.arange(n, dtype=np.int64),
        lon_lat_h=places,
        covariance_m2=adjustment.point_covariance_m2[rows],
        block=np.zeros(n, dtype=np.int64),
        frames=adjustment.frames,
        saliency=chosen.saliency,
        health=np.ones(n),
        views=cut.views,
        chip_file=np.zeros(n, dtype=np.int64),
        chip_row=cut.views.start[:-1].copy(),
        chip_files=("chips",),
        surface=surface,
    )
    return points, cut.chips, missing
