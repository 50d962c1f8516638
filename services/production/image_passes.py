"""Images of a block that may come from one pass of a satellite, and so have common errors."""

from collections.abc import Sequence
from datetime import timedelta

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from amers.services.types import Acquisition, Array, BoolArray, IntArray, Observations

_LONGEST_PASS = timedelta(minutes=20)
"""A satellite sees a place for less than this from horizon to horizon, and next after a whole orbit."""


def image_passes(acquisitions: Sequence[Acquisition]) -> list[BoolArray]:
    """Masks (n,) of the images that may come from one pass, for each group of two or more.

    Images of an unknown platform or time may come from the pass of any other.
    """
    n = len(acquisitions)
    sensor = np.array([one.sensor or "" for one in acquisitions], dtype=np.str_)
    moments = [one.acquired_at for one in acquisitions]
    time_s = np.array([np.nan if moment is None else moment.timestamp() for moment in moments])
    first, second = np.array(_links(sensor, time_s), dtype=np.int64).reshape(-1, 2).T
    links = sparse.coo_array((np.ones(len(first)), (first, second)), shape=(n, n))
    _, group = connected_components(links, directed=False)
    masks = [group == number for number in np.flatnonzero(np.bincount(group, minlength=1) > 1)]
    return [np.asarray(mask) for mask in masks]


def _links(sensor: npt.NDArray[np.str_], time_s: Array) -> list[tuple[int, int]]:
    """Pairs of images that may be of one pass: enough of them to join all that may."""
    links = []
    by_time = np.argsort(time_s, kind="stable")
    by_time = by_time[np.isfinite(time_s[by_time])]
    longest_s = _LONGEST_PASS.total_seconds()
    for name in np.unique(sensor[sensor != ""]):
        own = by_time[sensor[by_time] == name]
        near = np.flatnonzero(np.diff(time_s[own]) <= longest_s)
        links += list(zip(own[near].tolist(), own[near + 1].tolist(), strict=True))
    for i in np.flatnonzero((sensor == "") | np.isnan(time_s)).tolist():
        may_be = np.isnan(time_s) | np.isnan(time_s[i]) | (np.abs(time_s - time_s[i]) <= longest_s)
        may_be &= (sensor == "") | (sensor[i] == "") | (sensor == sensor[i])
        links += [(i, j) for j in np.flatnonzero(may_be).tolist()]
    return links


def dates_of_points(shown: Observations, passes: Sequence[BoolArray], count: int) -> IntArray:
    """Number (count,) of passes that show each point: what many dates show lasts longest."""
    date = np.arange(1 + int(shown.image.max(initial=0)))
    for members in passes:
        own = np.flatnonzero(members)
        date[own[own < len(date)]] = own[0]
    seen = np.unique(np.column_stack([shown.point, date[shown.image]]), axis=0)
    return np.bincount(seen[:, 0], minlength=count).astype(np.int64)
