"""SCENE IN -> REGISTERED MODEL OUT: predict, match, agree, adjust, qualify. Start reading here."""

import math
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from services.adjustment.scene import AdjustmentOptions, SceneAdjustment, adjust_scene
from services.conventions import CHIP_CENTRE
from services.errors import CoverageError, NoConsensus, NotEnoughPoints
from services.imagery import ImageSource, ReducedImage, image_gsd_m, reduce_image
from services.matching.consensus import affine_consensus, vote
from services.matching.points import MatchingOptions, PointMatches, match_points
from services.matching.predict import inside, spread_over_image
from services.quality.qualification import Qualification, QualificationOptions, qualify
from services.scene import Scene, scene_gsd_m
from services.sensors.base import SensorModel
from services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from services.types import (
    Array,
    BoolArray,
    ChipSource,
    ControlPoints,
    IntArray,
    Measures,
    Progress,
    no_progress,
)


@dataclass(frozen=True)
class RegistrationOptions:
    """How a scene is registered.

    Attributes:
        max_points: how many points are tried at most, well spread over the image.
        coarse_points: how many of them in the coarse stage.
        coarse_score: normalised correlation below which a chip is not found in the coarse stage, where
            the consensus of many decides.
        max_fine_radius_px: up to this many pixels of the finest chips no coarse stage is needed.
        max_search_px: how far a chip is searched at most, chip pixels.
        fine_passes: how many times the finest chips are searched, each time through the last model.
        max_false_alarms: a coarse consensus that chance would give more often than this is refused.
        seed: of the random draws of the stability test.
        matching, adjustment, qualification: of the stages.
    """

    max_points: int = 500
    coarse_points: int = 60
    coarse_score: float = 0.5
    max_fine_radius_px: int = 24
    max_search_px: int = 400
    fine_passes: int = 2
    max_false_alarms: float = 1e-4
    seed: int = 0
    matching: MatchingOptions = field(default_factory=MatchingOptions)
    adjustment: AdjustmentOptions = field(default_factory=lambda: AdjustmentOptions(min_points=6))
    qualification: QualificationOptions = field(default_factory=QualificationOptions)


@dataclass(frozen=True)
class Pass:
    """One search of the points through one model.

    Attributes:
        name: "coarse" or "fine".
        chip_gsd_m: ground sampling of the chips.
        search_radius_m: how far they were searched.
        tried, matched, agreeing: numbers of points: searched, found, and part of the consensus.
        move_m: how far the agreeing points lay from where they were expected, root mean square.
    """

    name: str
    chip_gsd_m: float
    search_radius_m: float
    tried: int
    matched: int
    agreeing: int
    move_m: float


@dataclass(frozen=True)
class Registration:
    """A registered scene.

    Attributes:
        model: the scene's model with its correction.
        adjustment: the correction, its covariance, the residuals.
        measures: one row for every point the scene could show.
        passes: the searches, in order.
        qualification: how good it is.
    """

    model: CorrectedModel
    adjustment: SceneAdjustment
    measures: Measures
    passes: tuple[Pass, ...]
    qualification: Qualification


def register_scene(
    scene: Scene,
    points: ControlPoints,
    chips: ChipSource,
    options: RegistrationOptions = RegistrationOptions(),
    progress: Progress = no_progress,
    frame_sigma_m: float = math.nan,
) -> Registration:
    """Refine the model of a scene on control points.

    Args:
        scene: its model may be wrong by three times `scene.sigma_m`.
        points: those of its footprint; others are left aside.
        chips: of the points.
        options: thresholds.
        progress: told where the work stands.
        frame_sigma_m: how well the frame of the points is known on the Earth, one standard deviation a
            coordinate; it is reported beside the accuracy in that frame, never mixed into it.

    Raises:
        CoverageError: no point lies in the scene.
        NotEnoughPoints: too few points were found.
        NoConsensus: the points found do not agree on one correction.
    """
    visible, chosen = _choose_points(scene, points, options)
    tried = points.take(chosen)
    fine_m = float(points.views.gsd_m.min())
    model = CorrectedModel(scene.model, no_correction(scene.image.shape))
    uncertainty_m = _start_uncertainty(scene, tried)
    passes: list[Pass] = []

    if 3.0 * uncertainty_m.max() / fine_m > options.max_fine_radius_px:
        model, uncertainty_m, done = _coarse(
            scene, model, tried, chips, uncertainty_m, options, progress
        )
        passes.append(done)
    for number in range(options.fine_passes):
        radius_px = _radius_px(uncertainty_m, fine_m, options.max_search_px)
        part = _part_of(progress, 0.3 + 0.6 * number / options.fine_passes, 0.6 / options.fine_passes)
        matches = match_points(
            scene.image,
            model,
            tried,
            chips,
            fine_m,
            radius_px,
            _direction(scene),
            options.matching,
            part,
        )
        agreeing = _agreement(model, tried, matches, radius_px * fine_m, options)
        adjustment = _adjust(scene, tried, matches, agreeing, options)
        passes.append(_summary("fine", fine_m, radius_px, matches, agreeing))
        model = CorrectedModel(scene.model, adjustment.correction)
        uncertainty_m = _model_uncertainty(model, tried, adjustment)

    measures = _measures(scene, points, visible, chosen, matches, adjustment)
    progress(0.95, "qualifying the result")
    rows = np.searchsorted(visible, chosen)

    def refit(held: BoolArray) -> SceneAdjustment:
        fixed = replace(options.adjustment, order=adjustment.order)
        return _adjust(scene, tried, matches, held[rows], replace(options, adjustment=fixed))

    qualification = qualify(
        measures,
        adjustment,
        scene.image.shape,
        refit,
        scene_gsd_m(scene),
        options.qualification,
        np.random.default_rng(options.seed),
        frame_sigma_m,
    )
    progress(1.0, "registered")
    return Registration(model, adjustment, measures, tuple(passes), qualification)


