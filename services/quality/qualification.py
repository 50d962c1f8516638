"""Quality of a registration: figures, and a verdict that follows from thresholds alone."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from amers.services.quality.accuracy import Statistics, statistics
from amers.services.quality.accuracy_statement import AccuracyStatement, scene_accuracy
from amers.services.quality.cell_stability import CellStability, measure_cell_stability
from amers.services.quality.correction_accuracy import in_rings
from amers.services.quality.criteria import Criterion, Verdict, at_least, at_most, verdict_of
from amers.services.quality.finding import Finding
from amers.services.quality.findings import with_findings
from amers.services.quality.frames import why_unknown
from amers.services.quality.held_area import HeldArea
from amers.services.quality.predicted import PredictedAccuracy, predict_accuracy
from amers.services.quality.stability import (
    AdjustedScene,
    ImageResiduals,
    Stability,
    measure_stability,
    residuals_in_image,
)
from amers.services.sensors.base import SensorModel
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
        good_coverage_percent: smallest share of the image that points support, see `HeldArea`.
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
        good_second_consensus_share: has no effect any more: points that agree on another place are a
            finding. Requests of earlier versions state it.
        usable_active_points: smallest number of active points.
        usable_active_of_few: smallest ratio of active to matched points where fewer points are active
            than a good registration has, or where they scatter by more than one allows: part of a few
            points, and of points that hardly agree, agree on a wrong correction too.
        coverage_cells: cells along each side of the image in which points are counted.
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
    """The part of the image that active points support, see `HeldArea`: accuracy is stated for it.

    Attributes:
        cells: (c, c) active points in equal cells of the image, rows from the first line down.
        percent: of the image that is held, 0 to 100.
        reach_px: of a point.
        outline: rings of the area that is held, (n, 2) line and sample each, closed; holes follow the
            rings that surround them.
        polygons_lon_lat: the same on the ground, at the median height of the active points, degrees:
            coordinates of a GeoJSON MultiPolygon. Longitudes are continuous.
    """

    cells: Array
    percent: float
    reach_px: float
    outline: tuple[Array, ...]
    polygons_lon_lat: tuple[tuple[Array, ...], ...]

    def holds(self, line_sample: Array) -> BoolArray:
        """Which places (n, 2) of the image are held."""
        return in_rings(self.outline, line_sample)


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
        findings: what the correction does not follow, most harmful first; the accuracy includes them.
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
    findings: tuple[Finding, ...] = ()


def qualify(
    scene: AdjustedScene, options: QualificationOptions, rng: np.random.Generator
) -> Qualification:
    """The quality figures of a registration, compared with their thresholds.

    Args:
        scene: after its final adjustment.
        options: thresholds and sampling.
        rng: draws the points that are held out.
    """
    if scene.held is None:
        scene = with_findings(scene)
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
    if scene.held is None:
        scene = with_findings(scene)
    measures, adjustment = scene.measures, scene.adjustment
    point_counts = count_points(measures)
    residuals = residuals_in_image(measures.residual_px[measures.active])
    worse = _times_worse(adjustment.sigma0)
    residual_std_px, shown_residual_std_px = (
        unexplained_px(measures, times * adjustment.point_sigma_px) for times in (1.0, worse)
    )
    if point_counts.active < _ENOUGH_RESIDUALS and np.isfinite(tie_residual_px):
        residual_std_px = shown_residual_std_px = tie_residual_px
    predicted = predict_accuracy(scene, options.grid)
    assert scene.held is not None
    coverage = image_coverage(
        scene.model, measures.take(measures.active), scene.held, options.coverage_cells
    )
    figures = _Figures(
        active_points=point_counts.active,
        active_of_matched=point_counts.active_of_matched,
        coverage_percent=coverage.percent,
        residual_std_px=residual_std_px,
        shown_residual_std_px=shown_residual_std_px,
        displacement_px=max((place.median_px for place in stability.displacements), default=np.nan),
        predicted_ce90_px=predicted.worst_px,
        unit_weight=adjustment.sigma0,
    )
    control_px = max(scene.control_gsd_m / scene.gsd_m, 1.0)
    criteria = _criteria(figures, options, scene.gsd_m, control_px)
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
        accuracy=scene_accuracy(
            predicted.worst_m, predicted.on_the_earth_worst_m, scene.frame, coverage.percent
        ),
        coverage=coverage,
        findings=scene.findings,
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


def _residuals_on_ground(residual_m: Array) -> GroundResiduals:
    """Statistics of residuals (n, 2), east and north."""
    east, north = residual_m[:, 0], residual_m[:, 1]
    return GroundResiduals(statistics(east), statistics(north), statistics(np.hypot(east, north)))


def image_coverage(model: SensorModel, active: Measures, held: HeldArea, cells: int) -> Coverage:
    """The area that points support, and numbers of active points in `cells` x `cells` parts.

    Args:
        model: of the registered scene, for the area on the ground.
        active: measures of the active points.
        held: the area.
        cells: along each side of the image.
    """
    edges = [np.linspace(-0.5, size - 0.5, cells + 1) for size in held.shape]
    counts, _, _ = np.histogram2d(active.line_sample[:, 0], active.line_sample[:, 1], bins=edges)
    on_ground: tuple[tuple[Array, ...], ...] = ()
    if len(active.lon_lat_h):
        height_m = float(np.median(active.lon_lat_h[:, 2]))
        on_ground = tuple(
            tuple(_on_ground(model, ring, height_m) for ring in polygon) for polygon in held.polygons
        )
    rings = tuple(ring for polygon in held.polygons for ring in polygon)
    return Coverage(counts, held.percent, held.reach_px, rings, on_ground)


def _on_ground(model: SensorModel, line_sample: Array, height_m: float) -> Array:
    """Longitudes and latitudes (n, 2) of image positions (n, 2) at a height."""
    return model.locate(line_sample, np.full(len(line_sample), height_m))[:, :2]


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
