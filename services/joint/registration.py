"""Joint registration of scenes: control points in each, tie points between them, one solution."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from amers.services.adjustment.known_images import KnownImages
from amers.services.errors import ComputationError, CoverageError, DoesNotFit
from amers.services.imagery.line_breaks import scene_breaks
from amers.services.imagery.scene import Scene, with_pixel_findings
from amers.services.imagery.source import CachedImage, image_gsds_m
from amers.services.joint.block import JointBlock, repeated
from amers.services.joint.fitting import Left, SceneFit, adjust_fitting, scene_fit, ties_between
from amers.services.joint.measured import (
    MeasuredScene,
    nothing_found,
    options_in_block,
    with_own_marks,
    without_own_marks,
)
from amers.services.joint.model_errors import with_every_term_free
from amers.services.joint.results import (
    RigorousScene,
    held_cells,
    held_draws,
    registered_scene,
    rigorous_scene,
    scene_measures,
)
from amers.services.matching.ground_features import FeatureOptions
from amers.services.production.image_passes import image_passes
from amers.services.production.point_views import check_image_names
from amers.services.production.tie_points import find_tie_points
from amers.services.registration.chip_selection import fine_gsd_m
from amers.services.registration.context import PointContext, Prediction, SearchStage
from amers.services.registration.elsewhere import adjust_with_places
from amers.services.registration.on_points import Registration, search_near, search_scene
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.point_selection import initial_prediction, points_to_try, visible_points
from amers.services.registration.scene_marks import SceneMarks
from amers.services.registration.search import adjust_search
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.tasks import Work
from amers.services.types import (
    Array,
    ChipSource,
    ControlPoints,
    IntArray,
    Observations,
    Progress,
    no_progress,
    part_of,
)


@dataclass(frozen=True)
class AdjustedScenes:
    """Scenes that were adjusted together before, and that others join.

    Attributes:
        scenes: with their models as delivered.
        known: what their adjustment has told of them.
    """

    scenes: tuple[Scene, ...]
    known: KnownImages


@dataclass(frozen=True)
class JointRegistration:
    """Scenes registered together.

    Attributes:
        block: the scenes that fit, with the adjustment of all of them. Scenes that were adjusted before
            come first.
        numbers: of the scenes of the block that were registered now.
        registrations: of these.
        fits: how they fit.
        rigorous: what was found of those with a rigorous model; None for the others.
        left: scenes that did not fit.
    """

    block: JointBlock
    numbers: tuple[int, ...]
    registrations: tuple[Registration, ...]
    fits: tuple[SceneFit, ...]
    rigorous: tuple[RigorousScene | None, ...]
    left: tuple[Left, ...]


def register_together(
    scenes: Sequence[Scene],
    points: ControlPoints,
    chips: ChipSource,
    options: RegistrationOptions = RegistrationOptions(),
    *,
    marks: Sequence[SceneMarks] | None = None,
    joined: AdjustedScenes | None = None,
    work: Work | None = None,
    progress: Progress = no_progress,
) -> JointRegistration:
    """Refine the models of scenes on control points, in one adjustment with their tie points.

    Every scene is searched for control points as a scene alone. Where too few are found, they are
    searched again around where the other scenes, through tie points, expect them. A scene that does not
    fit leaves, and the others are adjusted without it.

    Args:
        scenes: their models may be wrong by three times `sigma_m`.
        points: of the ground of all scenes.
        chips: of the points.
        options: of the searches, of the corrections and of the qualification.
        marks: of a person, for each scene; they may be none, and share one frame. None for no marks.
        joined: scenes that were adjusted before; they stay as they are.
        work: computes the searches and the tie points; by default in this process.
        progress: receives the fraction done.

    Raises:
        InputError: two scenes have the same name.
        ComputationError: no scene shows control points that agree, or no scene fits.
    """
    before, known = (joined.scenes, joined.known) if joined else ((), None)
    scenes = [_on_known_ground(scene, points) for scene in scenes]
    check_image_names([*before, *scenes])
    work = work or Work()
    measured = [nothing_found(scene, points.take(np.zeros(0, dtype=np.int64))) for scene in before]
    searching = partial(measure_scene, points=points, chips=chips, options=options)
    measured += _measure_all(scenes, searching, work, part_of(progress, 0.0, 0.4))
    if marks is not None:
        every = [*(marks[0].take(np.zeros(0, dtype=np.int64)) for _ in before), *marks]
        measured = [with_own_marks(one, own, options) for one, own in zip(measured, every, strict=True)]
    ties = _ties(measured, work, part_of(progress, 0.4, 0.3))
    progress(0.7, "adjusting the scenes together")
    again = part_of(progress, 0.72, 0.08)
    search_again = partial(_searched_again, points=points, chips=chips, options=options, progress=again)
    block, left = _fitted(measured, ties, options, known, search_again)
    names = {scene.acquisition.image_id for scene in before}
    numbers = tuple(k for k, one in enumerate(block.scenes) if one.name not in names)
    if not numbers:
        raise left[0].error if left else DoesNotFit("no scene fits")
    registrations = qualified(block, numbers, options, known, part_of(progress, 0.8, 0.2))
    fits = tuple(scene_fit(block, number) for number in numbers)
    rigorous = tuple(rigorous_scene(block, number) for number in numbers)
    return JointRegistration(block, numbers, registrations, fits, rigorous, tuple(left))


def _fitted(
    measured: list[MeasuredScene],
    ties: Observations,
    options: RegistrationOptions,
    known: KnownImages | None,
    search_again: Callable[[JointBlock], dict[str, MeasuredScene]],
) -> tuple[JointBlock, list[Left]]:
    """The scenes that fit, searched again where the others expect their points, and those that left."""
    block, left = adjust_fitting(measured, ties, options, known)
    again = search_again(block)
    if not again:
        return block, left
    gone = {one.measured.name for one in left}
    kept = [number for number, one in enumerate(measured) if one.name not in gone]
    found = [again.get(measured[number].name, measured[number]) for number in kept]
    block, others = adjust_fitting(found, ties_between(ties, kept), options, known)
    return block, [*left, *others]


def _on_known_ground(scene: Scene, points: ControlPoints) -> Scene:
    """The scene with its rigorous model limited to the ground of the points.

    Rays are searched for along these heights, and other models do not hold beyond theirs.
    """
    if not isinstance(scene.model, PushbroomModel) or not len(points):
        return scene
    height_m = points.lon_lat_h[:, 2]
    margin_m = max(_HEIGHT_MARGIN_M, float(np.ptp(height_m)))
    low, high = scene.model.height_range_m
    low, high = max(low, float(height_m.min()) - margin_m), min(high, float(height_m.max()) + margin_m)
    return replace(scene, model=replace(scene.model, height_range_m=(low, high)))


_HEIGHT_MARGIN_M = 500.0
"""Least height of ground above and below the control points."""


def _measure_all(
    scenes: Sequence[Scene],
    measure: Callable[[Scene], MeasuredScene],
    work: Work,
    progress: Progress,
) -> list[MeasuredScene]:
    """The scenes with the control points that each shows."""
    pending = [work.executor.submit(measure, scene) for scene in scenes]
    try:
        measured = []
        for number, future in enumerate(pending):
            progress(number / len(scenes), f"searching points: {number} of {len(scenes)} scenes")
            found = future.result()
            # Its pixels were measured where it was searched; its image is the one that is open here.
            scene = replace(scenes[number], pixel_findings=found.scene.pixel_findings)
            measured.append(replace(found, scene=scene))
        return measured
    finally:
        for future in pending:
            future.cancel()


def measure_scene(
    scene: Scene, points: ControlPoints, chips: ChipSource, options: RegistrationOptions
) -> MeasuredScene:
    """A scene with its control points, found as those of a scene alone; with none where that fails."""
    options = options_in_block(options)
    scene = with_pixel_findings(scene)
    stages: list[SearchStage] = []
    try:
        context, search, alone = search_scene(scene, points, chips, options, stages=stages)
        search, alone, elsewhere = adjust_with_places(context, search, alone)
    except CoverageError:
        return nothing_found(scene, points.take(np.zeros(0, dtype=np.int64)))
    except ComputationError:
        shown = points.take(visible_points(scene, points))
        return replace(nothing_found(scene, shown), stages=tuple(stages))
    return MeasuredScene(scene, context.points, search, alone, tuple(stages), elsewhere)


def _ties(measured: Sequence[MeasuredScene], work: Work, progress: Progress) -> Observations:
    """Tie points between scenes, looked for by models that their own control points have corrected."""
    none = np.zeros(0, dtype=np.int64)
    if len(measured) < 2:
        return Observations(none, none, np.empty((0, 2)), np.empty(0))
    scenes = [
        one.scene
        if one.alone is None
        else replace(one.scene, model=CorrectedModel(one.scene.model, one.alone.correction))
        for one in measured
    ]
    passes = image_passes([scene.acquisition for scene in scenes])
    # Their measures are ties themselves: nothing measures them again on finer pixels.
    return find_tie_points(scenes, passes, FeatureOptions(most_reduced=1.0), work, progress)


def _searched_again(
    block: JointBlock,
    points: ControlPoints,
    chips: ChipSource,
    options: RegistrationOptions,
    progress: Progress,
) -> dict[str, MeasuredScene]:
    """Scenes that their own points did not place, searched around where the block expects points."""
    again = {}
    for number, measured in enumerate(block.scenes):
        own = measured.marks
        shown, scene = (measured if own is None else without_own_marks(measured)).points, measured.scene
        if measured.alone is not None or not len(shown):
            continue
        model = block.model(number)
        context = PointContext(
            scene=scene,
            options=options_in_block(options),
            progress=progress,
            stages=list(measured.stages),
            breaks=scene_breaks(scene),
            points=shown,
            chips=chips,
            image=CachedImage(scene.image),
            fine_gsd_m=fine_gsd_m(scene, shown, initial_prediction(scene, shown)),
        )
        unmoved = CorrectedModel(model, no_correction(scene.image.shape))
        prediction = Prediction(unmoved, _uncertainty_m(block, number, shown))
        rows = points_to_try(scene, shown, prediction, options.max_points)
        search, _ = search_near(context, prediction, rows)
        alone, elsewhere = None, None
        with suppress(ComputationError):
            alone = adjust_search(scene, search, context.options.adjustment, ground_may_move=True)
            search, alone, elsewhere = adjust_with_places(context, search, alone)
        found = MeasuredScene(scene, shown, search, alone, tuple(context.stages), elsewhere)
        again[measured.name] = found if own is None else with_own_marks(found, own, options)
    return again


def _uncertainty_m(block: JointBlock, number: int, points: ControlPoints) -> Array:
    """Standard deviation (n,) of where a scene of a block shows points that it was not searched for."""
    image, model = block.images[number], block.model(number)
    design = image.computed(block.values(number), points.lon_lat_h).by_parameters
    of_scene = design @ block.covariance(number) @ design.transpose(0, 2, 1)
    derivative = model.project_derivative(points.lon_lat_h)
    of_points = derivative @ points.covariance_m2 @ derivative.transpose(0, 2, 1)
    variance = np.diagonal(of_scene + of_points, 0, 1, 2).max(axis=1)
    return np.asarray(np.nan_to_num(np.sqrt(variance)) * image_gsds_m(model, points.lon_lat_h))


def qualified(
    block: JointBlock,
    numbers: Sequence[int],
    options: RegistrationOptions = RegistrationOptions(),
    known: KnownImages | None = None,
    progress: Progress = no_progress,
) -> tuple[Registration, ...]:
    """The registrations of some scenes, with the adjustment repeated without parts of their points."""
    limits = options.qualification
    measures = [scene_measures(block, number, options) for number in numbers]
    rng = np.random.default_rng(options.seed)
    draws = held_draws(measures, limits.draws, limits.kept_share, rng)
    cells = held_cells(measures)
    without: list[tuple[list[IntArray], JointBlock | None]] = []
    for count, held in enumerate([*draws, *cells]):
        progress(count / (len(draws) + len(cells)), "repeating the adjustment with fewer points")
        none: list[IntArray] = [np.zeros(0, dtype=np.int64) for _ in block.scenes]
        for number, own in zip(numbers, held, strict=True):
            none[number] = own
        try:
            without.append((none, repeated(block, none, known)))
        except ComputationError:
            without.append((none, None))
    drawn, of_cells = without[: len(draws)], without[len(draws) :]
    complete = with_every_term_free(block, options, known)
    return tuple(
        registered_scene(block, number, options, drawn=drawn, cells=of_cells, complete=complete)
        for number in numbers
    )
