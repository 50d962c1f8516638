"""Second search, in a wide window, of points that were not found at their expected positions.

The last search is narrow. A part of a scene that lies elsewhere (lines that were lost or repeated,
ground that moved) is beyond it: its points count as not found, and nothing else speaks of them.
"""

from dataclasses import dataclass, replace

import numpy as np

from amers.services.conventions import CHIP_SIZE
from amers.services.matching.consensus import (
    Consensus,
    Voters,
    a_contrario_consensus,
    consensus_tolerance_px,
)
from amers.services.matching.control_points import (
    ChipSearch,
    MatchingOptions,
    PointMatches,
    match_points,
    with_matches,
)
from amers.services.matching.height_consensus import height_consensus
from amers.services.matching.predict import spread_over_image
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.quality.missed_along import UNFOUND
from amers.services.quality.points_elsewhere import Elsewhere, are_contiguous, chance_of_contiguous
from amers.services.registration.context import PointContext, Prediction
from amers.services.registration.search import (
    FIRST_TOLERANCE_PX,
    Search,
    adjust_search,
    predict,
    select_inliers,
)
from amers.services.types import Array, BoolArray, IntArray

_FEWEST = 5
"""Points that were not found, from which on they are searched again."""
_MOST, _MOST_SHARE = 24, 0.25
"""Points that are searched again, well spread: so many, or this share of them where it is more."""
_RADIUS_PX = 56
"""Search radius, pixels of the chips."""
_VIEWS = 2
"""Views of a point that are tried: what is beyond chance is the agreement of points, not of views."""
_MAX_FALSE_ALARMS = 1e-3
_MAX_FALSE_ALARMS_FAR = 1e-5
"""The same of points found far away: what moved or changed each by itself does not move evenly over the
whole window, as chance is reckoned, but by little more than the narrow search allows."""
_BEYOND_ERRORS, _OF_TALL = 6.0, 2.0
"""Heights above the ground that no error explains, standard deviations; and how near such points must
lie to where their heights move them, scatter of the active ones."""
_CLEARLY, _ABOUT = 4.0, 0.5
"""Standard deviations by which active points have to move with their heights, and by which share of
what tall points do they may differ."""
_EXPLAINED = 0.75
"""Misfits that a slope with the height leaves, over those without it, at most."""


@dataclass(frozen=True)
class _Again:
    """A search of points that were missed.

    Attributes:
        rows: (k,) of the points, among all that the scene may show.
        matches: of them.
    """

    rows: IntArray
    matches: PointMatches


def adjust_with_places(
    context: PointContext, search: Search, adjustment: SceneAdjustment
) -> tuple[Search, SceneAdjustment, Elsewhere | None]:
    """The points that agree on another place of the scene, and the adjustment beside them.

    Args:
        context: of the registration.
        search: the last one.
        adjustment: on it.

    Returns:
        The search, with the points of both places where ground has moved; the adjustment on it; the
        points that agree elsewhere, None without any.
    """
    prediction = predict(context.scene, context.points, adjustment)
    elsewhere = _search_elsewhere(context, prediction, search, adjustment)
    if elsewhere and elsewhere.slope_px is None and not adjustment.moved:
        search, adjustment = _search_moved_ground(context, prediction, search, adjustment)
        if adjustment.moved:
            prediction = predict(context.scene, context.points, adjustment)
            elsewhere = _search_elsewhere(context, prediction, search, adjustment)
    return search, adjustment, elsewhere


def _search_elsewhere(
    context: PointContext, prediction: Prediction, search: Search, adjustment: SceneAdjustment
) -> Elsewhere | None:
    """The largest group of points that agree on another displacement beyond chance; None without any.

    Args:
        context: of the registration.
        prediction: of all its points, by the registered model.
        search: the last one.
        adjustment: on it.
    """
    beside = _on_moved_ground(prediction, search, adjustment)
    beside = beside or _lines_beside(prediction, search, adjustment)
    if beside is not None:
        return beside
    if _missed(search).sum() < _FEWEST:
        return None
    rows = _spread(context, prediction, search.rows[np.isin(search.matches.reason, UNFOUND)])
    matching = context.options.matching
    few = replace(matching, max_views=min(_VIEWS, matching.max_views))
    again = _Again(rows, _search_again(context, prediction, rows, few))
    beside = _as_heights_move(context, prediction, search, adjustment, again)
    return beside or _far_away(context, prediction, again, _scatter_m(context, adjustment))


