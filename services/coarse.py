"""The first search of a scene whose model may be far off: few points, far out, and a consensus."""

from dataclasses import dataclass, replace

import numpy as np

from services.adjustment.scene import AdjustmentOptions
from services.conventions import CHIP_CENTRE
from services.errors import NoConsensus
from services.imagery import ImageSource, ReducedImage, reduce_image
from services.matching.consensus import vote
from services.matching.points import MatchingOptions, match_points
from services.matching.predict import inside, spread_over_image
from services.passes import (
    Pass,
    adjust_on,
    model_uncertainty_m,
    reasons_in_words,
    search_radius_px,
    summarised,
)
from services.scene import Scene, scene_gsd_m
from services.sensors.correction import CorrectedModel
from services.types import Array, BoolArray, ChipSource, ControlPoints, IntArray, Progress


@dataclass(frozen=True)
class CoarseOptions:
    """How a scene is searched first.

    Attributes:
        max_fine_radius_px: up to this many pixels of the finest chips no coarse stage is needed.
        points: how many are tried.
        enough: chips of a ground sampling are used when the scene shows so many of them whole.
        min_score: normalised correlation below which a chip is not found here, where the consensus of
            many decides.
        max_search_px: how far a chip is searched at most, chip pixels.
        max_false_alarms: a consensus that chance would give more often than this is refused.
    """

    max_fine_radius_px: int = 24
    points: int = 60
    enough: int = 12
    min_score: float = 0.5
    max_search_px: int = 400
    max_false_alarms: float = 1e-4


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
) -> tuple[CorrectedModel, Array, Pass]:
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
    gsd_m, rows = _usable_chips(scene, points, float(uncertainty_m.max()), options.enough)
    line_sample = model.project(points.lon_lat_h[rows])
    best = spread_over_image(
        line_sample,
        points.lon_lat_h[rows, 2],
        points.saliency[rows] * points.health[rows],
        scene.image.shape,
        options.points,
    )
    few = points.take(np.sort(rows[best]))
    radius_px = search_radius_px(uncertainty_m, gsd_m, options.max_search_px)
    correlation = replace(matching.correlation, min_score=options.min_score, max_second=1.0)
    matching = replace(matching, correlation=correlation)
    progress(0.0, "coarse search")
    image = _image_for(scene, gsd_m, len(few), radius_px)
    matches = match_points(
        image, model, few, chips, gsd_m, radius_px, scene.acquisition, matching, progress
    )

    consensus = vote(matches.displacement_m, 3.0 * gsd_m, radius_px * gsd_m)
    if consensus.false_alarms > options.max_false_alarms:
        found = int((matches.reason == "").sum())
        raise NoConsensus(
            f"the coarse search does not agree on one correction: {len(few)} points tried within "
            f"{radius_px * gsd_m:.0f} m, {found} found, {int(consensus.agreeing.sum())} of them within "
            f"{3.0 * gsd_m:g} m of each other (chance alone: {consensus.false_alarms:.2g} times); "
            + reasons_in_words(matches.reason)
        )
    enough = replace(adjustment, min_points=min(3, int(consensus.agreeing.sum())))
    adjusted = adjust_on(scene, few, matches, consensus.agreeing, enough)
    corrected = CorrectedModel(scene.model, adjusted.correction)
    after_m = np.hypot(model_uncertainty_m(corrected, points, adjusted), gsd_m / 2.0)
    return corrected, after_m, summarised("coarse", gsd_m, radius_px, matches, consensus.agreeing)


def _usable_chips(
    scene: Scene, points: ControlPoints, uncertainty_m: float, enough: int
) -> tuple[float, IntArray]:
    """The coarsest chips that the scene shows whole wherever it may lie, and the points that have them.

    Large chips near the border, or in a small scene, are not shown whole: where fewer than `enough` are,
    finer ones have to be searched further.
    """
    line_sample = scene.model.project(points.lon_lat_h)
    for gsd_m in np.unique(points.views.gsd_m)[::-1]:
        reach_m = np.sqrt(2.0) * CHIP_CENTRE * gsd_m + 3.0 * uncertainty_m
        whole = inside(line_sample, scene.image.shape, -reach_m / scene_gsd_m(scene))
        rows = np.flatnonzero(_has_chip(points, gsd_m) & whole)
        if len(rows) >= enough:
            return float(gsd_m), rows
    finest_m = float(points.views.gsd_m.min())
    return finest_m, np.flatnonzero(_has_chip(points, finest_m))


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
