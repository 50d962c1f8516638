"""Which of many measures tell the same story, and whether that could be chance."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import binom

from services.types import Array, BoolArray


@dataclass(frozen=True)
class Consensus:
    """A set of displacements that agree.

    Attributes:
        agreeing: (n,) members of the set.
        displacement: (2,) their mean.
        false_alarms: how many such sets chance alone would give; far below one when it can be believed.
    """

    agreeing: BoolArray
    displacement: Array
    false_alarms: float


def vote(displacement: Array, tolerance: float, search_radius: float) -> Consensus:
    """The largest set of displacements within a tolerance of one of them.

    How far it can be believed is counted a contrario (Desolneux, Moisan, Morel, 2000): displacements
    that mean nothing would be spread evenly over the search window.

    Args:
        displacement: (n, 2); rows with NaN do not vote.
        tolerance: radius within which two displacements agree, in the unit of the displacements.
        search_radius: half side of the square they were searched in, same unit.
    """
    voters = np.isfinite(displacement).all(axis=1)
    agreeing = np.zeros(len(displacement), dtype=bool)
    count = int(voters.sum())
    if count == 0:
        return Consensus(agreeing, np.full(2, np.nan), np.inf)
    tree = cKDTree(displacement[voters])
    neighbours = tree.query_ball_point(displacement[voters], tolerance)
    largest = max(neighbours, key=len)
    centre = displacement[voters][largest].mean(axis=0)
    members = tree.query_ball_point(centre, tolerance)
    members = members if len(members) >= len(largest) else largest
    agreeing[np.flatnonzero(voters)[members]] = True
    by_chance = min(1.0, np.pi * tolerance**2 / (2.0 * search_radius) ** 2)
    false_alarms = count * float(binom.sf(len(members) - 2, count - 1, by_chance))
    return Consensus(agreeing, displacement[agreeing].mean(axis=0), false_alarms)


def affine_consensus(
    position: Array, displacement: Array, candidates: BoolArray, tolerance: float
) -> BoolArray:
    """Measures that agree on one affine displacement field, by MAGSAC.

    Args:
        position: (n, 2) pixels.
        displacement: (n, 2) pixels.
        candidates: (n,) measures to look at; with fewer than six of them they are returned as they are.
        tolerance: distance beyond which a measure is certainly wrong, pixels.

    Returns:
        (n,) a subset of `candidates`.
    """
    rows = np.flatnonzero(candidates)
    if len(rows) < 6:
        return candidates
    matrix, inside = cv2.estimateAffine2D(
        position[rows],
        position[rows] + displacement[rows],
        method=cv2.USAC_MAGSAC,
        ransacReprojThreshold=tolerance,
        maxIters=5000,
        confidence=0.9999,
    )
    agreeing = np.zeros(len(position), dtype=bool)
    if matrix is not None:
        agreeing[rows[inside.ravel().astype(bool)]] = True
    return agreeing
