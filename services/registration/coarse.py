"""The coarse search of a scene whose model may be far off: few points, far out, and a consensus."""

from dataclasses import dataclass

import numpy as np

from services.conventions import CHIP_CENTRE, CHIP_SIZE, MAX_ERROR_SIGMAS
from services.imagery.scene import Scene, scene_gsd_m
from services.imagery.source import ImageSource, ReducedImage, reduce_image
from services.matching.consensus import Voters
from services.matching.control_points import ChipSearch, match_points
from services.matching.correlate import PeakThresholds
from services.matching.predict import spread_over_image
from services.registration.chip_selection import has_chip, visibility_probability
from services.registration.context import PointContext, Prediction
from services.registration.search import (
    Search,
    adjust_search,
    check_consensus,
    first_consensus,
    largest_error_m,
    predict,
    search_radius_px,
    summarise,
)
from services.types import Array, IntArray


@dataclass(frozen=True)
class _Plan:
    """Chips and points of the coarse search.

    Attributes:
        gsd_m: ground sampling of the chips, as they are stored.
        reduction: factor by which the chips are reduced.
        radius_px: search radius, pixels of the reduced chips.
        error_m: largest error that is expected.
        rows: the points to try.
    """

    gsd_m: float
    reduction: int
    radius_px: int
    error_m: float
    rows: IntArray

    @property
    def level_m(self) -> float:
        """Ground sampling of the reduced chips."""
        return self.gsd_m * self.reduction


def needs_coarse_search(context: PointContext, prediction: Prediction) -> bool:
    """Whether the points may lie further off than the fine chips are searched."""
    reach_px = MAX_ERROR_SIGMAS * prediction.uncertainty_m.max() / context.fine_gsd_m
    return bool(reach_px > context.options.coarse.max_fine_radius_px)


def search_coarsely(context: PointContext, prediction: Prediction) -> Prediction:
    """A better prediction of all points from few points searched far out, which must agree.

    Args:
        context: of the registration.
        prediction: of its points by the delivered model.

    Returns:
        The prediction by the corrected model.

    Raises:
        NoConsensus: the points found agree no better than by chance.
    """
    scene, options = context.scene, context.options
    plan = _plan(context, prediction)
    points, level_m, radius_px = context.points.take(plan.rows), plan.level_m, plan.radius_px
    context.progress(0.0, "coarse search")
    chip_search = ChipSearch(
        _image_for(scene, level_m, len(points), radius_px),
        prediction.model,
        scene.acquisition,
        plan.gsd_m,
        radius_px,
        reduction=plan.reduction,
        thresholds=PeakThresholds(options.coarse.min_score, max_second=1.0),
    )
    matches = match_points(chip_search, points, context.chips, options.matching, context.progress)
    consensus = first_consensus(
        scene,
        prediction.model.project(points.lon_lat_h),
        matches.line_sample,
        level_m=level_m,
        radius_m=radius_px * level_m,
        side_m=CHIP_SIZE * plan.gsd_m,
    )
    stage = summarise(
        "coarse",
        matches,
        consensus.inliers,
        level_m=level_m,
        radius_m=radius_px * level_m,
        needed_m=plan.error_m,
        voters=Voters(matches.line_sample, CHIP_SIZE * plan.gsd_m / scene_gsd_m(scene)),
    )
    context.stages.append(stage)
    check_consensus(stage, consensus, matches.reason, scene, options.coarse.max_false_alarms)
    search = Search(points, plan.rows, matches, consensus.inliers, CHIP_SIZE * plan.gsd_m)
    adjustment = adjust_search(scene, search, options.adjustment, min_points=min(3, stage.inliers))
    corrected = predict(scene, context.points, adjustment)
    uncertainty_m = np.hypot(corrected.uncertainty_m, level_m / 2.0)
    return Prediction(corrected.model, uncertainty_m)


def _plan(context: PointContext, prediction: Prediction) -> _Plan:
    """The coarsest chips of which the scene should show enough, and the points to try with them.

    A small scene rarely shows large chips whole. Finer chips are then searched further out, reduced
    where the radius would be too large.
    """
    scene, points, options = context.scene, context.points, context.options.coarse
    size_m = np.array(scene.image.shape) * scene_gsd_m(scene)
    best: tuple[float, float, Array] | None = None
    for gsd_m in np.unique(points.views.gsd_m)[::-1]:
        probability = visibility_probability(scene, points, prediction, float(gsd_m))
        probability[~has_chip(points, float(gsd_m))] = 0.0
        # Chips that overlap count as one voter: the scene must be large enough for many side by side.
        side_by_side = float(np.prod(size_m / (CHIP_SIZE * gsd_m)))
        count = min(float(probability.sum()), side_by_side)
        if best is None or count > best[1]:
            best = float(gsd_m), count, probability
        if best[1] >= options.enough:
            break
    assert best is not None
    gsd_m, _, probability = best
    error_m = largest_error_m(prediction.uncertainty_m)
    reduction = 1
    while reduction < options.max_reduction and (
        search_radius_px(error_m, gsd_m * reduction) > options.max_search_px
    ):
        reduction += 1
    radius_px = min(search_radius_px(error_m, gsd_m * reduction), options.max_search_px)
    line_sample = prediction.model.project(points.lon_lat_h)
    rows = np.flatnonzero(probability > 0.0)
    preference = (points.saliency * points.health * probability)[rows]
    order = rows[
        spread_over_image(
            line_sample[rows], points.lon_lat_h[rows, 2], preference, scene.image.shape, len(rows)
        )
    ]
    count = int(np.searchsorted(np.cumsum(probability[order]), options.points)) + 1
    return _Plan(gsd_m, reduction, radius_px, error_m, np.sort(order[:count]))


def _image_for(scene: Scene, gsd_m: float, n_points: int, radius_px: int) -> ImageSource | ReducedImage:
    """The scene, or a reduction of it when the windows of the points hold more pixels than the scene."""
    ratio = gsd_m / scene_gsd_m(scene)
    window = (2.0 * (CHIP_CENTRE + radius_px) * ratio) ** 2
    factor = int(ratio / 2.0)
    if factor > 1 and n_points * window > scene.image.shape[0] * scene.image.shape[1]:
        return reduce_image(scene.image, factor)
    return scene.image