def _choose_points(
    scene: Scene, points: ControlPoints, options: RegistrationOptions
) -> tuple[IntArray, IntArray]:
    """Rows of the points the scene may show, and of those to try; both ascending."""
    if len(points) == 0:
        raise CoverageError("no control point lies in the footprint of the scene")
    predicted = scene.model.project(points.lon_lat_h)
    margin_px = 3.0 * scene.sigma_m / scene_gsd_m(scene)
    visible = np.flatnonzero(inside(predicted, scene.image.shape, margin_px))
    if len(visible) == 0:
        raise CoverageError(
            f"none of the {len(points)} control points lies in the scene, "
            f"even with {margin_px:.0f} px of margin for its accuracy of {scene.sigma_m:g} m"
        )
    spread_m2 = np.trace(points.covariance_m2[visible], axis1=1, axis2=2)
    preference = points.saliency[visible] / (1.0 + spread_m2 / np.median(spread_m2))
    best = spread_over_image(predicted[visible], preference, scene.image.shape, options.max_points)
    return visible, np.sort(visible[best])


def _start_uncertainty(scene: Scene, points: ControlPoints) -> Array:
    """Standard deviation (n,) of where the delivered model expects the points, metres."""
    return np.asarray(np.sqrt(scene.sigma_m**2 + points.covariance_m2[:, [0, 1], [0, 1]].max(axis=1)))


def _radius_px(uncertainty_m: Array, gsd_m: float, largest: int) -> int:
    """Search radius that holds three standard deviations of nearly all points, chip pixels."""
    return int(np.clip(np.ceil(3.0 * np.percentile(uncertainty_m, 95) / gsd_m) + 2, 4, largest))


def _coarse(
    scene: Scene,
    model: CorrectedModel,
    points: ControlPoints,
    chips: ChipSource,
    uncertainty_m: Array,
    options: RegistrationOptions,
    progress: Progress,
) -> tuple[CorrectedModel, Array, Pass]:
    """A first correction from few points searched far, accepted only when they agree beyond chance."""
    gsd_m = _coarse_gsd(points, chips, scene, float(uncertainty_m.max()), options)
    has_chip = np.flatnonzero(_has_chip(points, gsd_m))
    line_sample = model.project(points.lon_lat_h[has_chip])
    best = spread_over_image(
        line_sample, points.saliency[has_chip], scene.image.shape, options.coarse_points
    )
    few = points.take(np.sort(has_chip[best]))
    radius_px = _radius_px(uncertainty_m, gsd_m, options.max_search_px)
    correlation = replace(options.matching.correlation, min_score=options.coarse_score, max_second=1.0)
    matching = replace(options.matching, correlation=correlation)
    progress(0.0, "coarse search")
    image = _image_for(scene, gsd_m, len(few), radius_px)
    part = _part_of(progress, 0.05, 0.25)
    matches = match_points(image, model, few, chips, gsd_m, radius_px, _direction(scene), matching, part)

    consensus = vote(matches.displacement_m, 3.0 * gsd_m, radius_px * gsd_m)
    if consensus.false_alarms > options.max_false_alarms:
        found = int((matches.reason == "").sum())
        raise NoConsensus(
            f"the coarse search does not agree on one correction: {len(few)} points tried within "
            f"{radius_px * gsd_m:.0f} m, {found} found, {int(consensus.agreeing.sum())} of them within "
            f"{3.0 * gsd_m:g} m of each other (chance alone: {consensus.false_alarms:.2g} times); "
            + reasons_in_words(matches.reason)
        )
    adjustment = _adjust(
        scene, few, matches, consensus.agreeing, _shift_for_few(options, consensus.agreeing)
    )
    corrected = CorrectedModel(scene.model, adjustment.correction)
    after_m = np.hypot(_model_uncertainty(corrected, points, adjustment), gsd_m / 2.0)
    return corrected, after_m, _summary("coarse", gsd_m, radius_px, matches, consensus.agreeing)


