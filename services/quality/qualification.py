"""How good a registration is: figures first, then a verdict that follows from thresholds alone."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from services.adjustment.image_correction import SceneAdjustment
from services.matching.consensus import a_contrario_consensus
from services.quality.accuracy import Statistics, normal_ce90, statistics
from services.quality.stability import (
    ImageResiduals,
    PredictedAccuracy,
    Refit,
    Stability,
    measure_stability,
    predict_accuracy,
    residuals_in_image,
)
from services.types import Array, Measures

Verdict = Literal["good", "usable", "failed"]


@dataclass(frozen=True)
class QualificationOptions:
    """Thresholds and sampling of a qualification.

    A registration is "good" when it passes every threshold, "usable" when it passes every `usable_*`
    one, else "failed".

    Attributes:
        good_active_points: fewest active points (SRP: one measure is never enough, at least 20).
        good_coverage_percent: smallest coverage of the image by active points.
        good_active_of_matched: smallest share of matched points that the adjustment keeps.
        good_residual_std_px, usable_residual_std_px: largest standard deviation of the active residuals,
            of the worse coordinate, without what the points' stated accuracy and chance explain.
        good_displacement_px, usable_displacement_px: largest displacement of a corner or the centre when
            a part of the points is held out: the worst place, the median over the draws.
        good_ce90_px, usable_ce90_px: largest predicted CE90 of the correction over the image.
        good_displacement_of_points, usable_displacement_of_points, good_ce90_of_points,
            usable_ce90_of_points: the same two as shares of the points' own CE90, where that allows
            more: points coarser than the pixels still make a model several times better than they are
            (SRP: corners within 0.3 m with points of 3 m).
        good_unit_weight: largest ratio of the residuals to what the stated sigmas let expect.
        good_second_consensus_share: largest number of deactivated points that agree on another
            displacement, as a share of the active points: a scene has one displacement, not two.
        usable_active_points: fewest active points.
        coverage_cells: cells of the coverage along each side of the image.
        grid: nodes of the predicted accuracy along each side of the image.
        draws: how often the adjustment is redone.
        kept_share: of the active points in each draw.
    """

    good_active_points: int = 20
    good_coverage_percent: float = 60.0
    good_active_of_matched: float = 0.5
    good_residual_std_px: float = 1.0
    good_displacement_px: float = 0.5
    good_displacement_of_points: float = 0.1
    good_ce90_px: float = 1.0
    good_ce90_of_points: float = 0.25
    good_unit_weight: float = 3.0
    good_second_consensus_share: float = 0.3
    usable_active_points: int = 6
    usable_residual_std_px: float = 2.0
    usable_displacement_px: float = 2.0
    usable_displacement_of_points: float = 0.3
    usable_ce90_px: float = 3.0
    usable_ce90_of_points: float = 0.5
    coverage_cells: int = 5
    grid: int = 7
    draws: int = 10
    kept_share: float = 0.8


@dataclass(frozen=True)
class PointCounts:
    """How many points a scene was given, and what became of them.

    Attributes:
        visible: points the scene could show (Popini).
        unused: of these, points that were not tried because others stand for them.
        matched: found, and their views agree (Spatio).
        active: used by the final adjustment (Actif).
        active_of_matched, active_of_visible: ratios, 0 to 1; NaN over nothing.
    """

    visible: int
    unused: int
    matched: int
    active: int
    active_of_matched: float
    active_of_visible: float


@dataclass(frozen=True)
class GroundResiduals:
    """Residuals of the active points on the ground, metres; a single scene says nothing about heights.

    Attributes:
        east, north: of the horizontal plane through the point.
        horizontal: length of the residual.
    """

    east: Statistics
    north: Statistics
    horizontal: Statistics


@dataclass(frozen=True)
class Coverage:
    """Share of equal cells of the image that hold an active point.

    Cells rather than the convex hull: a hull spanned by a few far points hides an empty middle, cells
    show both the edge that is extrapolated and the hole that nothing checks. With five by five, 60 % are
    15 of 25 cells: easy for 20 points that are well spread, while 20 thrown at random reach 56 % on
    average.

    Attributes:
        cells: (c, c) active points in each cell, rows from the first line down.
        occupied: cells with a point.
        percent: 0 to 100.
    """

    cells: Array
    occupied: int
    percent: float


@dataclass(frozen=True)
class Criterion:
    """One threshold and whether it was met.

    Attributes:
        name: what is compared, with its unit.
        value: NaN when it could not be computed; such a criterion is not met.
        comparison: of the value with the limit.
        limit: as given in the options.
        needed_for: the verdict that is lost when it is not met.
        passed: whether it was met.
    """

    name: str
    value: float
    comparison: Literal["at least", "at most"]
    limit: float
    needed_for: Literal["good", "usable"]
    passed: bool


@dataclass(frozen=True)
class Qualification:
    """Everything that says how good a registration is.

    Attributes:
        verdict: follows from the criteria and nothing else.
    """

    verdict: Verdict
    criteria: tuple[Criterion, ...]
    equipment: PointCounts
    image_residuals_px: ImageResiduals
    ground_residuals_m: GroundResiduals
    stability: Stability
    predicted: PredictedAccuracy
    coverage: Coverage


def qualify(
    measures: Measures,
    adjustment: SceneAdjustment,
    shape: tuple[int, int],
    refit: Refit,
    gsd_m: float,
    options: QualificationOptions,
    rng: np.random.Generator,
    frame_sigma_m: float = float("nan"),
) -> Qualification:
    """Say how good a registration is.

    Args:
        measures: all n points the scene could show, with their final residuals.
        adjustment: the final one.
        shape: lines and samples of the image.
        refit: redoes the adjustment on the measures of a mask (n,).
        gsd_m: ground sampling of the image, turns pixels into metres.
        options: thresholds and sampling.
        rng: draws the points that are held out.
        frame_sigma_m: systematic error of the frame of the points' blocks, one standard deviation a
            coordinate; NaN when unknown.
    """
    equipment = count_equipment(measures)
    residuals = residuals_in_image(measures.residual_px[measures.active])
    stability = measure_stability(
        measures, adjustment, shape, refit, gsd_m, options.draws, options.kept_share, rng
    )
    predicted = predict_accuracy(adjustment, shape, gsd_m, options.grid, frame_sigma_m)
    coverage = image_coverage(measures.line_sample[measures.active], shape, options.coverage_cells)
    std_px = unexplained_px(residuals, adjustment.point_sigma_px)
    points_ce90_px = float(normal_ce90(np.diag(adjustment.point_sigma_px**2)[None])[0])
    criteria = compare(equipment, std_px, stability, predicted, points_ce90_px, coverage, options)
    criteria += (
        _at_most("unit_weight", adjustment.sigma0, options.good_unit_weight, "good"),
        _at_most(
            "second_consensus_share",
            second_consensus_share(measures),
            options.good_second_consensus_share,
            "good",
        ),
    )
    return Qualification(
        verdict=verdict_of(criteria),
        criteria=criteria,
        equipment=equipment,
        image_residuals_px=residuals,
        ground_residuals_m=_residuals_on_ground(measures.residual_m[measures.active]),
        stability=stability,
        predicted=predicted,
        coverage=coverage,
    )


def count_equipment(measures: Measures) -> PointCounts:
    """Count visible, matched and active points."""
    visible = len(measures.point_id)
    matched, active = int(measures.matched.sum()), int(measures.active.sum())
    return PointCounts(
        visible=visible,
        unused=int((measures.reason == "not_tried").sum()),
        matched=matched,
        active=active,
        active_of_matched=active / matched if matched else float("nan"),
        active_of_visible=active / visible if visible else float("nan"),
    )


def unexplained_px(residuals: ImageResiduals, point_sigma_px: Array) -> float:
    """Standard deviation of the worse coordinate without what the points' own accuracy explains.

    Points of 3 m are no fault of a scene of 0.5 m pixels: many of them still tell its model well. Of n
    residuals the variance is known to sqrt(2 / n): two such deviations are what chance explains.

    Args:
        residuals: of the active points.
        point_sigma_px: (2,) line and sample.
    """
    variance = np.array([residuals.y.std, residuals.x.std]) ** 2
    chance = 1.0 + 2.0 * np.sqrt(2.0 / max(residuals.x.n, 1))
    left = np.maximum(variance - chance * point_sigma_px**2, 0.0)
    return float(np.sqrt(left.max()))


def second_consensus_share(measures: Measures) -> float:
    """The largest group of deactivated points that agree on another place, over the active points.

    They agree when their residuals are as near each other as those of the active points are to zero.
    """
    active = measures.residual_px[measures.active]
    if len(active) == 0:
        return float("nan")
    apart = measures.residual_px[measures.matched & ~measures.active]
    tolerance_px = 3.0 * float(np.sqrt((active**2).mean())) + 0.5
    rivals = a_contrario_consensus(apart, tolerance_px, float(np.abs(apart).max(initial=tolerance_px)))
    return int(rivals.inliers.sum()) / len(active)


def _residuals_on_ground(residual_m: Array) -> GroundResiduals:
    """Statistics of residuals (n, 2), east and north."""
    east, north = residual_m[:, 0], residual_m[:, 1]
    return GroundResiduals(statistics(east), statistics(north), statistics(np.hypot(east, north)))


def image_coverage(line_sample: Array, shape: tuple[int, int], cells: int) -> Coverage:
    """Count the active points (n, 2) in `cells` x `cells` equal parts of the image."""
    edges = [np.linspace(-0.5, size - 0.5, cells + 1) for size in shape]
    counts, _, _ = np.histogram2d(line_sample[:, 0], line_sample[:, 1], bins=edges)
    occupied = int(np.count_nonzero(counts))
    return Coverage(counts, occupied, 100.0 * occupied / cells**2)


def compare(
    equipment: PointCounts,
    std_px: float,
    stability: Stability,
    predicted: PredictedAccuracy,
    points_ce90_px: float,
    coverage: Coverage,
    options: QualificationOptions,
) -> tuple[Criterion, ...]:
    """Hold the figures against the thresholds."""
    o = options
    good_px = max(o.good_ce90_px, o.good_ce90_of_points * points_ce90_px)
    usable_px = max(o.usable_ce90_px, o.usable_ce90_of_points * points_ce90_px)
    good_moved_px = max(o.good_displacement_px, o.good_displacement_of_points * points_ce90_px)
    usable_moved_px = max(o.usable_displacement_px, o.usable_displacement_of_points * points_ce90_px)
    moved_px = max((place.median_px for place in stability.displacements), default=float("nan"))
    good = (
        _at_least("active_points", equipment.active, options.good_active_points, "good"),
        _at_least("coverage_percent", coverage.percent, options.good_coverage_percent, "good"),
        _at_least(
            "active_of_matched", equipment.active_of_matched, options.good_active_of_matched, "good"
        ),
        _at_most("residual_std_px", std_px, options.good_residual_std_px, "good"),
        _at_most("displacement_px", moved_px, good_moved_px, "good"),
        _at_most("predicted_ce90_px", predicted.worst_px, good_px, "good"),
    )
    usable = (
        _at_least("active_points", equipment.active, options.usable_active_points, "usable"),
        _at_most("residual_std_px", std_px, options.usable_residual_std_px, "usable"),
        _at_most("displacement_px", moved_px, usable_moved_px, "usable"),
        _at_most("predicted_ce90_px", predicted.worst_px, usable_px, "usable"),
    )
    return good + usable


def _at_least(name: str, value: float, limit: float, needed_for: Literal["good", "usable"]) -> Criterion:
    """A criterion met from the limit on; NaN never meets it."""
    return Criterion(name, float(value), "at least", float(limit), needed_for, bool(value >= limit))


def _at_most(name: str, value: float, limit: float, needed_for: Literal["good", "usable"]) -> Criterion:
    """A criterion met up to the limit; NaN never meets it."""
    return Criterion(name, float(value), "at most", float(limit), needed_for, bool(value <= limit))


def verdict_of(criteria: tuple[Criterion, ...]) -> Verdict:
    """The best verdict none of whose criteria failed."""
    lost = {criterion.needed_for for criterion in criteria if not criterion.passed}
    if "usable" in lost:
        return "failed"
    return "usable" if "good" in lost else "good"
