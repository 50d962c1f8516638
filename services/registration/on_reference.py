"""SCENE AND REFERENCE IMAGE IN -> REGISTERED MODEL OUT, without control points."""

from dataclasses import dataclass, field

import numpy as np

from services.adjustment.image_correction import AdjustmentOptions, SceneAdjustment
from services.errors import ComputationError, CoverageError, InputError, NoConsensus
from services.imagery.scene import Scene, scene_gsd_m
from services.imagery.source import ImageSource, ReducedImage, reduce_image
from services.matching.consensus import a_contrario_consensus
from services.matching.control_points import PointMatches
from services.matching.predict import in_image
from services.matching.reference_image import (
    Places,
    Reference,
    ReferenceMatchingOptions,
    match_places,
    visible_places,
)
from services.quality.qualification import QualificationOptions
from services.quality.stability import image_places
from services.registration.on_points import Registration, RegistrationOptions, build_registration
from services.registration.reference_points import homologous_points
from services.registration.search import (
    SearchStage,
    adjust_matches,
    model_uncertainty_m,
    reasons_in_words,
    select_inliers,
    summarised,
)
from services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from services.types import Array, BoolArray, ControlPoints, Progress, no_progress, part_of


@dataclass(frozen=True)
class ReferenceOptions:
    """How a scene is registered on a reference ortho-image.

    Attributes:
        places: how many are searched at the finest level, evenly over the scene.
        leading_places: how many are searched before that, to lead there; where less than a quarter
            of them agree, `places` are.
        first_radius_px: the first level is so coarse that three standard deviations of the model are
            searched within so many of its pixels.
        fine_passes: how many times the finest level is searched at most, each time through the last
            model.
        settled_px: a search of the finest level that moves no corner of the image by more is the last,
            pixels of the level.
        enough: a level on which the scene has fewer whole windows than this is left out.
        max_false_alarms: a first consensus that chance would give more often than this is refused.
        seed: of the random draws of the stability test.
        matching, adjustment, qualification: of the stages.
    """

    places: int = 900
    leading_places: int = 100
    first_radius_px: int = 16
    fine_passes: int = 2
    settled_px: float = 0.25
    enough: int = 12
    max_false_alarms: float = 1e-4
    seed: int = 0
    matching: ReferenceMatchingOptions = field(default_factory=ReferenceMatchingOptions)
    adjustment: AdjustmentOptions = field(default_factory=lambda: AdjustmentOptions(min_points=6))
    qualification: QualificationOptions = field(default_factory=QualificationOptions)

    def __post_init__(self) -> None:
        """Refuse what no registration can be made with."""
        for name in ("places", "leading_places", "first_radius_px", "fine_passes", "enough"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: {getattr(self, name)} given, 1 or more expected")


def register_on_reference(
    scene: Scene,
    reference: Reference,
    options: ReferenceOptions = ReferenceOptions(),
    progress: Progress = no_progress,
    known: Array | None = None,
) -> Registration:
    """Refine the model of a scene on a reference ortho-image and the terrain under it.

    From a level coarse enough for the error of the model down to the finest that both images have:
    places evenly over the scene are searched, those that agree refine the model, which predicts the
    next level. A few places lead to the finest level, where all are searched. Source: the method of
    ANDORRE (CNES, Spot Image).

    Args:
        scene: its model may be wrong by three times `scene.sigma_m`.
        reference: ortho-image and terrain.
        options: thresholds.
        progress: told where the work stands.
        known: (k, 3) ground positions that earlier scenes of the same ground were found by: at the
            finest level they are searched before any other place of their neighbourhood.

    Returns:
        As `register_scene`; its points are the homologous places of the last search, numbered from 0.

    Raises:
        CoverageError: the reference or its terrain does not show what the scene shows.
        NotEnoughPoints: too few places were found.
        NoConsensus: the places found do not agree on one correction.
        InputError: heights move what the scene shows, and there is no terrain.
    """
    finest = _finest_factor(scene, reference)
    state = _start(scene, finest, options)
    passes: list[SearchStage] = []
    while not passes or state.factor > finest:
        part = part_of(progress, min(0.1 * len(passes), 0.4), 0.1)
        search = _lead(scene, reference, state, not passes, options, part)
        state = _after(scene, state, search, finest, options)
        passes.append(search.summary)
    for number in range(options.fine_passes):
        part = part_of(progress, 0.5 + 0.45 * number / options.fine_passes, 0.45 / options.fine_passes)
        before = state.model.correction
        search = _search(scene, reference, state, options.places, False, options, part, known)
        state = _after(scene, state, search, finest, options)
        passes.append(search.summary)
        if _largest_move_px(before, state.model.correction, scene.image.shape) <= (
            options.settled_px * finest
        ):
            break
    ground, matches, adjustment = search.ground, search.matches, search.adjustment
    progress(0.95, "qualifying the result")
    everything = np.arange(len(ground))
    registration = build_registration(
        scene,
        ground,
        (everything, everything),
        matches,
        adjustment,
        tuple(passes),
        RegistrationOptions(
            seed=options.seed, adjustment=options.adjustment, qualification=options.qualification
        ),
        reference.frame_sigma_m,
    )
    progress(1.0, "registered")
    return registration


@dataclass(frozen=True)
class _State:
    """What the next search starts from.

    Attributes:
        model: of the scene, as far as it is known.
        factor: pixels of the scene to one of the level that is searched.
        radius_px: how far, pixels of the level.
    """

    model: CorrectedModel
    factor: int
    radius_px: int


@dataclass(frozen=True)
class _Search:
    """What one search found, and the adjustment on it."""

    ground: ControlPoints
    matches: PointMatches
    adjustment: SceneAdjustment
    agreeing: int
    summary: SearchStage


def _start(scene: Scene, finest: int, options: ReferenceOptions) -> _State:
    """The delivered model, and the level at which its error is searched."""
    sigma_px = scene.sigma_m / scene_gsd_m(scene)
    factor = _factor(3.0 * sigma_px, scene, finest, options)
    model = CorrectedModel(scene.model, no_correction(scene.image.shape))
    return _State(model, factor, _radius_px(sigma_px, factor))


def _after(
    scene: Scene, state: _State, search: _Search, finest: int, options: ReferenceOptions
) -> _State:
    """The refined model, and the level and the radius that what is left of its error asks for."""
    model = CorrectedModel(scene.model, search.adjustment.correction)
    uncertainty_m = model_uncertainty_m(model, search.ground, search.adjustment)
    reach_px = 3.0 * float(np.percentile(uncertainty_m, 95)) / scene_gsd_m(scene)
    factor = max(finest, min(-(-state.factor // 2), _factor(reach_px, scene, finest, options)))
    return _State(model, factor, _radius_px(reach_px / 3.0, factor))


def _lead(
    scene: Scene,
    reference: Reference,
    state: _State,
    first: bool,
    options: ReferenceOptions,
    progress: Progress,
) -> _Search:
    """A search that only leads to the finest level: few places, as long as these agree."""
    if options.leading_places < options.places:
        try:
            search = _search(scene, reference, state, options.leading_places, first, options, progress)
        except (CoverageError, ComputationError):
            pass
        else:
            if search.agreeing >= options.leading_places / 4.0:
                return search
    return _search(scene, reference, state, options.places, first, options, progress)


def _search(
    scene: Scene,
    reference: Reference,
    state: _State,
    count: int,
    first: bool,
    options: ReferenceOptions,
    progress: Progress,
    known: Array | None = None,
) -> _Search:
    """Search places of a level, and adjust on those that agree."""
    model, factor, radius_px = state.model, state.factor, state.radius_px
    places = _places(scene, model, reference, factor, count, options, known)
    image = _image_at(scene, factor, len(places.cell), radius_px, options.matching.window_px)
    matches = match_places(image, places, radius_px, options.matching, progress)
    ground = homologous_points(places.lon_lat_h, reference)
    level_m = factor * scene_gsd_m(scene)
    if first:
        agreeing = _first_consensus(matches, level_m, radius_px, options)
    else:
        least = options.adjustment.min_points
        agreeing = select_inliers(model, ground, matches, radius_px * level_m, least)
    adjustment = adjust_matches(scene, ground, matches, agreeing, options.adjustment)
    summary = summarised("reference", level_m, radius_px, matches, agreeing)
    return _Search(ground, matches, adjustment, int(agreeing.sum()), summary)


def _largest_move_px(before: ImageCorrection, after: ImageCorrection, shape: tuple[int, int]) -> float:
    """How far two corrections of an image are apart at the worse of its corners."""
    places = image_places(shape)
    return float(np.linalg.norm(after.apply(places) - before.apply(places), axis=1).max())


def _finest_factor(scene: Scene, reference: Reference) -> int:
    """Pixels of the scene to one of the level at which both images have their full detail in common."""
    centre = (np.array(scene.image.shape, dtype=np.float64) - 1.0) / 2.0
    height_m = np.array([sum(scene.model.height_range_m) / 2.0])
    ground = scene.model.locate(centre[None, :], height_m)
    derivative = reference.model.project_derivative(ground)[0, :, :2]
    if not np.isfinite(derivative).all():
        raise CoverageError("the reference has no place for the scene: it lies on another map")
    reference_gsd_m = float(abs(np.linalg.det(derivative)) ** -0.5)
    return max(1, int(reference_gsd_m / scene_gsd_m(scene)))


def _factor(reach_px: float, scene: Scene, finest: int, options: ReferenceOptions) -> int:
    """The level at which a reach in pixels of the scene is searched within the first radius.

    The scene must still show enough whole windows of it; where it is too small, a finer level is
    searched further.
    """
    wanted = int(np.ceil(reach_px / options.first_radius_px))
    per_side = np.sqrt(options.enough) * options.matching.window_px / 2.0
    largest = int(min(scene.image.shape) / per_side)
    return max(finest, min(wanted, largest))


def _radius_px(sigma_px: float, factor: int) -> int:
    """Search radius that holds three standard deviations, pixels of the level."""
    return max(4, int(np.ceil(3.0 * sigma_px / factor)) + 2)


def _places(
    scene: Scene,
    model: CorrectedModel,
    reference: Reference,
    factor: int,
    count: int,
    options: ReferenceOptions,
    known: Array | None,
) -> Places:
    """Places evenly over the part of a scene where whole windows lie, the known ones first."""
    margin = options.matching.window_px // 2 * factor
    size = np.array(scene.image.shape, dtype=np.float64)
    room = np.maximum(size - 2.0 * margin, 1.0)
    side = max(np.sqrt(room[0] * room[1] / count), 2.0 * factor)
    counts = np.maximum(np.round(room / side), 1.0).astype(int)
    axes = [margin + (np.arange(c) + 0.5) * r / c - 0.5 for c, r in zip(counts, room, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    if known is not None and len(known):
        grid = _with_known(grid, model.project(known), room / counts, size, margin)
    places = visible_places(model, reference, grid, factor, options.matching.window_px)
    if len(places.cell) < options.adjustment.min_points:
        raise CoverageError(
            f"the reference shows {len(places.cell)} of {len(grid)} places of the scene, "
            f"{options.adjustment.min_points} needed: it lies elsewhere, or its terrain is void there"
        )
    return places


def _with_known(grid: Array, known: Array, side: Array, size: Array, margin: float) -> Array:
    """The places of a grid, each replaced by a known one of its cell where there is one."""
    known = known[in_image(known, (int(size[0]), int(size[1])), -float(margin))]
    if not len(known):
        return grid
    cell = np.floor((grid - margin) / side).astype(np.int64)
    of_known = np.floor((known - margin) / side).astype(np.int64)
    taken, first = np.unique(of_known, axis=0, return_index=True)
    free = ~(cell[:, None, :] == taken[None, :, :]).all(axis=2).any(axis=1)
    return np.concatenate([known[first], grid[free]])


def _image_at(
    scene: Scene, factor: int, n_places: int, radius_px: int, window_px: int
) -> ImageSource | ReducedImage:
    """The scene, or a reduction of it when the windows of the places would read more than all of it."""
    window = ((window_px + 2 * radius_px) * factor) ** 2
    lines, samples = scene.image.shape
    if factor > 1 and n_places * window > lines * samples:
        return reduce_image(scene.image, factor)
    return scene.image


def _first_consensus(
    matches: PointMatches, level_m: float, radius_px: int, options: ReferenceOptions
) -> BoolArray:
    """Places whose displacements agree beyond chance, or an error that says how many there were."""
    consensus = a_contrario_consensus(matches.displacement_m, 3.0 * level_m, radius_px * level_m)
    if consensus.false_alarms > options.max_false_alarms:
        found = int((matches.reason == "").sum())
        raise NoConsensus(
            f"the reference does not agree with the scene on one correction: {len(matches.reason)} "
            f"places tried within {radius_px * level_m:.0f} m, {found} found, "
            f"{int(consensus.inliers.sum())} of them within {3.0 * level_m:g} m of each other (chance "
            f"alone: {consensus.false_alarms:.2g} times); {reasons_in_words(matches.reason)}"
        )
    return consensus.inliers
