"""The coarse search of a scene whose model may be far off: few points, far out, and a consensus."""

import math

import numpy as np

from services.conventions import CHIP_CENTRE, CHIP_SIZE, MAX_ERROR_SIGMAS
from services.imagery.scene import Scene, scene_gsd_m
from services.imagery.source import ImageSource, ReducedImage, reduce_image
from services.matching.consensus import Voters
from services.matching.control_points import ChipSearch, match_points
from services.matching.correlate import PeakThresholds
from services.registration.another_view import another_view
from services.registration.chip_selection import has_chip, visibility_probability
from services.registration.context import PointContext, Prediction
from services.registration.far import search_far
from services.registration.point_selection import points_expected
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
    gsd_m, error_m = _coarse_gsd_m(context, prediction), largest_error_m(prediction.uncertainty_m)
    if search_radius_px(error_m, gsd_m) > options.coarse.max_search_px:
        part = context.part(0.0, 0.7)
        prediction = search_far(part, context.points, context.chips, prediction, gsd_m)
        if not needs_coarse_search(context, prediction):
            return prediction
        gsd_m, error_m = _coarse_gsd_m(context, prediction), largest_error_m(prediction.uncertainty_m)
    radius_px = search_radius_px(error_m, gsd_m)
    rows = points_expected(scene, context.points, prediction, gsd_m, count=options.coarse.points)
    points = context.points.take(rows)
    context.progress(0.0, "coarse search")
    chip_search = ChipSearch(
        _image_for(scene, gsd_m, len(points), radius_px),
        prediction.model,
        scene.acquisition,
        gsd_m,
        radius_px,
        thresholds=PeakThresholds(options.coarse.min_score, max_second=1.0),
    )
    matches = match_points(chip_search, points, context.chips, options.matching, context.progress)
    predicted = prediction.model.project(points.lon_lat_h)
    consensus = first_consensus(
        scene,
        predicted,
        matches.line_sample,
        level_m=gsd_m,
        radius_m=radius_px * gsd_m,
        side_m=CHIP_SIZE * gsd_m,
    )
    stage = summarise(
        "coarse",
        matches,
        consensus.inliers,
        level_m=gsd_m,
        radius_m=radius_px * gsd_m,
        needed_m=error_m,
        voters=Voters(matches.line_sample, CHIP_SIZE * gsd_m / scene_gsd_m(scene)),
        lon_lat_h=points.lon_lat_h,
    )
    context.stages.append(stage)
    check_consensus(
        stage,
        consensus,
        matches.reason,
        scene,
        options.coarse.max_false_alarms,
        of_another=lambda: another_view(scene, stage, points.lon_lat_h, predicted, matches.line_sample),
    )
    search = Search(points, rows, matches, consensus.inliers, CHIP_SIZE * gsd_m)
    adjustment = adjust_search(scene, search, options.adjustment, min_points=min(3, stage.inliers))
    corrected = predict(scene, context.points, adjustment)
    uncertainty_m = np.hypot(corrected.uncertainty_m, gsd_m / 2.0)
    return Prediction(corrected.model, uncertainty_m)


def _coarse_gsd_m(context: PointContext, prediction: Prediction) -> float:
    """Ground sampling of the coarsest chips of which the scene should show enough.

    A small scene rarely shows large chips whole. Finer chips are then searched further out.
    """
    scene, points = context.scene, context.points
    size_m = np.array(scene.image.shape) * scene_gsd_m(scene)
    best_m, most = math.nan, -1.0
    for gsd_m in np.unique(points.views.gsd_m)[::-1].tolist():
        probability = visibility_probability(scene, points, prediction, gsd_m)
        # Chips that overlap count as one voter: the scene must be large enough for many side by side.
        side_by_side = float(np.prod(size_m / (CHIP_SIZE * gsd_m)))
        count = min(float(probability[has_chip(points, gsd_m)].sum()), side_by_side)
        if count > most:
            best_m, most = gsd_m, count
        if most >= context.options.coarse.enough:
            break
    return best_m


def _image_for(scene: Scene, gsd_m: float, n_points: int, radius_px: int) -> ImageSource | ReducedImage:
    """The scene, or a reduction of it when the windows of the points hold more pixels than the scene."""
    ratio = gsd_m / scene_gsd_m(scene)
    window = (2.0 * (CHIP_CENTRE + radius_px) * ratio) ** 2
    factor = int(ratio / 2.0)
    if factor > 1 and n_points * window > scene.image.shape[0] * scene.image.shape[1]:
        return reduce_image(scene.image, factor)
    return scene.image
