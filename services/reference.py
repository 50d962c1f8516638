"""SCENE AND REFERENCE IMAGE IN -> REGISTERED MODEL OUT: the dense method, which needs no points."""

from dataclasses import dataclass, field

import numpy as np

from services.adjustment.scene import AdjustmentOptions
from services.errors import CoverageError, InputError, NoConsensus
from services.imagery import (
    ImageSource,
    ReducedImage,
    image_gsd_m,
    image_gsds_m,
    reduce_image,
    render_chip,
)
from services.matching.consensus import vote
from services.matching.dense import DenseOptions, Places, Reference, match_places, places_seen
from services.matching.points import PointMatches
from services.matching.predict import inside
from services.passes import (
    Pass,
    adjust_on,
    agreement,
    model_uncertainty_m,
    reasons_in_words,
    summarised,
)
from services.quality.qualification import QualificationOptions
from services.registration import Registration, RegistrationOptions, qualified
from services.scene import Scene, scene_gsd_m
from services.sensors.correction import CorrectedModel, no_correction
from services.types import (
    Acquisition,
    Array,
    BoolArray,
    ChipArray,
    ControlPoints,
    Progress,
    Views,
    no_progress,
    part_of,
)


@dataclass(frozen=True)
class ReferenceOptions:
    """How a scene is registered on a reference ortho-image.

    Attributes:
        places: how many are searched at every level, evenly over the scene.
        first_radius_px: the first level is so coarse that three standard deviations of the model are
            searched within so many of its pixels.
        fine_passes: how many times the finest level is searched, each time through the last model.
        enough: a level on which the scene has fewer whole windows than this is left out.
        max_false_alarms: a first consensus that chance would give more often than this is refused.
        seed: of the random draws of the stability test.
        dense, adjustment, qualification: of the stages.
    """

    places: int = 900
    first_radius_px: int = 16
    fine_passes: int = 2
    enough: int = 12
    max_false_alarms: float = 1e-4
    seed: int = 0
    dense: DenseOptions = field(default_factory=DenseOptions)
    adjustment: AdjustmentOptions = field(default_factory=lambda: AdjustmentOptions(min_points=6))
    qualification: QualificationOptions = field(default_factory=QualificationOptions)

    def __post_init__(self) -> None:
        """Refuse what no registration can be made with."""
        for name in ("places", "first_radius_px", "fine_passes", "enough"):
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
    next level. Source: the method of ANDORRE (CNES, Spot Image).

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
    gsd_m = scene_gsd_m(scene)
    finest = _finest_factor(scene, reference)
    model = CorrectedModel(scene.model, no_correction(scene.image.shape))
    factor = _factor(3.0 * scene.sigma_m / gsd_m, scene, finest, options)
    radius_px = _radius_px(scene.sigma_m / gsd_m, factor)
    passes: list[Pass] = []
    fine = 0
    while fine < options.fine_passes:
        known_here = known if factor == finest else None
        places = _places(scene, model, reference, factor, radius_px, options, known_here)
        image = _image_at(scene, factor, len(places.cell), radius_px, options.dense.window_px)
        part = part_of(progress, min(0.25 * len(passes), 0.8), 0.15)
        matches = match_places(image, model, reference, places, radius_px, options.dense, part)
        ground = homologous_points(places.lon_lat_h, reference)
        level_m = factor * gsd_m
        if not passes:
            agreeing = _first_consensus(matches, level_m, radius_px, options)
        else:
            agreeing = agreement(
                model, ground, matches, radius_px * level_m, options.adjustment.min_points
            )
        adjustment = adjust_on(scene, ground, matches, agreeing, options.adjustment)
        passes.append(summarised("dense", level_m, radius_px, matches, agreeing))
        model = CorrectedModel(scene.model, adjustment.correction)
        uncertainty_m = model_uncertainty_m(model, ground, adjustment)
        fine += factor == finest
        reach_px = 3.0 * float(np.percentile(uncertainty_m, 95)) / gsd_m
        factor = max(finest, min(-(-factor // 2), _factor(reach_px, scene, finest, options)))
        radius_px = _radius_px(reach_px / 3.0, factor)
    progress(0.95, "qualifying the result")
    everything = np.arange(len(ground))
    registration = qualified(
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
    per_side = np.sqrt(options.enough) * options.dense.window_px / 2.0
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
    radius_px: int,
    options: ReferenceOptions,
    known: Array | None,
) -> Places:
    """Places evenly over the part of a scene where whole windows lie, the known ones first."""
    margin = options.dense.window_px // 2 * factor
    size = np.array(scene.image.shape, dtype=np.float64)
    room = np.maximum(size - 2.0 * margin, 1.0)
    side = max(np.sqrt(room[0] * room[1] / options.places), 2.0 * factor)
    count = np.maximum(np.round(room / side), 1.0).astype(int)
    axes = [margin + (np.arange(c) + 0.5) * r / c - 0.5 for c, r in zip(count, room, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    if known is not None and len(known):
        grid = _with_known(grid, model.project(known), room / count, size, margin)
    places = places_seen(model, reference, grid, factor, options.dense.window_px)
    if len(places.cell) < options.adjustment.min_points:
        raise CoverageError(
            f"the reference shows {len(places.cell)} of {len(grid)} places of the scene, "
            f"{options.adjustment.min_points} needed: it lies elsewhere, or its terrain is void there"
        )
    return places


def _with_known(grid: Array, known: Array, side: Array, size: Array, margin: float) -> Array:
    """The places of a grid, each replaced by a known one of its cell where there is one."""
    known = known[inside(known, (int(size[0]), int(size[1])), -float(margin))]
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
    consensus = vote(matches.displacement_m, 3.0 * level_m, radius_px * level_m)
    if consensus.false_alarms > options.max_false_alarms:
        found = int((matches.reason == "").sum())
        raise NoConsensus(
            f"the reference does not agree with the scene on one correction: {len(matches.reason)} "
            f"places tried within {radius_px * level_m:.0f} m, {found} found, "
            f"{int(consensus.agreeing.sum())} of them within {3.0 * level_m:g} m of each other (chance "
            f"alone: {consensus.false_alarms:.2g} times); {reasons_in_words(matches.reason)}"
        )
    return consensus.agreeing


def homologous_points(lon_lat_h: Array, reference: Reference) -> ControlPoints:
    """Places on the ground (n, 3) as control points, whose one chip is cut from the reference.

    `ReferenceChips` reads the chips.
    """
    n = len(lon_lat_h)
    unknown = np.full(n, np.nan)
    variance = np.array([reference.sigma_m, reference.sigma_m, reference.height_sigma_m]) ** 2
    rows = np.arange(n)
    return ControlPoints(
        id=rows,
        lon_lat_h=lon_lat_h,
        covariance_m2=np.tile(np.diag(variance), (n, 1, 1)),
        saliency=np.ones(n),
        health=np.ones(n),
        views=Views(
            start=np.arange(n + 1),
            gsd_m=image_gsds_m(reference.model, lon_lat_h),
            image=np.zeros(n, dtype=np.int64),
            incidence_deg=unknown,
            azimuth_deg=unknown,
            health=np.ones(n),
            images=(Acquisition("reference"),),
        ),
        chip_file=np.zeros(n, dtype=np.int64),
        chip_row=rows,
        chip_files=("reference",),
    )


@dataclass(frozen=True)
class ReferenceChips:
    """Chips of homologous points, cut from the reference when they are asked for.

    Attributes:
        reference: what they are cut from.
        lon_lat_h: (n, 3) the points, by their rows.
    """

    reference: Reference
    lon_lat_h: Array

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """Chips (count, 101, 101) uint16, each stretched over all values; 0 is nodata."""
        return np.stack([self._chip(ground) for ground in self.lon_lat_h[row : row + count]])

    def _chip(self, ground: Array) -> ChipArray:
        gsd_m = image_gsd_m(self.reference.model, ground)
        pixels = render_chip(self.reference.image, self.reference.model, ground, gsd_m)
        seen = np.isfinite(pixels)
        if not seen.any():
            return np.zeros(pixels.shape, dtype=np.uint16)
        low, high = float(pixels[seen].min()), float(pixels[seen].max())
        stretched = 1.0 + (pixels - low) * (65534.0 / max(high - low, 1e-12))
        return np.where(seen, stretched, 0.0).astype(np.uint16)
