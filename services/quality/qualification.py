"""How good a registration is: figures first, then a verdict that follows from thresholds alone."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from amers.services.conventions import CHIP_SIZE
from amers.services.matching.consensus import a_contrario_consensus, consensus_tolerance_px
from amers.services.misfit.broken_image import on_one_side
from amers.services.quality.accuracy import Statistics, statistics
from amers.services.quality.accuracy_statement import AccuracyStatement, scene_accuracy
from amers.services.quality.cell_stability import CellStability, measure_cell_stability
from amers.services.quality.criteria import Criterion, Verdict, at_least, at_most, verdict_of
from amers.services.quality.frames import why_unknown
from amers.services.quality.lack_of_fit import (
    against_height,
    breaks_criterion,
    correction_against_height,
    elsewhere_criterion,
    missed_criterion,
    structure_criteria,
)
from amers.services.quality.line_of_sight import implied_sight, line_of_sight_criterion
from amers.services.quality.predicted import PredictedAccuracy, predict_accuracy
from amers.services.quality.stability import (
    AdjustedScene,
    ImageResiduals,
    Stability,
    measure_stability,
    residuals_in_image,
)
from amers.services.types import Array, BoolArray, Frame, Measures

_ENOUGH_RESIDUALS = 6
"""Fewest active points for a standard deviation of their residuals."""
_MOST_WORSE = 4.0
"""Errors of points are believed up to this many times their stated accuracy."""
_CLEARLY_WORSE = 1.3
"""Standard deviation of unit weight from which on points are called worse than stated."""


@dataclass(frozen=True)
class QualificationOptions:
    """Thresholds and sampling of a qualification.

    A registration is "good" when it meets every threshold, "usable" when it meets every `usable_*`
    threshold, else "failed". Thresholds of "good" are pixels of the scene; those of "usable" are pixels
    of the scene or of the chips, whichever are coarser: a scene is not worse for being finer than the
    control. A limit in metres alone is set by a limit of 0 px.

    Attributes:
        good_active_points: smallest number of active points (SRP: one measure is never enough, at least
            20).
        good_coverage_percent: smallest coverage of the image by active points.
        good_active_of_matched: smallest ratio of active to matched points.
        good_residual_std_px, usable_residual_std_px: largest standard deviation of the active residuals,
            of the worse coordinate, without the part that chance and the accuracy of the points explain:
            for good as they state it, for usable as the scene shows it.
        good_displacement_px, usable_displacement_px: largest displacement of a corner or the centre when
            a part of the points is held out: the worst place, the median over the draws.
        good_displacement_m, usable_displacement_m: displacements up to this are good, usable where the
            pixels are finer (SRP: corners within 0.3 m).
        good_ce90_px, usable_ce90_px: largest predicted CE90 of the correction over the image.
        good_ce90_m, usable_ce90_m: a predicted CE90 up to this is good, usable where the pixels are
            finer (SRP: 0.4 m over the image, which is up to 0.75 m at its worst place).
        max_ce90_on_earth_m: largest CE90 on the Earth, with the frame of the control points, of a usable
            registration; None sets no limit.
        good_unit_weight: largest standard deviation of unit weight: residuals over the stated sigmas.
        good_second_consensus_share: largest group of deactivated points that agree on another
            displacement, as a share of the active points. A scene has one displacement, not two.
        usable_active_points: smallest number of active points.
        usable_active_of_few: smallest ratio of active to matched points where fewer points are active
            than a good registration has, or where they scatter by more than one allows: part of a few
            points, and of points that hardly agree, agree on a wrong correction too.
        coverage_cells: cells of the coverage along each side of the image.
        grid: nodes of the predicted accuracy along each side of the image.
        draws: number of repeated adjustments in the stability test.
        kept_share: share of the active points in each draw.
    """

    good_active_points: int = 20
    good_coverage_percent: float = 60.0
    good_active_of_matched: float = 0.5
    good_residual_std_px: float = 1.0
    good_displacement_px: float = 0.5
    good_displacement_m: float = 0.3
    good_ce90_px: float = 1.0
    good_ce90_m: float = 0.75
    max_ce90_on_earth_m: float | None = None
    good_unit_weight: float = 3.0
    good_second_consensus_share: float = 0.3
    usable_active_points: int = 6
    usable_active_of_few: float = 0.75
    usable_residual_std_px: float = 2.0
    usable_displacement_px: float = 2.0
    usable_displacement_m: float = 0.9
    usable_ce90_px: float = 3.0
    usable_ce90_m: float = 1.5
    coverage_cells: int = 5
    grid: int = 7
    draws: int = 10
    kept_share: float = 0.8


@dataclass(frozen=True)
class PointCounts:
    """Numbers of points at the stages of a registration.

    Attributes:
        visible: points that the scene could show (published as Popini).
        not_tried: visible points that were not searched, because well-spread others represent them.
        matched: points that were found, and whose views agree (published as Spatio).
        active: points that the final adjustment uses (published as Actif).
        active_of_matched, active_of_visible: ratios, 0 to 1; NaN when the divisor is zero.
    """

    visible: int
    not_tried: int
    matched: int
    active: int
    active_of_matched: float
    active_of_visible: float


@dataclass(frozen=True)
class GroundResiduals:
    """Residuals of the active points on the ground, metres; a single scene gives no heights.

    Attributes:
        east, north: in the horizontal plane through the point.
        horizontal: length of the residual.
    """

    east: Statistics
    north: Statistics
    horizontal: Statistics


@dataclass(frozen=True)
class Coverage:
    """Share of equal cells of the image that hold an active point.

    Cells show the edge that is extrapolated and the hole that no point checks; a convex hull of a few
    far points hides an empty middle. With five by five cells, 60 % are 15 of 25 cells: 20 well-spread
    points reach that easily, 20 points at random places reach 56 % on average.

    Attributes:
        cells: (c, c) active points in each cell, rows from the first line down.
        occupied: cells with a point.
        percent: 0 to 100.
    """

    cells: Array
    occupied: int
    percent: float


@dataclass(frozen=True)
class Qualification:
    """The quality figures of a registration and the verdict.

    Attributes:
        verdict: follows from the criteria alone.
        criteria: the figures that have limits.
        point_counts: visible, matched and active points.
        image_residuals_px, ground_residuals_m: of the active points.
        stability: the adjustment repeated without a part of its points, drawn at random.
        cell_stability: the same without the points of one cell at a time.
        predicted: accuracy by the covariance of the correction.
        accuracy: as every place states it.
        coverage: of the image by active points.
    """

    verdict: Verdict
    criteria: tuple[Criterion, ...]
    point_counts: PointCounts
    image_residuals_px: ImageResiduals
    ground_residuals_m: GroundResiduals
    stability: Stability
    cell_stability: CellStability
    predicted: PredictedAccuracy
    accuracy: AccuracyStatement
    coverage: Coverage


def qualify(
    scene: AdjustedScene, options: QualificationOptions, rng: np.random.Generator
) -> Qualification:
    """The quality figures of a registration, compared with their thresholds.

    Args:
        scene: after its final adjustment.
        options: thresholds and sampling.
        rng: draws the points that are held out.
    """
    stability = measure_stability(scene, options.draws, options.kept_share, rng)
    return qualify_repeated(scene, options, stability, measure_cell_stability(scene))


def qualify_repeated(
    scene: AdjustedScene,
    options: QualificationOptions,
    stability: Stability,
    cell_stability: CellStability,
    *,
    tie_residual_px: float = np.nan,
) -> Qualification:
    """The quality figures of a registration whose adjustment was repeated already; see `qualify`.

    Args:
        scene: after its final adjustment.
        options: thresholds and sampling.
        stability: the adjustment repeated without a part of its points.
        cell_stability: the same without cells.
        tie_residual_px: standard deviation of the residuals of tie points, of the worse coordinate; it
            stands in where fewer active points than a usable registration needs have residuals.
    """
    measures, adjustment, shape = scene.measures, scene.adjustment, scene.shape
    point_counts = count_points(measures)
    residuals = residuals_in_image(measures.residual_px[measures.active])
    worse = _times_worse(adjustment.sigma0)
    residual_std_px, shown_residual_std_px = (
        unexplained_px(measures, times * adjustment.point_sigma_px) for times in (1.0, worse)
    )
    if point_counts.active < _ENOUGH_RESIDUALS and np.isfinite(tie_residual_px):
        residual_std_px = shown_residual_std_px = tie_residual_px
    predicted = predict_accuracy(scene, options.grid)
    stated_px = float(np.median(predicted.ce90_px))
    coverage = image_coverage(measures.line_sample[measures.active], shape, options.coverage_cells)
    figures = _Figures(
        active_points=point_counts.active,
        active_of_matched=point_counts.active_of_matched,
        coverage_percent=coverage.percent,
        residual_std_px=residual_std_px,
        shown_residual_std_px=shown_residual_std_px,
        displacement_px=max((place.median_px for place in stability.displacements), default=np.nan),
        predicted_ce90_px=predicted.worst_px,
        unit_weight=adjustment.sigma0,
        second_consensus_share=second_consensus_share(measures, stated_px),
    )
    control_px = max(scene.control_gsd_m / scene.gsd_m, 1.0)
    criteria = (
        *_criteria(figures, options, scene.gsd_m, control_px),
        *_of_fit(scene, stated_px),
    )
    if options.max_ce90_on_earth_m is not None:
        criteria += (_on_earth(predicted, options.max_ce90_on_earth_m, scene.frame),)
    return Qualification(
        verdict=verdict_of(criteria),
        criteria=criteria,
        point_counts=point_counts,
        image_residuals_px=residuals,
        ground_residuals_m=_residuals_on_ground(measures.residual_m[measures.active]),
        stability=stability,
        cell_stability=cell_stability,
        predicted=predicted,
        accuracy=scene_accuracy(predicted.worst_m, predicted.on_the_earth_worst_m, scene.frame),
        coverage=coverage,
    )


def count_points(measures: Measures) -> PointCounts:
    """Numbers of visible, matched and active points."""
    visible = len(measures.point_id)
    matched, active = int(measures.matched.sum()), int(measures.active.sum())
    return PointCounts(
        visible=visible,
        not_tried=int((measures.reason == "not_tried").sum()),
        matched=matched,
        active=active,
        active_of_matched=active / matched if matched else float("nan"),
        active_of_visible=active / visible if visible else float("nan"),
    )


def unexplained_px(measures: Measures, point_sigma_px: Array) -> float:
    """Standard deviation of the worse coordinate without the part that the points' accuracy explains.

    Points of 3 m do not make a scene of 0.5 m pixels bad: many of them still determine its model well.
    Errors of points are independent, so that they also separate neighbours; what neighbours share is an
    error of the model, whatever sigmas the points state. The explained variance is therefore the stated
    one, at most that between neighbours. The variance of n residuals has a relative standard deviation
    of sqrt(2 / n); chance explains two of these.

    Args:
        measures: of the scene; the active points count.
        point_sigma_px: (2,) line and sample, of the points as stated.
    """
    residual = measures.residual_px[measures.active]
    if len(residual) < 2:
        return float("nan")
    line_sample = measures.line_sample[measures.active]
    _, nearest = KDTree(line_sample).query(line_sample, k=2)
    between_neighbours = ((residual - residual[nearest[:, 1]]) ** 2).mean(axis=0) / 2.0
    chance = 1.0 + 2.0 * np.sqrt(2.0 / len(residual))
    explained = chance * np.minimum(point_sigma_px**2, between_neighbours)
    return float(np.sqrt(np.maximum(residual.var(axis=0, ddof=1) - explained, 0.0).max()))


def second_consensus_share(measures: Measures, stated_px: float) -> float:
    """Largest group of deactivated points that agree on another displacement, over the active points.

    Points agree when their residuals are as near to each other as those of the active points are to
    zero. A displacement that is no larger than the accuracy of the scene is no other one.

    Args:
        measures: of all points.
        stated_px: CE90 of the scene.
    """
    active = measures.residual_px[measures.active]
    if len(active) == 0:
        return float("nan")
    deactivated = measures.residual_px[measures.matched & ~measures.active]
    deactivated = deactivated[~(np.hypot(*deactivated.T) <= stated_px)]
    tolerance_px = consensus_tolerance_px(float(np.sqrt((active**2).mean())))
    largest_px = float(np.abs(deactivated).max(initial=tolerance_px))
    second = a_contrario_consensus(deactivated, tolerance_px, largest_px)
    return int(second.inliers.sum()) / len(active)


def _residuals_on_ground(residual_m: Array) -> GroundResiduals:
    """Statistics of residuals (n, 2), east and north."""
    east, north = residual_m[:, 0], residual_m[:, 1]
    return GroundResiduals(statistics(east), statistics(north), statistics(np.hypot(east, north)))


def image_coverage(line_sample: Array, shape: tuple[int, int], cells: int) -> Coverage:
    """Numbers of active points (n, 2) in `cells` x `cells` equal parts of the image."""
    edges = [np.linspace(-0.5, size - 0.5, cells + 1) for size in shape]
    counts, _, _ = np.histogram2d(line_sample[:, 0], line_sample[:, 1], bins=edges)
    occupied = int(np.count_nonzero(counts))
    return Coverage(counts, occupied, 100.0 * occupied / cells**2)


@dataclass(frozen=True)
class _Figures:
    """The figures that have limits; each bears the name of its criterion."""

    active_points: int
    active_of_matched: float
    coverage_percent: float
    residual_std_px: float
    shown_residual_std_px: float
    displacement_px: float
    predicted_ce90_px: float
    unit_weight: float
    second_consensus_share: float


def _of_fit(scene: AdjustedScene, predicted_px: float) -> list[Criterion]:
    """The criteria on what the residuals depend on, and on points that agree elsewhere."""
    measures = scene.measures
    sight = np.zeros(2)
    if len(measures.lon_lat_h):
        sight = scene.model.project_derivative(measures.lon_lat_h)[:, :, 2].mean(axis=0)
    expected = scene.model.project(measures.lon_lat_h)
    structures = structure_criteria(scene.adjustment.structures, sight, scene.shape, predicted_px)
    displaced = against_height(scene.elsewhere, sight, predicted_px)
    if displaced is not None:
        structures = [displaced if one.name == displaced.name else one for one in structures]
    # A point that lies within the stated accuracy says nothing against it, however well others agree.
    misfit_px = measures.line_sample - expected
    off = ~(np.hypot(*misfit_px.T) <= predicted_px)
    return [
        *structures,
        _against_slope(scene),
        *_line_of_sight(scene),
        *_behind_breaks(scene),
        missed_criterion(
            "lines",
            expected[:, 0],
            measures.active,
            measures.reason,
            scene.shape[0],
            misfit_px=misfit_px,
            counts=off & _whole(scene, expected),
        ),
        missed_criterion(
            "samples",
            expected[:, 1],
            measures.active,
            measures.reason,
            scene.shape[1],
            misfit_px=misfit_px,
            counts=off,
        ),
        elsewhere_criterion(scene.elsewhere, expected, measures.active, scene.shape),
    ]


def _against_slope(scene: AdjustedScene) -> Criterion:
    """The criterion on a correction that grows up the slope of the ground.

    Steps between lines are no growth: where they are followed, the affine part beside them counts.
    """
    measures, adjustment = scene.measures, scene.adjustment
    predicted = measures.predicted[measures.active]
    measured = measures.line_sample[measures.active]
    if any(one.is_step for one in adjustment.components):
        affine = replace(adjustment.correction, displacement=None)
        measured = affine.apply(predicted) + measures.residual_px[measures.active]
    height_m = measures.lon_lat_h[measures.active, 2]
    return correction_against_height(measured - predicted, predicted, height_m, scene.gsd_m)


def _line_of_sight(scene: AdjustedScene) -> list[Criterion]:
    """The criterion on the line of sight of the model, where chips show shears."""
    if scene.shears is None:
        return []
    derivative = scene.model.project_derivative(scene.measures.lon_lat_h[scene.shears.point])
    lean = np.asarray(np.linalg.solve(derivative[:, :, :2], derivative[:, :, 2:])[:, :, 0], np.float64)
    return [line_of_sight_criterion(implied_sight(scene.shears, lean))]


def _whole(scene: AdjustedScene, expected: Array) -> BoolArray:
    """Points (n,) expected at places (n, 2) whose chips no break of the image cuts."""
    if scene.breaks is None:
        return np.ones(len(expected), dtype=bool)
    side_px = CHIP_SIZE * scene.control_gsd_m / scene.gsd_m
    return on_one_side(scene.breaks, expected[:, 0], side_px, 0.0)


def _behind_breaks(scene: AdjustedScene) -> list[Criterion]:
    """The criterion on breaks of the image, where it has any."""
    if scene.breaks is None or not len(scene.breaks):
        return []
    line, active = scene.measures.line_sample[:, 0], scene.measures.active
    followed = any(one.kind == "break" for one in scene.adjustment.components)
    return [breaks_criterion(scene.breaks, line[active], followed, scene.shape[0])]


def _on_earth(predicted: PredictedAccuracy, limit_m: float, frame: Frame) -> Criterion:
    """The optional criterion on the Earth; a frame without stated accuracy does not meet it."""
    criterion = at_most("ce90_on_earth_m", predicted.on_the_earth_worst_m, limit_m, "usable")
    unknown = "" if np.isfinite(criterion.value) else f"unknown: {why_unknown(frame)}"
    return replace(criterion, note=unknown)


def _times_worse(unit_weight: float) -> float:
    """How many times less accurate than stated a scene shows the points to be, at least 1."""
    return float(np.clip(np.nan_to_num(unit_weight, nan=1.0), 1.0, _MOST_WORSE))


def _criteria(
    figures: _Figures, options: QualificationOptions, gsd_m: float, control_px: float
) -> tuple[Criterion, ...]:
    """The figures compared with the thresholds.

    Args:
        figures: of a registration.
        options: thresholds.
        gsd_m: of the scene.
        control_px: pixels of the scene to one of the chips, at least 1.
    """
    f, o = figures, options
    good_ce90_px = max(o.good_ce90_px, o.good_ce90_m / gsd_m)
    usable_ce90_px = max(o.usable_ce90_px * control_px, o.usable_ce90_m / gsd_m)
    usable_displacement_px = max(o.usable_displacement_px * control_px, o.usable_displacement_m / gsd_m)
    good_displacement_px = max(o.good_displacement_px, o.good_displacement_m / gsd_m)
    usable_residual_px = o.usable_residual_std_px * control_px
    scattered = f.residual_std_px > o.good_residual_std_px
    few = o.usable_active_of_few > 0.0 and (f.active_points < o.good_active_points or scattered)
    return (
        at_least("active_points", f.active_points, o.good_active_points, "good"),
        at_least("coverage_percent", f.coverage_percent, o.good_coverage_percent, "good"),
        at_least("active_of_matched", f.active_of_matched, o.good_active_of_matched, "good"),
        _noted(at_most("residual_std_px", f.residual_std_px, o.good_residual_std_px, "good"), f),
        at_most("displacement_px", f.displacement_px, good_displacement_px, "good"),
        at_most("predicted_ce90_px", f.predicted_ce90_px, good_ce90_px, "good"),
        at_least("active_points", f.active_points, o.usable_active_points, "usable"),
        *([at_least("active_of_matched", f.active_of_matched, o.usable_active_of_few, "usable")] * few),
        at_most("residual_std_px", f.shown_residual_std_px, usable_residual_px, "usable"),
        at_most("displacement_px", f.displacement_px, usable_displacement_px, "usable"),
        at_most("predicted_ce90_px", f.predicted_ce90_px, usable_ce90_px, "usable"),
        _noted(at_most("unit_weight", f.unit_weight, o.good_unit_weight, "good"), f),
        at_most(
            "second_consensus_share",
            f.second_consensus_share,
            o.good_second_consensus_share,
            "good",
        ),
    )


def _noted(criterion: Criterion, figures: _Figures) -> Criterion:
    """The criterion, which says when it is not met because points are worse than they state."""
    if criterion.met or not figures.unit_weight > _CLEARLY_WORSE:
        return criterion
    return replace(
        criterion,
        note=f"the scene shows points {figures.unit_weight:.1f} times less accurate than they state; "
        "the accuracy stated here takes them as the scene shows them",
    )