def _shift_for_few(options: RegistrationOptions, agreeing: BoolArray) -> RegistrationOptions:
    """Options that let a coarse consensus of few points carry a shift."""
    few = int(agreeing.sum())
    return replace(options, adjustment=replace(options.adjustment, min_points=min(3, few)))


def _coarse_gsd(
    points: ControlPoints,
    chips: ChipSource,
    scene: Scene,
    uncertainty_m: float,
    options: RegistrationOptions,
) -> float:
    """Ground sampling of the chips to begin with: the finest that can reach far enough.

    Chips are wanted that the scene can show wholly: large ones near the border, or in a small scene, may
    not be there at all.
    """
    line_sample = scene.model.project(points.lon_lat_h)
    for gsd_m in np.unique(points.views.gsd_m):
        reach_px = 3.0 * uncertainty_m / gsd_m
        if reach_px > options.max_fine_radius_px and gsd_m < points.views.gsd_m.max():
            margin_px = (CHIP_CENTRE * points.views.gsd_m.max()) / scene_gsd_m(scene)
            larger = _has_chip(points, float(points.views.gsd_m.max())) & inside(
                line_sample, scene.image.shape, -margin_px
            )
            if larger.sum() >= 12:
                continue
        return float(gsd_m)
    return float(points.views.gsd_m.max())


def _has_chip(points: ControlPoints, gsd_m: float) -> BoolArray:
    """Which points (n,) have a chip of a ground sampling."""
    count = np.concatenate([[0], np.cumsum(np.isclose(points.views.gsd_m, gsd_m))])
    return np.asarray(count[points.views.start[1:]] > count[points.views.start[:-1]])


def _image_for(scene: Scene, gsd_m: float, n_points: int, radius_px: int) -> ImageSource | ReducedImage:
    """The scene, or a reduction of it when the windows of the points would read more than all of it."""
    ratio = gsd_m / scene_gsd_m(scene)
    window = (2.0 * (CHIP_CENTRE + radius_px) * ratio) ** 2
    factor = int(ratio / 2.0)
    if factor > 1 and n_points * window > scene.image.shape[0] * scene.image.shape[1]:
        return reduce_image(scene.image, factor)
    return scene.image


def _direction(scene: Scene) -> tuple[float, float]:
    """Incidence and azimuth of the scene, degrees."""
    return scene.acquisition.incidence_deg, scene.acquisition.azimuth_deg


def _agreement(
    model: SensorModel,
    points: ControlPoints,
    matches: PointMatches,
    radius_m: float,
    options: RegistrationOptions,
) -> BoolArray:
    """Points whose measures fit one affine displacement, or an error that says why there are too few."""
    predicted = model.project(points.lon_lat_h)
    found = matches.reason == ""
    if found.sum() < options.adjustment.min_points:
        raise NotEnoughPoints(
            int(found.sum()),
            options.adjustment.min_points,
            f"{len(points)} tried within {radius_m:.1f} m, {reasons_in_words(matches.reason)}",
        )
    tolerance_px = 3.0 * float(np.median(_point_sigma_px(model, points, matches)[found])) + 0.5
    agreeing = affine_consensus(predicted, matches.line_sample - predicted, found, tolerance_px)
    if agreeing.sum() < options.adjustment.min_points:
        raise NoConsensus(
            f"{int(found.sum())} points found of {len(points)} tried, but only {int(agreeing.sum())} "
            f"agree within {tolerance_px:.1f} px, {options.adjustment.min_points} needed"
        )
    return agreeing


def _point_sigma_px(model: SensorModel, points: ControlPoints, matches: PointMatches) -> Array:
    """Standard deviation (n,) of the measures against the points' own positions, pixels."""
    derivative = model.project_derivative(points.lon_lat_h)
    covariance = derivative @ points.covariance_m2 @ derivative.transpose(0, 2, 1)
    return np.asarray(np.sqrt(matches.sigma_px**2 + np.trace(covariance, axis1=1, axis2=2) / 2.0))


