"""Points that have vanished: later scenes show their neighbours, but not the points."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from amers.services.geodesy import continuous, east_north_up
from amers.services.types import Array, BoolArray, IntArray, health

Days = npt.NDArray[np.datetime64]

FALSE_SHARE = 0.05
"""Expected share of the points called vanished that are still there."""
_NEIGHBOURS = 20
"""Nearest other points that tell how often an ordinary point is found at a place in a scene."""


@dataclass(frozen=True)
class Searches:
    """m searches of points in scenes.

    Attributes:
        scene: (m,) int64, rows of `days`.
        point: (m,) int64, rows of the caller's points; a scene searches a point once.
        found: (m,) whether the point was active at the end.
        days: (s,) datetime64[D], when each scene was taken.
    """

    scene: IntArray
    point: IntArray
    found: BoolArray
    days: Days


@dataclass(frozen=True)
class VanishedPoints:
    """k points that have vanished, the most certain first.

    Attributes:
        point: (k,) int64, rows of the caller's points.
        missed: (k,) int64, scenes that have searched the point in vain since it was last found.
        last_found: (k,) datetime64[D], day of the last scene that found it; NaT for never.
        probability: (k,) that all these scenes miss a point that is still there.
    """

    point: IntArray
    missed: IntArray
    last_found: Days
    probability: Array

    def __len__(self) -> int:
        return len(self.point)


def vanished_points(lon_lat_h: Array, searches: Searches) -> VanishedPoints:
    """The points that are no longer there, at most one in twenty of them wrongly.

    A point that is still there is found in a scene with the probability `share * health`: the share of
    its 20 nearest neighbours that the scene found, and the point's own successes before against those of
    its neighbours. The scenes since the point was last found are taken as one try for each quarter of a
    year, the strongest, because scenes of one season miss a point for one reason. The product over these
    tries is the probability that a point is missed which is still there; Benjamini and Hochberg's
    procedure over all points that were searched decides how small it must be.

    A cloud that nobody has masked hides neighbours too, and so says nothing about a point.

    Args:
        lon_lat_h: (n, 3) the points.
        searches: of these points.
    """
    n = len(lon_lat_h)
    share = _neighbours_found(lon_lat_h, searches)
    # Point by point in the order of time; on one day a success counts as the last search.
    order = np.lexsort((searches.found, searches.days[searches.scene], searches.point))
    point, found, share = searches.point[order], searches.found[order], share[order]
    day = searches.days[searches.scene[order]]
    place = np.arange(len(order))
    last = np.full(n, -1, dtype=np.int64)
    np.maximum.at(last, point[found], place[found])
    since = place > last[point]
    successes = np.bincount(point[found], minlength=n)
    expected = np.bincount(point[~since], weights=share[~since], minlength=n)
    present = share * health(expected, successes)[point]

    rows = np.flatnonzero(since)
    quarter = day[rows].astype("datetime64[M]").astype(np.int64) // 3
    tries, of_try = np.unique(np.column_stack([point[rows], quarter]), axis=0, return_inverse=True)
    log_missed = np.zeros(len(tries))
    np.minimum.at(log_missed, of_try.ravel(), np.log1p(-present[rows]))
    probability = np.exp(np.bincount(tries[:, 0], weights=log_missed, minlength=n))

    vanished = _discoveries(probability, np.unique(point))
    missed = np.bincount(point[rows], minlength=n)
    last_found = np.full(n, np.datetime64("NaT"), dtype="datetime64[D]")
    last_found[last >= 0] = day[last[last >= 0]]
    return VanishedPoints(
        vanished,
        missed[vanished].astype(np.int64),
        last_found[vanished],
        probability[vanished],
    )


def _neighbours_found(lon_lat_h: Array, searches: Searches) -> Array:
    """Probability (m,) that an ordinary point is found at the place and in the scene of each search.

    Of k neighbours f were found: (f + 1) / (k + 2), the mean under an even prior.
    """
    share = np.empty(len(searches.point))
    enu = np.empty((0, 3))
    if len(lon_lat_h):
        enu = east_north_up(lon_lat_h, np.median(continuous(lon_lat_h), axis=0))
    by_scene = np.argsort(searches.scene, kind="stable")
    for rows in np.split(by_scene, np.flatnonzero(np.diff(searches.scene[by_scene])) + 1):
        if len(rows) == 0:
            continue
        k = min(_NEIGHBOURS, len(rows) - 1)
        found = np.zeros(len(rows))
        if k > 0:
            place = enu[searches.point[rows], :2]
            near = np.asarray(cKDTree(place).query(place, k + 1)[1])
            own = near == np.arange(len(rows))[:, None]
            own[~own.any(axis=1), -1] = True
            found = (searches.found[rows][near] & ~own).sum(axis=1)
        share[rows] = (found + 1.0) / (k + 2.0)
    return share


def _discoveries(probability: Array, searched: IntArray) -> IntArray:
    """Rows of the points whose probability is too small for chance, the smallest first.

    Source: Benjamini and Hochberg (1995), Controlling the false discovery rate.
    """
    order = searched[np.argsort(probability[searched], kind="stable")]
    limit = FALSE_SHARE * np.arange(1, len(order) + 1) / max(len(order), 1)
    below = np.flatnonzero(probability[order] <= limit)
    return order[: below[-1] + 1] if len(below) else order[:0]
