"""Displacements that grow with height, which show that a model belongs to another view."""

import numpy as np
from scipy.special import bdtrc, gammaln

from amers.services.matching.consensus import Consensus
from amers.services.types import Array, BoolArray

_TELLING = 2.0
"""Displacements that tell a slope, tolerances."""
_MOST_TRIED = 200
_OF_A_VIEW = 4
"""Points that determine an affine displacement with a slope."""
_DRAWS = 2000


def height_consensus(displacement: Array, height_m: Array, tolerance: float, search: Array) -> Consensus:
    """The points that are displaced in proportion to their heights, and the significance of that.

    Each displaced point gives a slope. A slope is that of a view if most points agree which it should
    move; its number of false alarms is that of random displacements, as for `a_contrario_consensus`.

    Args:
        displacement: (n, 2) from where the model expects them; rows with NaN do not take part.
        height_m: (n,) above the plane through the points that the model fits, metres.
        tolerance: within which two displacements agree, in the unit of the displacements.
        search: (n,) half sides of the square search windows, same unit.

    Returns:
        The consensus; its displacement is that of a metre of height.
    """
    inliers = np.zeros(len(displacement), dtype=bool)
    none = Consensus(inliers, np.full(2, np.nan), 1.0)
    length = np.hypot(*displacement.T)
    telling = np.flatnonzero(length > _TELLING * tolerance)
    trials = len(telling)
    lean = telling[height_m[telling] != 0.0][:_MOST_TRIED]
    if trials < 2 or not len(lean):
        return none
    slopes = displacement[lean] / height_m[lean, None]
    moved = slopes[:, None] * height_m[None, :, None]
    agrees = np.linalg.norm(displacement - moved, axis=2) <= tolerance
    count = agrees[:, telling].sum(axis=1)
    slope = slopes[int(np.argmax(count))]
    for _ in range(2):
        members = telling[
            np.linalg.norm(displacement[telling] - slope * height_m[telling, None], axis=1) <= tolerance
        ]
        if len(members) < 2:
            return none
        weight = height_m[members]
        slope = weight @ displacement[members] / float(weight @ weight)
    expected = slope * height_m[:, None]
    should_move = np.isfinite(length) & (np.hypot(*expected.T) > _TELLING * tolerance)
    agreeing = np.linalg.norm(displacement - expected, axis=1) <= tolerance
    if agreeing[should_move].sum() <= 0.5 * should_move.sum():
        return none
    inliers[telling] = agreeing[telling]
    chance = np.minimum(np.pi * tolerance**2 / (2.0 * search[telling]) ** 2, 1.0)
    false_alarms = trials * float(bdtrc(inliers.sum() - 2, trials - 1, float(chance.mean())))
    return Consensus(inliers, slope, false_alarms)


def view_consensus(
    position: Array, displacement: Array, height_m: Array, tolerance: float, search: float
) -> tuple[BoolArray, float]:
    """The points that an affine displacement and a slope with the height explain, and its significance.

    That is what the model of another view of the same ground does. Random quadruples of points give the
    eight parameters. The number of false alarms counts all sets of points of this size and all their
    quadruples (Moisan and Stival, 2004).

    Args:
        position: (n, 2) where the model expects the points.
        displacement: (n, 2) from there; rows with NaN do not take part.
        height_m: (n,) metres.
        tolerance: within which a point agrees, in the unit of the displacements.
        search: half side of the square search window, same unit.

    Returns:
        Agreeing points (n,), and the number of such sets that chance makes.
    """
    agrees = np.zeros(len(displacement), dtype=bool)
    rows = np.flatnonzero(np.isfinite(displacement).all(axis=1))
    n = len(rows)
    if n <= _OF_A_VIEW:
        return agrees, float("inf")
    columns = np.column_stack([position[rows], height_m[rows]])
    columns = (columns - columns.mean(axis=0)) / np.maximum(columns.std(axis=0), 1e-9)
    design = np.column_stack([np.ones(n), columns])
    rng = np.random.default_rng(0)
    drawn = np.argsort(rng.random((_DRAWS, n)), axis=1)[:, :_OF_A_VIEW]
    coefficients = np.linalg.pinv(design[drawn], rcond=1e-6) @ displacement[rows][drawn]
    misfit = displacement[rows] - design @ coefficients
    within = np.linalg.norm(misfit, axis=2) <= tolerance
    best = within[int(np.argmax(within.sum(axis=1)))]
    agreeing = int(best.sum())
    if agreeing <= _OF_A_VIEW:
        return agrees, float("inf")
    chance = min(1.0, np.pi * tolerance**2 / (2.0 * search) ** 2)
    logarithm = (
        np.log(n - _OF_A_VIEW)
        + _log_choose(n, agreeing)
        + _log_choose(agreeing, _OF_A_VIEW)
        + (agreeing - _OF_A_VIEW) * np.log(chance)
    )
    agrees[rows[best]] = True
    return agrees, float(np.exp(min(logarithm, 700.0)))


def _log_choose(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))
