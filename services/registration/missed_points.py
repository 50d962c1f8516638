"""Second, wider search of points on lines and samples where points were not found.

The last search reaches a few pixels. Where lines were lost or repeated, or the sensor oscillates by
more, all points of some lines lie beyond it, while points of other lines are found. The same happens to
the samples of a detector that is out of place. Clouds hide points; they do not move them.
"""

from dataclasses import replace

import numpy as np

from amers.services.matching.control_points import ChipSearch, match_points, with_matches
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.quality.missed_along import UNFOUND, missed_along
from amers.services.registration.context import PointContext, Prediction
from amers.services.registration.search import Search, adjust_search, select_inliers
from amers.services.types import IntArray

_RADIUS_PX = 128
"""Search radius, pixels of the chips."""
_MOST = 40
"""Points that are searched again."""
_FEWEST = 4


def search_missed_points(
    context: PointContext, prediction: Prediction, search: Search, adjustment: SceneAdjustment
) -> tuple[Search, SceneAdjustment]:
    """The search and its adjustment with the points of missed lines or samples found farther out.

    Points of samples are taken if more agree with them: ground that moved in the middle of an image
    hides its samples, too.

    Args:
        context: of the registration.
        prediction: of all its points, by the registered model.
        search: the last one.
        adjustment: on it.
    """
    expected = prediction.model.project(search.points.lon_lat_h)
    reason = search.matches.reason
    unfound = np.isin(reason, UNFOUND)
    for axis in (0, 1):
        missed = missed_along(expected[:, axis], adjustment.active, unfound | (reason == ""))
        farther = _found_farther(context, prediction, search, np.flatnonzero(missed & unfound))
        if farther is None:
            continue
        again = adjust_search(context.scene, farther, context.options.adjustment, ground_may_move=True)
        if axis == 0 or again.active.sum() > adjustment.active.sum():
            return farther, again
    return search, adjustment


def _found_farther(
    context: PointContext, prediction: Prediction, search: Search, rows: IntArray
) -> Search | None:
    """The search with points of it that are found farther out; None where hardly any is."""
    rows = rows[:: -(-len(rows) // _MOST) or 1]
    if len(rows) < _FEWEST:
        return None
    chip_search = ChipSearch(
        context.image,
        prediction.model,
        context.scene.acquisition,
        context.fine_gsd_m,
        min(_RADIUS_PX, context.options.coarse.max_search_px),
    )
    points = search.points.take(rows)
    again = match_points(chip_search, points, context.chips, context.options.matching)
    if (again.reason == "").sum() < _FEWEST:
        return None
    matches = with_matches(search.matches, rows, again)
    inliers, _ = select_inliers(prediction.model, search.points, matches)
    return replace(search, matches=matches, inliers=inliers)
