"""Registration of a scene on a reference image, without control points."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from amers.services.conventions import CHIP_SIZE, MAX_ERROR_SIGMAS
from amers.services.errors import ComputationError, CoverageError, NoConsensus, NotEnoughPoints
from amers.services.imagery.line_breaks import scene_breaks
from amers.services.imagery.scene import Scene, scene_centre, scene_gsd_m, with_pixel_findings
from amers.services.imagery.source import (
    CachedImage,
    ImageSource,
    ReducedImage,
    image_gsds_m,
    reduce_image,
)
from amers.services.matching.consensus import Voters
from amers.services.matching.predict import in_image
from amers.services.matching.reference_image import (
    Places,
    Reference,
    locate_on_terrain,
    match_places,
    visible_places,
)
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.quality.stability import image_places
from amers.services.registration.broken import naming_breaks
from amers.services.registration.coarse import refuse_rescaled
from amers.services.registration.context import (
    PointContext,
    Prediction,
    RegistrationContext,
    SearchStage,
)
from amers.services.registration.elsewhere import adjust_with_places
from amers.services.registration.far import search_far
from amers.services.registration.on_points import Registration, build_registration
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.point_selection import initial_prediction
from amers.services.registration.reference_points import ReferenceChips, reference_points
from amers.services.registration.rescaled import how_it_is_rescaled
from amers.services.registration.scene_marks import SceneMarks
from amers.services.registration.search import (
    Search,
    adjust_search,
    check_consensus,
    check_inliers,
    first_consensus,
    largest_error_m,
    predict,
    search_radius_px,
    select_inliers,
    summarise,
)
from amers.services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from amers.services.types import Array, ControlPoints, Progress, no_progress

_FAR = 0.25
"""Largest error, over the smaller side of a scene, at which places within the scene are enough."""
_CHIPS_ACROSS = 6
"""Chips side by side in a scene that is far off."""


@dataclass(frozen=True)
class _ReferenceContext(RegistrationContext):
    """What a registration on a reference image works on.

    Attributes:
        reference: ortho-image and terrain.
        finest_factor: pixels of the scene to one of the finest level.
    """

    reference: Reference
    finest_factor: int


@dataclass(frozen=True)
class _Level:
    """The level of the next search, and the model it starts from.

    Attributes:
        model: of the scene, as corrected so far.
        factor: pixels of the scene to one of the level.
        error_m: largest error of the model that is expected.
        is_first: whether nothing was searched before: the model may be far off.
    """

    model: CorrectedModel
    factor: int
    error_m: float
    is_first: bool


def register_on_reference(
    scene: Scene,
    reference: Reference,
    options: RegistrationOptions = RegistrationOptions(),
    *,
    marks: SceneMarks | None = None,
    progress: Progress = no_progress,
    earlier_places: Array | None = None,
    stages: list[SearchStage] | None = None,
) -> Registration:
    """Refine the model of a scene on a reference ortho-image and the terrain under it.

    The search goes from a level coarse enough for the error of the model down to the finest level that
    both images have. At every level, places evenly over the scene are searched; those that agree refine
    the model, which predicts the next level. Few places lead to the finest level, where all are
    searched. Source: the method of ANDORRE (CNES, Spot Image).

    Args:
        scene: its model may be wrong by three times `scene.sigma_m`.
        reference: ortho-image and terrain.
        options: of all stages.
        marks: of a person in the scene: observations of the same adjustment.
        progress: receives the fraction done and the work under way.
        earlier_places: (k, 3) ground positions that earlier scenes of the same ground were found by: at
            the finest level they are searched before any other place of their neighbourhood.
        stages: receives the summaries of the searches, also of one that is refused.

    Returns:
        As `register_scene`; its points are the places of the last search, numbered from 0.

    Raises:
        CoverageError: the reference or its terrain does not show what the scene shows.
        NotEnoughPoints: too few places were found.
        NoConsensus: the places found do not agree on one correction.
        RescaledImage: they agree on an image with finer or coarser pixels than its model says.
        BrokenImage: too few places were found, or agree, and lines of the image were lost or repeated.
        InputError: heights move what the scene shows, and there is no terrain.
    """
    scene = with_pixel_findings(scene)
    context = _ReferenceContext(
        scene=scene,
        options=options,
        progress=progress,
        stages=[] if stages is None else stages,
        breaks=scene_breaks(scene),
        reference=reference,
        finest_factor=_finest_factor(scene, reference),
    )
    try:
        with naming_breaks(scene):
            search, adjustment = _search_levels(context, earlier_places)
    except (NoConsensus, NotEnoughPoints) as error:
        refuse_rescaled(partial(_how_it_is_rescaled, context), error)
        raise
    of_places = _with_chips(context, search)
    search, adjustment, elsewhere = adjust_with_places(of_places, search, adjustment)
    return build_registration(context, search.points, search, adjustment, elsewhere, marks=marks)


def _search_levels(
    context: _ReferenceContext, earlier_places: Array | None
) -> tuple[Search, SceneAdjustment]:
    """The last search, after those of coarser levels from the one that the error of the model needs."""
    options = context.options
    level = _first_level(context)
    while level.is_first or level.factor > context.finest_factor:
        part = context.part(min(0.1 * len(context.stages), 0.4), 0.1)
        level, search, adjustment = _search_at_level(part, level)
        level = _next_level(context, level, search, adjustment)
    for part in context.parts(0.5, 0.45, options.reference.fine_stages):
        before = level.model.correction
        search, adjustment = _search(part, level, options.reference.places, earlier_places)
        level = _next_level(context, level, search, adjustment)
        shape = context.scene.image.shape
        displacement_px = _largest_displacement_px(before, level.model.correction, shape)
        if displacement_px <= options.reference.settled_px * context.finest_factor:
            break
    if options.adjustment.bends:
        adjustment = adjust_search(context.scene, search, options.adjustment)
    return search, adjustment


def _with_chips(context: _ReferenceContext, search: Search) -> PointContext:
    """The places of a search as points with chips of the finest level, to be searched farther out."""
    ground, reference = search.points.lon_lat_h, context.reference
    gsd_m = context.gsd_m * context.finest_factor
    return PointContext(
        scene=context.scene,
        options=context.options,
        progress=context.progress,
        stages=context.stages,
        breaks=context.breaks,
        points=reference_points(ground, reference, gsd_m),
        chips=ReferenceChips(reference, ground, gsd_m),
        image=CachedImage(context.scene.image),
        fine_gsd_m=gsd_m,
    )


def _first_level(context: _ReferenceContext) -> _Level:
    """The level at which the error of the delivered model is searched."""
    scene, error_m = context.scene, MAX_ERROR_SIGMAS * context.scene.sigma_m
    model = CorrectedModel(scene.model, no_correction(scene.image.shape))
    if error_m > _FAR * min(scene.image.shape) * context.gsd_m:
        prediction = _search_around(context.part(0.0, 0.1))
        model, error_m = prediction.model, largest_error_m(prediction.uncertainty_m)
    return _Level(model, _factor(context, error_m), error_m, is_first=True)


def _search_around(context: _ReferenceContext) -> Prediction:
    """A prediction by a shift, from chips of the reference all around a scene that may be far off.

    The places of a level lie in the scene as its model predicts it. Those that a scene really shows,
    when it is off by much of its size, lie beside it.
    """
    scene = context.scene
    gsd_m = max(
        context.gsd_m * context.finest_factor,
        float(min(scene.image.shape)) * context.gsd_m / (_CHIPS_ACROSS * CHIP_SIZE),
    )
    points, chips = _points_around(context, gsd_m)
    return search_far(context, points, chips, initial_prediction(scene, points), gsd_m)


def _how_it_is_rescaled(context: _ReferenceContext) -> str:
    """How the pixels of a scene that was not found differ from those of its model; "" if unseen."""
    (reference_gsd_m,) = image_gsds_m(context.reference.model, scene_centre(context.scene)[None, :])
    try:
        points, chips = _points_around(context, float(reference_gsd_m))
    except CoverageError:
        return ""
    return how_it_is_rescaled(context.scene, points, chips, context.options)


def _points_around(context: _ReferenceContext, gsd_m: float) -> tuple[ControlPoints, ReferenceChips]:
    """Points with chips of the reference in a scene and around it, as far as its model may be off."""
    scene, reference = context.scene, context.reference
    size = np.array(scene.image.shape, dtype=np.float64)
    reach_px = MAX_ERROR_SIGMAS * scene.sigma_m / context.gsd_m
    step = np.sqrt(size.prod() / context.options.coarse.points)
    axes = [np.arange(-reach_px, length + reach_px, step) for length in size]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    ground = locate_on_terrain(scene.model, grid, reference.terrain)
    seen = reference.model.project(ground)
    known = np.isfinite(ground).all(axis=1) & np.isfinite(seen).all(axis=1)
    ground, seen = ground[known], seen[known]
    margin_px = CHIP_SIZE / 2.0 * gsd_m / image_gsds_m(reference.model, ground)
    ground = ground[in_image(seen, reference.image.shape, -margin_px)]
    if len(ground) < context.options.adjustment.min_points:
        raise CoverageError(
            f"the reference shows {len(ground)} of {len(grid)} places within "
            f"{MAX_ERROR_SIGMAS * scene.sigma_m:.0f} m of the scene, "
            f"{context.options.adjustment.min_points} needed: it lies elsewhere, or its terrain is void"
        )
    points = reference_points(ground, reference, gsd_m)
    return points, ReferenceChips(reference, ground, gsd_m)


def _next_level(
    context: _ReferenceContext, level: _Level, search: Search, adjustment: SceneAdjustment
) -> _Level:
    """The level and the radius at which the remaining error of the refined model is searched."""
    prediction = predict(context.scene, search.points, adjustment)
    error_m = largest_error_m(prediction.uncertainty_m)
    factor = max(context.finest_factor, min(-(-level.factor // 2), _factor(context, error_m)))
    return _Level(prediction.model, factor, error_m, is_first=False)


def _search_at_level(
    context: _ReferenceContext, level: _Level
) -> tuple[_Level, Search, SceneAdjustment]:
    """A search on the way to the finest level; a first one that is not significant is made finer.

    Smaller windows are more of them side by side, so that fewer have to be shown. The first level is
    halved as long as its radius is at most four times the usual one.
    """
    options = context.options.reference
    while True:
        try:
            return level, *_search_few_places(context, level)
        except NoConsensus:
            finer = level.factor // 2
            radius_px = level.error_m / (max(finer, 1) * context.gsd_m)
            farthest_px = 4 * options.first_radius_px
            if not level.is_first or finer < context.finest_factor or radius_px > farthest_px:
                raise
            level = replace(level, factor=finer)


def _search_few_places(context: _ReferenceContext, level: _Level) -> tuple[Search, SceneAdjustment]:
    """A search on the way to the finest level: of few places as long as these agree, else of all."""
    options, before = context.options.reference, len(context.stages)
    if options.leading_places < options.places:
        try:
            search, adjustment = _search(context, level, options.leading_places)
        except (CoverageError, ComputationError):
            pass
        else:
            if context.stages[-1].inliers >= options.leading_places / 4.0:
                return search, adjustment
        del context.stages[before:]
    return _search(context, level, options.places)


def _search(
    context: _ReferenceContext, level: _Level, count: int, earlier_places: Array | None = None
) -> tuple[Search, SceneAdjustment]:
    """A search of places of a level, and the adjustment on the places that agree."""
    scene, options = context.scene, context.options
    matching = options.reference.matching
    places = _places(context, level, count, earlier_places)
    level_m = level.factor * context.gsd_m
    radius_px = search_radius_px(level.error_m, level_m)
    image = _image_at(scene, level.factor, len(places.cell), matching.window_px + 2 * radius_px)
    matches = match_places(image, places, radius_px, matching, context.progress)
    points = reference_points(places.lon_lat_h, context.reference)
    if level.is_first:
        consensus = first_consensus(
            scene,
            places.line_sample,
            matches.line_sample,
            level_m=level_m,
            radius_m=radius_px * level_m,
            side_m=matching.window_px * level_m,
        )
        inliers = consensus.inliers
    else:
        inliers, tolerance_px = select_inliers(level.model, points, matches)
    stage = summarise(
        "reference",
        matches,
        inliers,
        level_m=level_m,
        radius_m=radius_px * level_m,
        needed_m=level.error_m,
        voters=Voters(matches.line_sample, matching.window_px * level.factor),
        lon_lat_h=places.lon_lat_h,
    )
    context.stages.append(stage)
    if level.is_first:
        check_consensus(stage, consensus, matches.reason, scene, options.reference.max_false_alarms)
    else:
        check_inliers(stage, tolerance_px, matches.reason, scene, options.adjustment.min_points)
    side_m, breaks = matching.window_px * level_m, None if level.is_first else context.breaks
    search = Search(points, np.arange(len(points)), matches, inliers, side_m, breaks=breaks)
    # Bends that the places of a level leave open would only lead the next one astray.
    return search, adjust_search(scene, search, replace(options.adjustment, bends=False))


def _largest_displacement_px(
    before: ImageCorrection, after: ImageCorrection, shape: tuple[int, int]
) -> float:
    """Largest distance between two corrections at the corners and the centre of an image."""
    places = image_places(shape)
    return float(np.linalg.norm(after.apply(places) - before.apply(places), axis=1).max())


def _finest_factor(scene: Scene, reference: Reference) -> int:
    """Pixels of the scene to one of the level at which both images have their full common detail."""
    ground = scene_centre(scene)[None, :]
    derivative = reference.model.project_derivative(ground)[0, :, :2]
    if not np.isfinite(derivative).all():
        raise CoverageError(
            "the map of the reference does not reach the scene: choose a reference of the same ground"
        )
    reference_gsd_m = float(abs(np.linalg.det(derivative)) ** -0.5)
    return max(1, int(reference_gsd_m / scene_gsd_m(scene)))


def _factor(context: _ReferenceContext, error_m: float) -> int:
    """The level at which an error is searched within the first radius.

    The scene must still hold enough whole windows of the level; a scene too small for that is searched
    further out at a finer level.
    """
    options = context.options.reference
    wanted = int(np.ceil(error_m / context.gsd_m / options.first_radius_px))
    per_side = np.sqrt(options.enough) * options.matching.window_px
    largest = int(min(context.scene.image.shape) / per_side)
    return max(context.finest_factor, min(wanted, largest))


def _places(
    context: _ReferenceContext, level: _Level, count: int, earlier_places: Array | None
) -> Places:
    """Places evenly over the part of a scene that holds whole windows, earlier places first."""
    window_px = context.options.reference.matching.window_px
    margin = window_px // 2 * level.factor
    size = np.array(context.scene.image.shape, dtype=np.float64)
    room = np.maximum(size - 2.0 * margin, 1.0)
    side = max(np.sqrt(room[0] * room[1] / count), 2.0 * level.factor)
    counts = np.maximum(np.round(room / side), 1.0).astype(int)
    axes = [margin + (np.arange(c) + 0.5) * r / c - 0.5 for c, r in zip(counts, room, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    if earlier_places is not None and len(earlier_places):
        grid = _with_earlier(grid, level.model.project(earlier_places), room / counts, size, margin)
    places = visible_places(level.model, context.reference, grid, level.factor, window_px)
    min_points = context.options.adjustment.min_points
    if len(places.cell) < min_points:
        raise CoverageError(
            f"the reference shows {len(places.cell)} of {len(grid)} places of the scene, "
            f"{min_points} needed: it lies elsewhere, or its terrain is void there"
        )
    return places


def _with_earlier(grid: Array, earlier: Array, side: Array, size: Array, margin: float) -> Array:
    """The places of a grid (n, 2), replaced by an earlier place of their cell where there is one."""
    earlier = earlier[in_image(earlier, (int(size[0]), int(size[1])), -float(margin))]
    if not len(earlier):
        return grid
    cell = np.floor((grid - margin) / side).astype(np.int64)
    cell_of_earlier = np.floor((earlier - margin) / side).astype(np.int64)
    occupied, first = np.unique(cell_of_earlier, axis=0, return_index=True)
    free = ~(cell[:, None, :] == occupied[None, :, :]).all(axis=2).any(axis=1)
    return np.concatenate([earlier[first], grid[free]])


def _image_at(scene: Scene, factor: int, n_places: int, patch_px: int) -> ImageSource | ReducedImage:
    """The scene, or a reduction of it when the patches of the places hold more pixels than the scene."""
    lines, samples = scene.image.shape
    if factor > 1 and n_places * (patch_px * factor) ** 2 > lines * samples:
        return reduce_image(scene.image, factor)
    return scene.image