def _search_moved_ground(
    context: PointContext, prediction: Prediction, search: Search, adjustment: SceneAdjustment
) -> tuple[Search, SceneAdjustment]:
    """The search with all missed points in a wide window, where it shows two places; else as it was.

    A narrow search follows the place that the points found first agree on, which may be the ground that
    moved. Measures of both places tell which of them has the larger part of the image.

    Args:
        context: of the registration.
        prediction: of all its points, by the registered model.
        search: the last one.
        adjustment: on it.
    """
    rows = np.flatnonzero(_missed(search))
    if len(rows) < _FEWEST:
        return search, adjustment
    again = _search_again(context, prediction, search.rows[rows], context.options.matching)
    matches = with_matches(search.matches, rows, again)
    inliers, _ = select_inliers(prediction.model, search.points, matches)
    wider = replace(search, matches=matches, inliers=inliers)
    told = adjust_search(context.scene, wider, context.options.adjustment, ground_may_move=True)
    return (wider, told) if told.moved else (search, adjustment)


def _search_again(
    context: PointContext, prediction: Prediction, rows: IntArray, matching: MatchingOptions
) -> PointMatches:
    """Matches of points in a wide window."""
    chip_search = ChipSearch(
        context.image, prediction.model, context.scene.acquisition, context.fine_gsd_m, _RADIUS_PX
    )
    points = context.points.take(rows)
    return match_points(chip_search, points, context.chips, matching)


def _on_moved_ground(
    prediction: Prediction, search: Search, adjustment: SceneAdjustment
) -> Elsewhere | None:
    """Points that were found on ground that moved."""
    if not adjustment.moved:
        return None
    members = np.flatnonzero(adjustment.moved.measures)
    displacement_px = np.median(adjustment.residual_px[members], axis=0)
    return Elsewhere(
        rows=search.rows[members],
        displacement_px=displacement_px,
        displacement_m=_on_ground_m(prediction, search.points.lon_lat_h[members], displacement_px),
        false_alarms=float(np.exp(-adjustment.moved.log_evidence)),
    )


def _on_ground_m(prediction: Prediction, lon_lat_h: Array, displacement_px: Array) -> float:
    """Length on the ground of a displacement (2,), line and sample, of points (k, 3)."""
    derivative = prediction.model.project_derivative(lon_lat_h).mean(axis=0)
    return float(np.hypot(*np.linalg.solve(derivative[:, :2], displacement_px)))


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
    left = left[np.hypot(*misfit_px[left].T) > tolerance_px]
    if len(left) < _FEWEST:
        return None
    farthest_px = float(np.abs(misfit_px[left]).max())
    group = a_contrario_consensus(misfit_px[left], tolerance_px, farthest_px)
    members = left[group.inliers]
    line, others = expected[members, 0], expected[adjustment.active, 0]
    if len(members) < _FEWEST or not are_contiguous(line, others):
        return None
    false_alarms = group.false_alarms * chance_of_contiguous(line, others)
    if false_alarms > _MAX_FALSE_ALARMS:
        return None
    return Elsewhere(
        rows=search.rows[members],
        displacement_px=group.displacement,
        displacement_m=_on_ground_m(prediction, search.points.lon_lat_h[members], group.displacement),
        false_alarms=false_alarms,
    )


def _as_heights_move(
    context: PointContext,
    prediction: Prediction,
    search: Search,
    adjustment: SceneAdjustment,
    again: _Again,
) -> Elsewhere | None:
    """Points that are displaced in proportion to their heights: the model is that of another view."""
    found = np.flatnonzero(search.matches.reason == "")
    place = np.concatenate([search.rows[found], again.rows])
    measured = np.concatenate([search.matches.line_sample[found], again.matches.line_sample])
    active = np.concatenate([adjustment.active[found], np.zeros(len(again.rows), dtype=bool)])
    lon_lat_h = context.points.lon_lat_h[place]
    expected = prediction.model.project(lon_lat_h)
    misfit_px = measured - expected
    if active.sum() < _FEWEST:
        return None
    plane = np.column_stack([np.ones(len(place)), expected])
    coefficients = np.linalg.lstsq(plane[active], lon_lat_h[active, 2], rcond=None)[0]
    above_m = lon_lat_h[:, 2] - plane @ coefficients
    rms_px = float(np.sqrt(np.mean(misfit_px[active] ** 2)))
    tolerance_px = consensus_tolerance_px(rms_px)
    reach_px = np.full(len(place), _RADIUS_PX * context.fine_gsd_m / context.gsd_m)
    reach_px[: len(found)] = max(float(np.abs(misfit_px[: len(found)]).max()), tolerance_px)
    group = height_consensus(misfit_px, above_m, tolerance_px, reach_px)
    if not _is_of_all(group, misfit_px, above_m):
        # Near the ground, errors of the heights displace points as well.
        tall = np.abs(above_m) > _BEYOND_ERRORS * np.sqrt(context.points.covariance_m2[place, 2, 2])
        of_tall_px = np.where(tall[:, None], misfit_px, np.nan)
        group = height_consensus(of_tall_px, above_m, _OF_TALL * rms_px, reach_px)
        if not _is_of_active(group, misfit_px[active], above_m[active], rms_px):
            return None
    members = np.flatnonzero(group.inliers)
    displacement_px = np.median(misfit_px[members], axis=0)
    return Elsewhere(
        rows=place[members],
        displacement_px=displacement_px,
        displacement_m=_on_ground_m(prediction, lon_lat_h[members], displacement_px),
        false_alarms=group.false_alarms,
        slope_px=group.displacement,
        farthest_px=float(np.hypot(*misfit_px[members].T).max()),
    )


