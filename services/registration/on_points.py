"""SCENE IN -> REGISTERED MODEL OUT: predict, match, agree, adjust, qualify. Start reading here."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from services.adjustment.image_correction import AdjustmentOptions, SceneAdjustment
from services.errors import InputError
from services.imagery.scene import Scene, scene_gsd_m
from services.imagery.source import CachedImage
from services.matching.control_points import ChipSearch, MatchingOptions, PointMatches, match_points
from services.quality.qualification import Qualification, QualificationOptions, qualify
from services.registration.chip_selection import fine_gsd_m
from services.registration.coarse import CoarseOptions, search_coarsely
from services.registration.point_results import point_results
from services.registration.point_selection import points_to_try, start_uncertainty_m, visible_points
from services.registration.search import (
    SearchStage,
    adjust_matches,
    model_uncertainty_m,
    search_radius_px,
    select_inliers,
    summarised,
)
from services.sensors.correction import CorrectedModel, no_correction
from services.types import (
    BoolArray,
    ChipSource,
    ControlPoints,
    IntArray,
    Measures,
    Progress,
    ViewMeasures,
    no_progress,
    part_of,
)


@dataclass(frozen=True)
class RegistrationOptions:
    """How a scene is registered.

    Attributes:
        max_points: how many points are tried at most, well spread over the image; 0 for all.
        fine_passes: how many times the finest chips are searched, each time through the last model.
        seed: of the random draws of the stability test.
        coarse, matching, adjustment, qualification: of the stages.
    """

    max_points: int = 500
    fine_passes: int = 2
    seed: int = 0
    coarse: CoarseOptions = field(default_factory=CoarseOptions)
    matching: MatchingOptions = field(default_factory=MatchingOptions)
    adjustment: AdjustmentOptions = field(default_factory=lambda: AdjustmentOptions(min_points=6))
    qualification: QualificationOptions = field(default_factory=QualificationOptions)

    def __post_init__(self) -> None:
        """Refuse what no registration can be made with."""
        for name, least in (("max_points", 0), ("fine_passes", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: {getattr(self, name)} given, {least} or more expected")


@dataclass(frozen=True)
class Registration:
    """A registered scene.

    Attributes:
        model: the scene's model with its correction.
        adjustment: the correction, its covariance, the residuals.
        measures: one row for every point the scene could show.
        views: what the last search did with the views of these points.
        passes: the searches, in order.
        qualification: how good it is.
    """

    model: CorrectedModel
    adjustment: SceneAdjustment
    measures: Measures
    views: ViewMeasures
    passes: tuple[SearchStage, ...]
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
    visible = visible_points(scene, points)
    shown = points.take(visible)
    model = CorrectedModel(scene.model, no_correction(scene.image.shape))
    uncertainty_m = start_uncertainty_m(scene, shown)
    fine_m = fine_gsd_m(scene, shown, uncertainty_m)
    passes: list[SearchStage] = []

    if 3.0 * uncertainty_m.max() / fine_m > options.coarse.max_fine_radius_px:
        model, uncertainty_m, done = search_coarsely(
            scene,
            model,
            shown,
            chips,
            uncertainty_m,
            options.coarse,
            options.matching,
            options.adjustment,
            part_of(progress, 0.0, 0.3),
        )
        passes.append(done)
    image = CachedImage(scene.image)
    for number in range(options.fine_passes):
        chosen = points_to_try(scene, model, shown, uncertainty_m, options.max_points)
        tried = shown.take(chosen)
        radius_px = search_radius_px(uncertainty_m[chosen], fine_m, options.coarse.max_search_px)
        part = part_of(progress, 0.3 + 0.6 * number / options.fine_passes, 0.6 / options.fine_passes)
        search = ChipSearch(image, model, scene.acquisition, fine_m, radius_px)
        matches = match_points(search, tried, chips, options.matching, part)
        agreeing = select_inliers(
            model, tried, matches, radius_px * fine_m, options.adjustment.min_points
        )
        adjustment = adjust_matches(scene, tried, matches, agreeing, options.adjustment)
        passes.append(summarised("fine", fine_m, radius_px, matches, agreeing))
        model = CorrectedModel(scene.model, adjustment.correction)
        uncertainty_m = model_uncertainty_m(model, shown, adjustment)

    progress(0.95, "qualifying the result")
    registration = build_registration(
        scene,
        points,
        (visible, visible[chosen]),
        matches,
        adjustment,
        tuple(passes),
        options,
        frame_sigma_m,
    )
    progress(1.0, "registered")
    return registration


def build_registration(
    scene: Scene,
    points: ControlPoints,
    rows: tuple[IntArray, IntArray],
    matches: PointMatches,
    adjustment: SceneAdjustment,
    passes: tuple[SearchStage, ...],
    options: RegistrationOptions,
    frame_sigma_m: float,
) -> Registration:
    """A registration from its last search and adjustment, with all that says how good it is.

    Args:
        scene: as delivered.
        points: control points.
        rows: of the points that the scene may show, and of those that were tried; ascending.
        matches: of the points tried.
        adjustment: of the points tried.
        passes: the searches, in order.
        options: of the adjustment and the qualification, and the seed of the draws.
        frame_sigma_m: see `register_scene`.
    """
    visible, chosen = rows
    tried = points.take(chosen)
    measures = point_results(scene, points, rows, matches, adjustment)
    row_of_tried = np.searchsorted(visible, chosen)

    def refit(held: BoolArray) -> SceneAdjustment:
        fixed = options.adjustment
        if fixed.order is None:
            fixed = replace(fixed, order="affine", slope_px=adjustment.slope_px)
        return adjust_matches(scene, tried, matches, held[row_of_tried], fixed)

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
    model = CorrectedModel(scene.model, adjustment.correction)
    views = replace(matches.view_measures, point=row_of_tried[matches.view_measures.point])
    return Registration(model, adjustment, measures, views, passes, qualification)
