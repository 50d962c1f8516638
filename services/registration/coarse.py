"""The first search of a scene whose model may be far off: few points, far out, and a consensus."""

from dataclasses import dataclass, replace

import numpy as np

from services.adjustment.image_correction import AdjustmentOptions
from services.conventions import CHIP_CENTRE
from services.errors import InputError, NoConsensus
from services.imagery.scene import Scene, scene_gsd_m
from services.imagery.source import ImageSource, ReducedImage, reduce_image
from services.matching.consensus import a_contrario_consensus
from services.matching.control_points import ChipSearch, MatchingOptions, match_points
from services.matching.correlate import PeakThresholds
from services.matching.predict import spread_over_image
from services.registration.chip_selection import chance_of_being_shown, has_chip
from services.registration.search import (
    SearchStage,
    adjust_matches,
    model_uncertainty_m,
    reasons_in_words,
    search_radius_px,
    summarised,
)
from services.sensors.correction import CorrectedModel
from services.types import Array, ChipSource, ControlPoints, IntArray, Progress


@dataclass(frozen=True)
class CoarseOptions:
    """How a scene is searched first.

    Attributes:
        max_fine_radius_px: up to this many pixels of the finest chips no coarse stage is needed.
        points: so many are tried that the scene should show as many whole, wherever it lies.
        enough: chips of a ground sampling are used when the scene should show so many of them whole.
        min_score: normalised correlation below which a chip is not found here, where the consensus of
            many decides.
        max_search_px: how far a chip is searched at most, pixels; farther, it is degraded.
        max_reduction: how many times a chip is degraded at most; less than 25 pixels of one tell little.
        max_false_alarms: a consensus that chance would give more often than this is refused.
    """

    max_fine_radius_px: int = 24
    points: int = 60
    enough: int = 12
    min_score: float = 0.5
    max_search_px: int = 400
    max_reduction: int = 4
    max_false_alarms: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse what no search can be made with."""
        for name in ("points", "max_search_px", "max_reduction"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: {getattr(self, name)} given, 1 or more expected")


@dataclass(frozen=True)
class _Search:
    """What is searched, and how.

    Attributes:
        gsd_m: ground sampling of the chips, as they are stored.
        reduction: how many times they are degraded.
        radius_px: how far they are searched, pixels of the degraded chips.
        rows: the points to try.
    """

    gsd_m: float
    reduction: int
    radius_px: int
    rows: IntArray

    @property
    def level_m(self) -> float:
        """Ground sampling of the degraded chips."""
        return self.gsd_m * self.reduction


def search_coarsely(
    scene: Scene,
    model: CorrectedModel,
    points: ControlPoints,
    chips: ChipSource,
    uncertainty_m: Array,
    options: CoarseOptions,
    matching: MatchingOptions,
    adjustment: AdjustmentOptions,
    progress: Progress,
) -> tuple[CorrectedModel, Array, SearchStage]:
    """A first correction from few points searched far, accepted only when they agree beyond chance.

    Args:
        scene: to be registered.
        model: of the scene, before.
        points: those that may be tried.
        chips: of the points.
        uncertainty_m: (n,) standard deviation of where the model expects the points.
        options: of this stage.
        matching, adjustment: of all stages.
        progress: told where the work stands.

    Returns:
        The corrected model, the standard deviation (n,) of where it expects the points in metres, and
        what was done.

    Raises:
        NoConsensus: when the points found do not agree beyond chance.
    """
    search = _planned(scene, model, points, uncertainty_m, options)
    few, level_m, radius_px = points.take(search.rows), search.level_m, search.radius_px
    progress(0.0, "coarse search")
    image = _image_for(scene, level_m, len(few), radius_px)
    chip_search = ChipSearch(
        image,
        model,
        scene.acquisition,
        search.gsd_m,
        radius_px,
        reduction=search.reduction,
        thresholds=PeakThresholds(options.min_score, max_second=1.0),
    )
    matches = match_points(chip_search, few, chips, matching, progress)

    reach_m = _reach_m(scene, search)
    consensus = a_contrario_consensus(matches.displacement_m, 3.0 * level_m, reach_m)
    if consensus.false_alarms > options.max_false_alarms:
        found = int((matches.reason == "").sum())
        raise NoConsensus(
            f"the coarse search does not agree on one correction: {len(few)} points tried within "
            f"{radius_px * level_m:.0f} m, {found} found, {int(consensus.inliers.sum())} of them "
            f"within {3.0 * level_m:g} m of each other (chance alone: {consensus.false_alarms:.2g} "
            "times); " + reasons_in_words(matches.reason)
        )
    enough = replace(adjustment, min_points=min(3, int(consensus.inliers.sum())))
    adjusted = adjust_matches(scene, few, matches, consensus.inliers, enough)
    corrected = CorrectedModel(scene.model, adjusted.correction)
    after_m = np.hypot(model_uncertainty_m(corrected, points, adjusted), level_m / 2.0)
    return corrected, after_m, summarised("coarse", level_m, radius_px, matches, consensus.inliers)


def _planned(
    scene: Scene,
    model: CorrectedModel,
    points: ControlPoints,
    uncertainty_m: Array,
    options: CoarseOptions,
) -> _Search:
    """The coarsest chips of which the scene should show enough, and the points to try with them.

    Large chips near the border, or in a small scene, are rarely shown whole: finer ones are searched
    farther then, degraded where that would be too far.
    """
    line_sample = model.project(points.lon_lat_h)
    best: tuple[float, float, Array] | None = None
    for gsd_m in np.unique(points.views.gsd_m)[::-1]:
        shown = chance_of_being_shown(scene, points, line_sample, float(gsd_m), uncertainty_m)
        shown[~has_chip(points, float(gsd_m))] = 0.0
        if best is None or shown.sum() > best[1]:
            best = float(gsd_m), float(shown.sum()), shown
        if best[1] >= options.enough:
            break
    assert best is not None
    gsd_m, _, shown = best
    reduction = 1
    while reduction < options.max_reduction and (
        search_radius_px(uncertainty_m, gsd_m * reduction, 10**9) > options.max_search_px
    ):
        reduction += 1
    radius_px = search_radius_px(uncertainty_m, gsd_m * reduction, options.max_search_px)
    rows = np.flatnonzero(shown > 0.0)
    preference = (points.saliency * points.health * shown)[rows]
    order = rows[
        spread_over_image(
            line_sample[rows], points.lon_lat_h[rows, 2], preference, scene.image.shape, len(rows)
        )
    ]
    count = int(np.searchsorted(np.cumsum(shown[order]), options.points)) + 1
    return _Search(gsd_m, reduction, radius_px, np.sort(order[:count]))


def _reach_m(scene: Scene, search: _Search) -> float:
    """Half side of the square where a chip may be found: where it is looked for and the scene is."""
    gsd_m = scene_gsd_m(scene)
    room_m = [
        min(
            2.0 * search.radius_px * search.level_m,
            max(size * gsd_m - CHIP_CENTRE * 2.0 * search.gsd_m, 0.0),
        )
        for size in scene.image.shape
    ]
    return max(float(np.sqrt(room_m[0] * room_m[1])) / 2.0, search.level_m)


def _image_for(scene: Scene, gsd_m: float, n_points: int, radius_px: int) -> ImageSource | ReducedImage:
    """The scene, or a reduction of it when the windows of the points would read more than all of it."""
    ratio = gsd_m / scene_gsd_m(scene)
    window = (2.0 * (CHIP_CENTRE + radius_px) * ratio) ** 2
    factor = int(ratio / 2.0)
    if factor > 1 and n_points * window > scene.image.shape[0] * scene.image.shape[1]:
        return reduce_image(scene.image, factor)
    return scene.image