def _is_of_all(group: Consensus, misfit_px: Array, above_m: Array) -> bool:
    """Whether points move with their heights beyond chance, and where they are few, the others, too."""
    if group.false_alarms > _MAX_FALSE_ALARMS:
        return False
    if group.inliers.sum() >= _FEWEST:
        return True
    others = np.isfinite(misfit_px).all(axis=1) & ~group.inliers
    without = np.median(np.hypot(*misfit_px[others].T))
    left_px = misfit_px[others] - above_m[others, None] * group.displacement
    return bool(np.median(np.hypot(*left_px.T)) <= _EXPLAINED * without)


def _is_of_active(group: Consensus, misfit_px: Array, above_m: Array, rms_px: float) -> bool:
    """Whether tall points move with their heights beyond chance, and active ones (n,) about as much."""
    weight = float(above_m @ above_m)
    if group.false_alarms > _MAX_FALSE_ALARMS or weight == 0.0:
        return False
    slope_px = above_m @ misfit_px / weight
    beside = np.hypot(*(slope_px - group.displacement)) / np.hypot(*group.displacement)
    clear = np.hypot(*slope_px) > _CLEARLY * rms_px / np.sqrt(weight)
    return bool(clear and beside < _ABOUT)


def _scatter_m(context: PointContext, adjustment: SceneAdjustment) -> float:
    """Distance within which points agree with the scene."""
    residual_px = adjustment.residual_px[adjustment.active]
    return consensus_tolerance_px(float(np.sqrt(np.mean(residual_px**2)))) * context.gsd_m


def _far_away(
    context: PointContext, prediction: Prediction, again: _Again, scatter_m: float
) -> Elsewhere | None:
    """Points that are found together, but far from where they are expected."""
    rows, matches = again.rows, again.matches
    points, gsd_m = context.points.take(rows), context.fine_gsd_m
    tolerance_m = FIRST_TOLERANCE_PX * gsd_m
    displacement_m = matches.displacement_m.copy()
    # Points that lie where they are expected, and were missed before, are of the scene.
    near_m = min(2.0 * scatter_m, 2.0 * tolerance_m)
    displacement_m[np.hypot(*displacement_m.T) <= near_m] = np.nan
    voters = Voters(matches.line_sample, CHIP_SIZE * gsd_m / context.gsd_m)
    group = a_contrario_consensus(displacement_m, tolerance_m, _RADIUS_PX * gsd_m, voters)
    if group.inliers.sum() < 3 or group.false_alarms > _MAX_FALSE_ALARMS_FAR:
        return None
    expected = prediction.model.project(points.lon_lat_h[group.inliers])
    return Elsewhere(
        rows=rows[group.inliers],
        displacement_px=np.asarray(
            np.median(matches.line_sample[group.inliers] - expected, axis=0), np.float64
        ),
        displacement_m=float(np.hypot(*group.displacement)),
        false_alarms=group.false_alarms,
    )


def _missed(search: Search) -> BoolArray:
    """Points (k,) of a search that it did not find though it may show them, or that do not agree."""
    reason = search.matches.reason
    return np.asarray(np.isin(reason, UNFOUND) | ((reason == "") & ~search.inliers))


def _spread(context: PointContext, prediction: Prediction, rows: IntArray) -> IntArray:
    """Those of the rows of points that are searched again, well spread."""
    count = max(_MOST, int(_MOST_SHARE * len(rows)))
    if len(rows) <= count:
        return rows
    points = context.points.take(rows)
    best = spread_over_image(
        prediction.model.project(points.lon_lat_h),
        points.lon_lat_h[:, 2],
        points.saliency * points.health,
        context.scene.image.shape,
        count,
    )
    return np.asarray(np.sort(rows[best]))
