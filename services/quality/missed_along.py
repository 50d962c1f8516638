"""Lines or samples of an image in which almost no point fits, while the rest fits.

A scanner takes all samples of a line at once: where it jumped, or oscillated by more than the search
radius, the adjustment loses whole lines. A detector takes the same samples of all lines: where it is out
of place, these are lost. Clouds and changes hide single points instead.
"""

import numpy as np
from scipy.special import bdtr

from amers.services.types import Array, BoolArray, IntArray

UNFOUND = ("low_score", "ambiguous", "border_peak", "views_disagree")
"""Why points are not found that the scene may show elsewhere: neither clouds nor missing pixels."""
_MAX_CHANCE = 0.01
_MOST_GAPS = 3
_FEWEST = 4
_MOST_ENDS = 400
"""Points at which intervals begin, and at which they end: dense references have thousands."""
_SAME, _FEWEST_IN_ROW = 0.0005, 4
"""So many points nearer to one another than this share of the image are a row of a grid, of the same
lines, or samples: no part of a row is whole lines."""
_HARDLY_ANY = 0.1
"""Share of the missed points that agree, over that of all, at most."""


def missed_along(position: Array, agrees: BoolArray, tried: BoolArray) -> BoolArray:
    """Points (n,) of lines, or of samples, where fewer agree than chance explains.

    The intervals are tried that begin and end with lines of which no point agrees. The chance of one
    is binomial, times their number, at most 0.01; random orders of the points of real scenes fall below
    this in about one of a thousand cases, because intervals overlap.

    Args:
        position: (n,) line or sample where the points are expected.
        agrees: (n,) with the scene.
        tried: (n,) those that the scene may show.
    """
    missed = np.zeros(len(position), dtype=bool)
    for _ in range(_MOST_GAPS):
        rows = np.flatnonzero(tried & ~missed)
        if agrees[rows].all():
            break
        rows = rows[np.argsort(position[rows], kind="stable")]
        of_interval = _least_likely_interval(agrees[rows], _groups(position[rows]))
        if not len(of_interval):
            break
        missed[rows[of_interval]] = True
    return missed


def _groups(position: Array) -> IntArray:
    """First of the points (n,), in order, of every row of a grid, or of a single point; and n."""
    n = len(position)
    apart = np.diff(position) > _SAME * (position[-1] - position[0])
    first = np.concatenate([[0], np.flatnonzero(apart) + 1, [n]])
    in_row = np.repeat(np.diff(first) >= _FEWEST_IN_ROW, np.diff(first))
    is_first = ~in_row
    is_first[first[:-1]] = True
    return np.append(np.flatnonzero(is_first), n)


def _least_likely_interval(agrees: BoolArray, group: IntArray) -> IntArray:
    """The run of points (n,) in which the fewest agree for chance; none where chance explains all.

    Args:
        agrees: (n,) of the points in order.
        group: first points of the groups (g,) that are in an interval together, and n.
    """
    nothing = np.zeros(0, dtype=np.int64)
    before = np.concatenate([[0], np.cumsum(agrees)])
    # What hides points here and there leaves some; lost lines leave none but by chance.
    most = _HARDLY_ANY * agrees.mean()
    hardly_any = np.diff(before[group]) <= most * np.diff(group)
    hardly_any = np.concatenate([[False], hardly_any, [False]])
    start = group[np.flatnonzero(hardly_any[1:-1] & ~hardly_any[:-2])]
    end = group[np.flatnonzero(hardly_any[1:-1] & ~hardly_any[2:]) + 1]
    step = -(-len(start) // _MOST_ENDS) or 1
    start, end = start[::step], end[::-step]
    length = end[None, :] - start[:, None]
    count = before[end][None, :] - before[start][:, None]
    tried = length >= _FEWEST
    lost = tried & (count <= most * length)
    if not lost.any():
        return nothing
    chance = bdtr(np.maximum(count, 0), np.maximum(length, 1), agrees.mean()) * tried.sum()
    chance[~lost] = np.inf
    first, last = np.unravel_index(int(np.argmin(chance)), chance.shape)
    if chance[first, last] > _MAX_CHANCE:
        return nothing
    return np.arange(start[first], end[last], dtype=np.int64)