def _adjust(
    scene: Scene,
    points: ControlPoints,
    matches: PointMatches,
    candidates: BoolArray,
    options: RegistrationOptions,
) -> SceneAdjustment:
    return adjust_scene(
        scene.model,
        scene.image.shape,
        points.lon_lat_h,
        matches.line_sample,
        matches.sigma_px,
        points.covariance_m2,
        options.adjustment,
        candidates,
        matches.common_sigma_m / scene_gsd_m(scene),
    )


def _model_uncertainty(
    model: CorrectedModel, points: ControlPoints, adjustment: SceneAdjustment
) -> Array:
    """Standard deviation (n,) of where the points are expected after an adjustment, metres.

    What the residuals show beyond the stated sigmas is counted too: a point still to be found may be as
    far off as those that were.
    """
    line_sample = model.project(points.lon_lat_h)
    std_px = correction_std_px(adjustment.correction, adjustment.covariance, line_sample).max(axis=1)
    residual_px = float(np.sqrt(np.mean(adjustment.residual_px[adjustment.active] ** 2)))
    gsd_m = np.array([image_gsd_m(model, ground) for ground in points.lon_lat_h])
    return np.asarray(np.nan_to_num(np.hypot(std_px, residual_px) * gsd_m, nan=0.0))


def correction_std_px(correction: ImageCorrection, covariance: Array, line_sample: Array) -> Array:
    """Standard deviation of a corrected model at image positions.

    Args:
        correction: of the model.
        covariance: (6, 6) of its parameters, px^2.
        line_sample: (n, 2).

    Returns:
        (n, 2) line, sample, pixels.
    """
    t = (line_sample - correction.centre) / correction.half_size
    design = np.column_stack([np.ones(len(t)), t])
    blocks = covariance[:3, :3], covariance[3:, 3:]
    return np.sqrt(
        np.column_stack([np.einsum("ni,ij,nj->n", design, block, design) for block in blocks])
    )


def _measures(
    scene: Scene,
    points: ControlPoints,
    visible: IntArray,
    chosen: IntArray,
    matches: PointMatches,
    adjustment: SceneAdjustment,
) -> Measures:
    """One row for every visible point; those that were not tried say so."""
    n = len(visible)
    rows = np.searchsorted(visible, chosen)

    def scattered(values: Array, width: int = 0) -> Array:
        out = np.full((n, width) if width else n, np.nan)
        out[rows] = values
        return out

    derivative = CorrectedModel(scene.model, adjustment.correction).project_derivative(
        points.lon_lat_h[chosen]
    )
    residual_m = np.asarray(
        np.linalg.solve(derivative[:, :, :2], adjustment.residual_px[:, :, None])[:, :, 0], np.float64
    )
    matched = np.zeros(n, dtype=bool)
    matched[rows] = matches.reason == ""
    active = np.zeros(n, dtype=bool)
    active[rows] = adjustment.active
    reason = np.full(n, "not_tried", dtype="<U16")
    reason[rows] = np.where(
        adjustment.active, "", np.where(matches.reason == "", "deactivated", matches.reason)
    )
    views = np.zeros(n, dtype=np.int64)
    views[rows] = matches.views
    return Measures(
        point_id=points.id[visible],
        lon_lat_h=points.lon_lat_h[visible],
        predicted=scene.model.project(points.lon_lat_h[visible]),
        line_sample=scattered(matches.line_sample, 2),
        sigma_px=scattered(matches.sigma_px),
        score=scattered(matches.score),
        views=views,
        residual_px=scattered(adjustment.residual_px, 2),
        residual_m=scattered(residual_m, 2),
        matched=matched,
        active=active,
        reason=reason,
    )


def _summary(
    name: str, gsd_m: float, radius_px: int, matches: PointMatches, agreeing: BoolArray
) -> Pass:
    move_m = matches.displacement_m[agreeing]
    return Pass(
        name=name,
        chip_gsd_m=gsd_m,
        search_radius_m=radius_px * gsd_m,
        tried=len(matches.reason),
        matched=int((matches.reason == "").sum()),
        agreeing=int(agreeing.sum()),
        move_m=float(np.sqrt((move_m**2).sum(axis=1).mean())) if len(move_m) else math.nan,
    )


def reasons_in_words(reason: np.ndarray) -> str:
    """How many points were not found, and why: "22 low_score, 16 nodata"."""
    counted = Counter(str(r) for r in reason if r)
    return ", ".join(f"{count} {name}" for name, count in counted.most_common()) or "none rejected"


def _part_of(progress: Progress, start: float, share: float) -> Progress:
    """Progress of a part, as progress of the whole."""
    return lambda fraction, message: progress(start + share * fraction, message)
