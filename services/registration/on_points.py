"""Registration of a scene on points: predict, match, adjust, qualify. Start reading here."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from amers.services.conventions import CHIP_SIZE
from amers.services.errors import (
    ComputationError,
    CoverageError,
    NoConsensus,
    NotEnoughPoints,
    RescaledImage,
    TurnedImage,
)
from amers.services.imagery.line_breaks import scene_breaks
from amers.services.imagery.scene import Scene, with_pixel_findings
from amers.services.imagery.source import CachedImage
from amers.services.matching.consensus import Voters
from amers.services.matching.control_points import ChipSearch, match_points
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.quality.findings import with_findings
from amers.services.quality.frames import shared_frame
from amers.services.quality.marks import MarksReport, marks_beside_points
from amers.services.quality.points_elsewhere import Elsewhere
from amers.services.quality.qualification import Qualification, qualify
from amers.services.quality.stability import AdjustedScene
from amers.services.registration.another_view import another_view
from amers.services.registration.broken import naming_breaks
from amers.services.registration.chip_selection import fine_gsd_m
from amers.services.registration.coarse import needs_coarse_search, refuse_rescaled, search_coarsely
from amers.services.registration.context import (
    PointContext,
    Prediction,
    RegistrationContext,
    SearchStage,
)
from amers.services.registration.elsewhere import adjust_with_places
from amers.services.registration.missed_points import search_missed_points
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.point_results import point_results
from amers.services.registration.point_selection import initial_prediction, points_to_try, visible_points
from amers.services.registration.rescaled import how_it_is_rescaled
from amers.services.registration.scene_marks import SceneMarks, adjust_with_marks
from amers.services.registration.search import (
    Search,
    adjust_search,
    check_inliers,
    largest_error_m,
    predict,
    search_radius_px,
    select_inliers,
    shears_of_active,
    summarise,
)
from amers.services.registration.turned import turned_scenes
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel
from amers.services.types import (
    BoolArray,
    ChipSource,
    ControlPoints,
    Frame,
    IntArray,
    Measures,
    Progress,
    ViewMeasures,
    no_progress,
)

_FEWEST_REPEATED = 4
"""Points with which an adjustment is repeated: also a scene of the fewest points that a registration
takes can be repeated without some of them."""
_AGREEING = 12
"""Points that agree on an image that is turned, at least, and half of those found."""
_FEW_POINTS, _FEW_VIEWS = 60, 2
_FEW_COARSE_POINTS = 2 * _AGREEING
"""Points that a coarse search for an image that is turned expects to see; chips that reach far are
correlated in as many fewer pixels. Seven turns are searched, and few points agree by chance."""


@dataclass(frozen=True)
class Registration:
    """A registered scene.

    Attributes:
        model: the scene's model with its correction.
        adjustment: the correction, its covariance, the residuals.
        measures: one row for every point that the scene could show.
        views: results of the views of these points in the last search.
        search_stages: summaries of the searches, in order.
        frame: of the control on the Earth, see `shared_frame`.
        qualification: quality figures and verdict.
        marks: what became of marks of a person; None without any.
    """

    model: SensorModel
    adjustment: SceneAdjustment
    measures: Measures
    views: ViewMeasures
    search_stages: tuple[SearchStage, ...]
    frame: Frame
    qualification: Qualification
    marks: MarksReport | None = None

    def __repr__(self) -> str:
        counts, order = self.qualification.point_counts, self.adjustment.order
        relative, on_the_earth = self.qualification.accuracy.lines
        return (
            f"Registration: {self.qualification.verdict}; {order} on {counts.active} of "
            f"{counts.matched} points found, {counts.visible} in the scene\n"
            f"  {relative}\n"
            f"  {on_the_earth}"
        )


def register_scene(
    scene: Scene,
    points: ControlPoints,
    chips: ChipSource,
    options: RegistrationOptions = RegistrationOptions(),
    *,
    marks: SceneMarks | None = None,
    progress: Progress = no_progress,
    stages: list[SearchStage] | None = None,
) -> Registration:
    """Refine the model of a scene on control points.

    Args:
        scene: its model may be wrong by three times `scene.sigma_m`.
        points: those of its footprint; points outside the scene are left aside.
        chips: of the points.
        options: of all stages.
        marks: of a person in the scene: observations of the same adjustment.
        progress: receives the fraction done and the work under way.
        stages: receives the summaries of the searches, also of one that is refused.

    Raises:
        CoverageError: no point lies in the scene.
        NotEnoughPoints: too few points were found.
        NoConsensus: the points found do not agree on one correction.
        TurnedImage: they agree on an image that is turned.
        RescaledImage: they agree on an image with finer or coarser pixels than its model says.
        BrokenImage: too few points were found, or agree, and lines of the image were lost or repeated.
    """
    scene = with_pixel_findings(scene)
    rescaled = cache(partial(how_it_is_rescaled, scene, points, chips, options))
    try:
        with naming_breaks(scene):
            context, search, adjustment = search_scene(
                scene, points, chips, options, progress=progress, stages=stages, rescaled=rescaled
            )
    except RescaledImage:
        raise
    except (NoConsensus, NotEnoughPoints) as error:
        refuse_rescaled(rescaled, error)
        turned = _how_it_is_turned(scene, points, chips, options)
        if not turned:
            raise
        raise TurnedImage(f"the image is {turned} ({error})") from error
    search, adjustment, elsewhere = adjust_with_places(context, search, adjustment)
    return build_registration(context, context.points, search, adjustment, elsewhere, marks=marks)


def _how_it_is_turned(
    scene: Scene, points: ControlPoints, chips: ChipSource, options: RegistrationOptions
) -> str:
    """How a scene that was not found is turned against its model; "" when it is not, as far as seen."""
    coarse = replace(options.coarse, points=min(_FEW_COARSE_POINTS, options.coarse.points))
    matching = replace(options.matching, max_views=min(_FEW_VIEWS, options.matching.max_views))
    few = replace(options, max_points=_FEW_POINTS, fine_stages=1, coarse=coarse, matching=matching)
    for words, turned in turned_scenes(scene):
        try:
            _, search, adjustment = search_scene(turned, points, chips, few)
        except (CoverageError, ComputationError):
            continue
        found, active = int((search.matches.reason == "").sum()), int(adjustment.active.sum())
        if active >= max(_AGREEING, found / 2):
            return f"{words}, by {active} points that agree then; turn the image or its model"
    return ""


def search_scene(
    scene: Scene,
    points: ControlPoints,
    chips: ChipSource,
    options: RegistrationOptions = RegistrationOptions(),
    *,
    progress: Progress = no_progress,
    stages: list[SearchStage] | None = None,
    rescaled: Callable[[], str] = lambda: "",
) -> tuple[PointContext, Search, SceneAdjustment]:
    """The last search of the points of a scene, and the adjustment on it: see `register_scene`."""
    points = points.take(visible_points(scene, points))
    prediction = initial_prediction(scene, points)
    context = PointContext(
        scene=scene,
        options=options,
        progress=progress,
        stages=[] if stages is None else stages,
        breaks=None,
        points=points,
        chips=chips,
        image=CachedImage(scene.image),
        fine_gsd_m=fine_gsd_m(scene, points, prediction),
    )
    if needs_coarse_search(context, prediction):
        prediction = search_coarsely(context.part(0.0, 0.3), prediction, rescaled)
    for stage, part in enumerate(context.parts(0.3, 0.6, options.fine_stages), start=1):
        rows = points_to_try(scene, points, prediction, options.max_points)
        last = stage == options.fine_stages
        search = _match(part, prediction, rows, parts=last)
        if context.breaks is None:
            context = replace(context, breaks=scene_breaks(scene))
        search = replace(search, breaks=context.breaks)
        adjustment = adjust_search(scene, search, options.adjustment, ground_may_move=last)
        prediction = predict(scene, points, adjustment)
    return context, *search_missed_points(context, prediction, search, adjustment)


def _match(context: PointContext, prediction: Prediction, rows: IntArray, *, parts: bool) -> Search:
    """A search of some of the points with the fine chips, of which enough have to agree."""
    search, tolerance_px = search_near(context, prediction, rows, parts=parts)
    scene, stage = context.scene, context.stages[-1]
    lon_lat_h, measured = search.points.lon_lat_h, search.matches.line_sample
    predicted = prediction.model.project(lon_lat_h)
    check_inliers(
        stage,
        tolerance_px,
        search.matches.reason,
        scene,
        context.options.adjustment.min_points,
        of_another=lambda: another_view(scene, stage, lon_lat_h, predicted, measured),
    )
    return search


def search_near(
    context: PointContext, prediction: Prediction, rows: IntArray, *, parts: bool = True
) -> tuple[Search, float]:
    """A search of some of the points with the fine chips, within the error of their prediction.

    Args:
        context: of the registration; the summary of the search is added to it.
        prediction: of all its points.
        rows: of the points to search.
        parts: whether parts of the chips are compared, too, which only the last search needs.

    Returns:
        The search, and the tolerance within which its inliers agree, pixels.
    """
    options, gsd_m = context.options, context.fine_gsd_m
    points = context.points.take(rows)
    error_m = largest_error_m(prediction.uncertainty_m[rows])
    radius_px = min(search_radius_px(error_m, gsd_m), options.coarse.max_search_px)
    chip_search = ChipSearch(
        context.image, prediction.model, context.scene.acquisition, gsd_m, radius_px, parts=parts
    )
    matches = match_points(chip_search, points, context.chips, options.matching, context.progress)
    inliers, tolerance_px = select_inliers(prediction.model, points, matches)
    stage = summarise(
        "fine",
        matches,
        inliers,
        level_m=gsd_m,
        radius_m=radius_px * gsd_m,
        needed_m=error_m,
        voters=Voters(matches.line_sample, CHIP_SIZE * gsd_m / context.gsd_m),
        lon_lat_h=points.lon_lat_h,
    )
    context.stages.append(stage)
    displacement = prediction.model.correction.displacement
    side_m = CHIP_SIZE * gsd_m
    search = Search(points, rows, matches, inliers, side_m, displacement, context.breaks)
    return search, tolerance_px


def build_registration(
    context: RegistrationContext,
    points: ControlPoints,
    search: Search,
    adjustment: SceneAdjustment,
    elsewhere: Elsewhere | None = None,
    *,
    marks: SceneMarks | None = None,
) -> Registration:
    """The registration that the last search and its adjustment give, with its quality.

    Args:
        context: of the registration.
        points: all points that the scene may show.
        search: the last search of a part of them.
        adjustment: on this search.
        elsewhere: points that agree on another displacement; None when there are none.
        marks: of a person in the scene, which are added to the adjustment; None without any.
    """
    if marks is not None:
        points, search, adjustment = adjust_with_marks(
            context.scene, points, search, marks, context.options.adjustment
        )
    context.progress(0.95, "qualifying the result")
    scene, options = context.scene, context.options
    measures = point_results(scene, points, search, adjustment)

    def refit(used: BoolArray) -> SceneAdjustment:
        usable = used[search.rows]
        return adjust_search(
            scene,
            search,
            options.adjustment,
            usable=usable,
            min_points=_FEWEST_REPEATED,
            like=adjustment,
        )

    frame = shared_frame(points, measures.active)
    model = CorrectedModel(scene.model, adjustment.correction)
    unjudged = AdjustedScene(
        model,
        measures,
        adjustment,
        scene.image.shape,
        context.gsd_m,
        frame,
        refit,
        elsewhere,
        control_gsd_m=context.stages[-1].chip_gsd_m,
        breaks=context.breaks,
        shears=shears_of_active(scene, search, measures.active),
        pixel_findings=scene.pixel_findings or (),
    )
    adjusted = with_findings(unjudged)
    rng = np.random.default_rng(options.seed)
    qualification = qualify(adjusted, options.qualification, rng)
    view_measures = search.matches.view_measures
    views = replace(view_measures, point=search.rows[view_measures.point])
    context.progress(1.0, "registered")
    report = None
    if marks is not None:
        report = marks_beside_points(adjusted, marks.names, marks.sigma_m)
    return Registration(
        model,
        adjusted.adjustment,
        measures,
        views,
        tuple(context.stages),
        frame,
        qualification,
        report,
    )
