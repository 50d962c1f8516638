"""Coarse search of a scene with a large model error: few points, a wide search, a consensus.

Few large chips fit into a scene side by side, those that overlap say little more than one, and clouds
hide each with all its ground. Where they agree no better than by chance, more points are searched with
the middle of the finest chips.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from amers.services.conventions import CHIP_CENTRE, CHIP_SIZE, MAX_ERROR_SIGMAS
from amers.services.errors import RescaledImage
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.imagery.source import ImageSource, ReducedImage, reduce_image
from amers.services.matching.consensus import Consensus, Voters
from amers.services.matching.control_points import ChipSearch, match_points
from amers.services.matching.correlate import PeakThresholds
from amers.services.registration.another_view import another_view
from amers.services.registration.chip_selection import has_chip, visibility_probability
from amers.services.registration.context import PointContext, Prediction, SearchStage
from amers.services.registration.far import search_far
from amers.services.registration.point_selection import points_expected
from amers.services.registration.search import (
    Search,
    adjust_search,
    check_consensus,
    first_consensus,
    largest_error_m,
    predict,
    search_radius_px,
    summarise,
)
from amers.services.types import IntArray

_TRIES = 2
"""Searches of which one has to agree, and the better one is the last of the summaries: two tries are
two chances."""
_SMALL_HALF_SIDE = CHIP_CENTRE // 2
"""Of the middle of the chips, pixels: four times as many of them fit side by side."""


@dataclass(frozen=True)
class _Agreement:
    """A search of points far out, what it agrees on, and its summary."""

    search: Search
    consensus: Consensus
    stage: SearchStage


def needs_coarse_search(context: PointContext, prediction: Prediction) -> bool:
    """Whether the points may lie further off than the fine chips are searched."""
    reach_px = MAX_ERROR_SIGMAS * prediction.uncertainty_m.max() / context.fine_gsd_m
    return bool(reach_px > context.options.coarse.max_fine_radius_px)


def search_coarsely(
    context: PointContext, prediction: Prediction, rescaled: Callable[[], str] = lambda: ""
) -> Prediction:
    """A better prediction of all points from few points searched far out, which must agree.

    Args:
        context: of the registration.
        prediction: of its points by the delivered model.
        rescaled: how the pixels of the image differ from those of its model, asked before the search of
            more points, which takes long; "" where they do not.

    Returns:
        The prediction by the corrected model.

    Raises:
        RescaledImage: they agree on an image with other pixels.
        NoConsensus: the points found agree no better than by chance.
    """
    scene, options = context.scene, context.options
    gsd_m, error_m = _coarse_gsd_m(context, prediction), largest_error_m(prediction.uncertainty_m)
    if search_radius_px(error_m, gsd_m) > options.coarse.max_search_px:
        part = context.part(0.0, 0.7)
        prediction = search_far(part, context.points, context.chips, prediction, gsd_m)
        if not needs_coarse_search(context, prediction):
            return prediction
        gsd_m = _coarse_gsd_m(context, prediction)
    context.progress(0.0, "coarse search")
    rows = points_expected(scene, context.points, prediction, gsd_m, count=options.coarse.points)
    tries = [_search(context, prediction, gsd_m, rows)]
    max_false_alarms = options.coarse.max_false_alarms / _TRIES
    if tries[0].consensus.false_alarms > max_false_alarms:
        refuse_rescaled(rescaled)
        tries += _with_smaller_chips(context, prediction)
        tries.sort(key=lambda one: one.consensus.false_alarms, reverse=True)
    context.stages.extend(one.stage for one in tries)
    best = tries[-1]
    search, stage = best.search, best.stage
    measured, lon_lat_h = search.matches.line_sample, search.points.lon_lat_h
    predicted = prediction.model.project(lon_lat_h)
    check_consensus(
        stage,
        best.consensus,
        search.matches.reason,
        scene,
        max_false_alarms,
        of_another=lambda: another_view(scene, stage, lon_lat_h, predicted, measured),
    )
    adjustment = adjust_search(scene, search, options.adjustment, min_points=min(3, stage.inliers))
    corrected = predict(scene, context.points, adjustment)
    uncertainty_m = np.hypot(corrected.uncertainty_m, stage.chip_gsd_m / 2.0)
    return Prediction(corrected.model, uncertainty_m)


def refuse_rescaled(rescaled: Callable[[], str], error: Exception | None = None) -> None:
    """Refuse an image with other pixels than its model has.

    Raises:
        RescaledImage: states how its pixels differ.
    """
    words = rescaled()
    if words:
        raise RescaledImage(words if error is None else f"{words} ({error})") from error


def _with_smaller_chips(context: PointContext, prediction: Prediction) -> list[_Agreement]:
    """The search of more points with the middle of the finest chips, if these reach far enough."""
    options, points = context.options, context.points
    gsd_m = float(points.views.gsd_m.min())
    radius_px = search_radius_px(largest_error_m(prediction.uncertainty_m), gsd_m)
    if radius_px > options.coarse.max_search_px:
        return []
    count = options.max_points or len(points)
    rows = points_expected(context.scene, points, prediction, gsd_m, count=count)
    return [_search(context, prediction, gsd_m, rows, _SMALL_HALF_SIDE)]


def _search(
    context: PointContext,
    prediction: Prediction,
    gsd_m: float,
    rows: IntArray,
    half_side: int = CHIP_CENTRE,
) -> _Agreement:
    """What some of the points agree on, searched with a part of their chips."""
    scene, options = context.scene, context.options
    side_m = (2 * half_side + 1) * gsd_m
    error_m = largest_error_m(prediction.uncertainty_m)
    radius_px = search_radius_px(error_m, gsd_m)
    points = context.points.take(rows)
    chip_search = ChipSearch(
        _image_for(scene, gsd_m, len(points), radius_px),
        prediction.model,
        scene.acquisition,
        gsd_m,
        radius_px,
        thresholds=PeakThresholds(options.coarse.min_score, max_second=1.0),
        half_side=half_side,
        parts=False,
    )
    matches = match_points(chip_search, points, context.chips, options.matching, context.progress)
    consensus = first_consensus(
        scene,
        prediction.model.project(points.lon_lat_h),
        matches.line_sample,
        level_m=gsd_m,
        radius_m=radius_px * gsd_m,
        side_m=side_m,
    )
    stage = summarise(
        "coarse",
        matches,
        consensus.inliers,
        level_m=gsd_m,
        radius_m=radius_px * gsd_m,
        needed_m=error_m,
        voters=Voters(matches.line_sample, side_m / scene_gsd_m(scene)),
        lon_lat_h=points.lon_lat_h,
    )
    search = Search(points, rows, matches, consensus.inliers, side_m)
    return _Agreement(search, consensus, stage)


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
