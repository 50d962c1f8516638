"""Lines and samples whose points were missed, searched again farther out.

The last search reaches a few pixels. Where lines were lost or repeated, or the sensor swings by
more, all points of some lines lie beyond it, while those of other lines are found; so do those of the
samples of a detector that is out of place. Clouds hide points; they do not move them.
"""

from dataclasses import replace

import numpy as np

from services.adjustment.image_correction import SceneAdjustment
from services.matching.control_points import ChipSearch, match_points, with_matches
from services.quality.missed_along import UNFOUND, missed_along
from services.registration.context import PointContext, Prediction
from services.registration.search import Search, adjust_search, select_inliers

_RADIUS_PX = 128
"""Search radius, pixels of the chips."""
_MOST = 40
"""Points that are searched again."""
_FEWEST = 4


def search_missed_lines(
    context: PointContext, prediction: Prediction, search: Search, adjustment: SceneAdjustment
) -> tuple[Search, SceneAdjustment]:
    """The search and its adjustment with the points of missed lines and samples found farther out.

    Args:
        context: of the registration.
        prediction: of all its points, by the registered model.
        search: the last one.
        adjustment: on it.
    """
    expected = prediction.model.project(search.points.lon_lat_h)
    reason = search.matches.reason
    unfound = np.isin(reason, UNFOUND)
    tried = unfound | (reason == "")
    missed = missed_along(expected[:, 0], adjustment.active, tried)
    missed |= missed_along(expected[:, 1], adjustment.active, tried)
    rows = np.flatnonzero(missed & unfound)
    rows = rows[:: -(-len(rows) // _MOST) or 1]
    if len(rows) < _FEWEST:
        return search, adjustment
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
        return search, adjustment
    matches = with_matches(search.matches, rows, again)
    inliers, _ = select_inliers(prediction.model, search.points, matches)
    farther = replace(search, matches=matches, inliers=inliers)
    return farther, adjust_search(context.scene, farther, context.options.adjustment)
