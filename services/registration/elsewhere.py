"""Points that were not found where the registered model expects them, searched again in a wide window.

The last search is narrow. A part of a scene that lies elsewhere (lines that were lost or repeated,
ground that moved) is beyond it: its points count as not found, and nothing else speaks of them.
"""

import numpy as np

from services.adjustment.image_correction import SceneAdjustment
from services.conventions import CHIP_SIZE
from services.matching.consensus import Voters, a_contrario_consensus, consensus_tolerance_px
from services.matching.control_points import ChipSearch, match_points
from services.matching.predict import spread_over_image
from services.quality.lack_of_fit import Elsewhere, are_whole_lines
from services.registration.context import PointContext, Prediction
from services.registration.search import FIRST_TOLERANCE_PX, Search
from services.types import BoolArray, IntArray

_FEWEST = 5
"""Points that were not found, from which on they are searched again."""
_MOST = 24
"""Points that are searched again, well spread."""
_RADIUS_PX = 56
"""Search radius, pixels of the chips."""
_MAX_FALSE_ALARMS = 1e-3
_LIKELY_REASONS = ("low_score", "ambiguous", "border_peak", "views_disagree")


def search_elsewhere(
    context: PointContext, prediction: Prediction, search: Search, adjustment: SceneAdjustment
) -> Elsewhere | None:
    """The largest group of points that agree on another displacement beyond chance; None without any.

    Args:
        context: of the registration.
        prediction: of all its points, by the registered model.
        search: the last one.
        adjustment: on it.
    """
    return _lines_beside(prediction, search, adjustment) or _far_away(context, prediction, search)


def _lines_beside(
    prediction: Prediction, search: Search, adjustment: SceneAdjustment
) -> Elsewhere | None:
    """Lines of which the points were found, and agree with each other but not with the scene."""
    found = search.matches.reason == ""
    left = np.flatnonzero(found & ~adjustment.active)
    if len(left) < _FEWEST or not adjustment.active.any():
        return None
    expected = prediction.model.project(search.points.lon_lat_h)
    misfit_px = search.matches.line_sample - expected
    rms_px = float(np.sqrt(np.mean(misfit_px[adjustment.active] ** 2)))
    tolerance_px = consensus_tolerance_px(rms_px)
    farthest_px = float(np.abs(misfit_px[left]).max(initial=tolerance_px))
    group = a_contrario_consensus(misfit_px[left], tolerance_px, farthest_px)
    members = left[group.inliers]
    significant = len(members) >= _FEWEST and group.false_alarms <= _MAX_FALSE_ALARMS
    if not significant or not are_whole_lines(expected[members, 0], expected[adjustment.active, 0]):
        return None
    derivative = prediction.model.project_derivative(search.points.lon_lat_h[members]).mean(axis=0)
    moved_m = np.linalg.solve(derivative[:, :2], group.displacement)
    return Elsewhere(
        rows=search.rows[members],
        displacement_px=group.displacement,
        displacement_m=float(np.hypot(*moved_m)),
        false_alarms=group.false_alarms,
        missed=len(left),
        share_of_missed=len(members) / len(left),
    )


def _far_away(context: PointContext, prediction: Prediction, search: Search) -> Elsewhere | None:
    """Points that are found together, but far from where they are expected."""
    missed = _missed(search)
    rows = _spread(context, prediction, search.rows[missed])
    if len(rows) < _FEWEST:
        return None
    points, gsd_m = context.points.take(rows), context.fine_gsd_m
    chip_search = ChipSearch(
        context.image, prediction.model, context.scene.acquisition, gsd_m, _RADIUS_PX
    )
    matches = match_points(chip_search, points, context.chips, context.options.matching)
    tolerance_m = FIRST_TOLERANCE_PX * gsd_m
    displacement_m = matches.displacement_m.copy()
    # Points that lie where they are expected, and were missed before, are of the scene.
    displacement_m[np.hypot(*displacement_m.T) <= 2.0 * tolerance_m] = np.nan
    voters = Voters(matches.line_sample, CHIP_SIZE * gsd_m / context.gsd_m)
    group = a_contrario_consensus(displacement_m, tolerance_m, _RADIUS_PX * gsd_m, voters)
    if group.inliers.sum() < 3 or group.false_alarms > _MAX_FALSE_ALARMS:
        return None
    expected = prediction.model.project(points.lon_lat_h[group.inliers])
    return Elsewhere(
        rows=rows[group.inliers],
        displacement_px=np.asarray(
            np.median(matches.line_sample[group.inliers] - expected, axis=0), np.float64
        ),
        displacement_m=float(np.hypot(*group.displacement)),
        false_alarms=group.false_alarms,
        missed=int(missed.sum()),
        share_of_missed=float(group.inliers.mean()),
    )


def _missed(search: Search) -> BoolArray:
    """Points (k,) of a search that it did not find though it may show them, or that do not agree."""
    reason = search.matches.reason
    return np.asarray(np.isin(reason, _LIKELY_REASONS) | ((reason == "") & ~search.inliers))


def _spread(context: PointContext, prediction: Prediction, rows: IntArray) -> IntArray:
    """At most `_MOST` of the rows of points, well spread."""
    if len(rows) <= _MOST:
        return rows
    points = context.points.take(rows)
    best = spread_over_image(
        prediction.model.project(points.lon_lat_h),
        points.lon_lat_h[:, 2],
        points.saliency * points.health,
        context.scene.image.shape,
        _MOST,
    )
    return np.asarray(np.sort(rows[best]))
