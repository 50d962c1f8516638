"""Points that agree with each other on a displacement that the rest of the scene does not have."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.special import comb

from amers.services.types import Array, BoolArray, IntArray

_NEAREST = 8
"""Nearest points left out, one of which has to be displaced alike: a limit that people set. Of false
matches in a window of some pixels, fewer than 15 of 100 have one by chance: see its test."""
_WITHIN = 0.15
"""Active points between the lines of points that lie elsewhere, over these, up to which they are of
whole lines."""
_ALONG = 0.1
"""Displacement along the samples over that along the lines, up to which lines alone were displaced."""
_ENOUGH = 4
"""Points that agree elsewhere, from which on one may do so by chance."""
_CHANCE_OF_SAMPLES = 0.01
"""Of points drawn at random being those of whole samples, at most, to be taken for these."""


@dataclass(frozen=True)
class Elsewhere:
    """Points that agree on another displacement than the rest of the scene.

    Attributes:
        rows: (k,) of the points, among all that the scene may show.
        displacement_px: (2,) line and sample, from where the registered model expects them.
        displacement_m: its length on the ground.
        false_alarms: number of such groups that chance makes.
        slope_px: (2,) line and sample by which a metre of height displaces them; None where they are
            displaced alike.
        farthest_px: largest displacement, where they differ.
    """

    rows: IntArray
    displacement_px: Array
    displacement_m: float
    false_alarms: float
    slope_px: Array | None = None
    farthest_px: float = 0.0


def agree_elsewhere(
    expected: Array, misfit_px: Array, left_out: BoolArray, tolerance_px: float
) -> BoolArray:
    """Points (n,) left out that a neighbour agrees with, beyond what agrees with the scene.

    False matches lie anywhere; what is displaced together is a part of the image, or the ground.

    Args:
        expected: (n, 2) line and sample where the scene places the points.
        misfit_px: (n, 2) from there to where they were found.
        left_out: (n,) points that were found and do not agree with the scene.
        tolerance_px: within which points agree.
    """
    away = np.hypot(*misfit_px.T) > tolerance_px
    rows = np.flatnonzero(left_out & away)
    out = np.zeros(len(expected), dtype=bool)
    if len(rows) < 2:
        return out
    _, near = KDTree(expected[rows]).query(expected[rows], k=min(_NEAREST, len(rows)))
    apart = misfit_px[rows][near[:, 1:]] - misfit_px[rows][:, None, :]
    out[rows] = (np.linalg.norm(apart, axis=2) <= tolerance_px / 2.0).any(axis=1)
    return out


def elsewhere_words(
    group: Elsewhere, expected: Array, active: BoolArray, *, in_part: bool = False
) -> str:
    """What was seen of a group of points, and what the places of the others say of its cause.

    Args:
        group: points that agree elsewhere.
        expected: (n, 2) line and sample where the scene places all points.
        active: (n,) points that agree with the scene.
        in_part: whether the pixels show a part of another image there.
    """
    some, others = expected[group.rows], expected[active]
    first, last = some.min(axis=0), some.max(axis=0)
    seen = (
        f"{len(some)} points of lines {first[0]:.0f} to {last[0]:.0f} and samples {first[1]:.0f} to "
        f"{last[1]:.0f} agree on a place {np.hypot(*group.displacement_px):.1f} px "
        f"({group.displacement_m:.1f} m) away ({group.displacement_px[0]:+.1f} lines, "
        f"{group.displacement_px[1]:+.1f} samples; {group.false_alarms:.1g} such groups expected by "
        "chance)"
    )
    if in_part:
        return f"{seen}. The pixels show a part of another image there"
    return f"{seen}. {_cause(some, others, group.displacement_px)}"


def _cause(some: Array, others: Array, displacement_px: Array) -> str:
    """The cause that places of points (n, 2) and of others (m, 2) support."""
    if _belong_to_whole_lines(some[:, 0], others[:, 0], displacement_px):
        return (
            "Hardly another point lies between these lines: lines of the image were lost or repeated, "
            "or belong to another image"
        )
    by_chance = chance_of_contiguous(some[:, 1], others[:, 1])
    if are_contiguous(some[:, 1], others[:, 1]) and by_chance <= _CHANCE_OF_SAMPLES:
        return (
            "Hardly another point lies between these samples: a detector is out of place, or the image "
            "was put together from parts"
        )
    return (
        "Points next to them agree with the scene. Possible causes: ground that moved (a landslide, a "
        "quarry, ice), or a part of another image"
    )


def _belong_to_whole_lines(line: Array, others: Array, displacement_px: Array) -> bool:
    """Whether points on another displacement are those of whole lines.

    Lost lines displace along the lines alone: then one point beyond the others may be there by chance.
    """
    along = abs(displacement_px[1]) <= _ALONG * abs(displacement_px[0])
    ordered = np.sort(line)
    parts = [ordered, ordered[1:], ordered[:-1]] if along and len(line) >= _ENOUGH else [ordered]
    return any(are_contiguous(part, others) for part in parts)


def chance_of_contiguous(position: Array, others: Array) -> float:
    """Chance that n of all n + m points, drawn at random, are contiguous, at most."""
    n = len(position)
    places = int(n + max(1.0, _WITHIN * n))
    total = n + len(others)
    if places >= total:
        return 1.0
    windows = (total - places + 1) * float(comb(places, n))
    return min(windows / float(comb(total, n)), 1.0)


def are_contiguous(position: Array, others: Array) -> bool:
    """Whether hardly any other points (m,) lie between points (n,), by their lines or their samples."""
    between = int(((others >= position.min()) & (others <= position.max())).sum())
    return between <= max(1.0, _WITHIN * len(position))
