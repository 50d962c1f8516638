"""Which of many measures tell the same story, and whether that could be chance."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from services.types import Array, BoolArray

MEDIAN_DISTANCE = float(np.sqrt(2.0 * np.log(2.0)))
"""Median distance of a circular normal law of unit sigma (1.177)."""

LEAST_FOR_SCATTER = 10
"""From so many measures on their scatter is known well enough to correct what is declared."""

MAX_WIDENINGS = 4


@dataclass(frozen=True)
class Consensus:
    """A set of displacements that agree.

    Attributes:
        inliers: (n,) members of the set.
        displacement: (2,) their mean.
        false_alarms: how many such sets chance alone would give; far below one when it can be believed.
    """

    inliers: BoolArray
    displacement: Array
    false_alarms: float


def a_contrario_consensus(displacement: Array, tolerance: float, search_radius: float) -> Consensus:
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
    false_alarms = count * float(bdtrc(len(members) - 2, count - 1, by_chance))
    return Consensus(agreeing, displacement[agreeing].mean(axis=0), false_alarms)


def consensus_tolerance_px(sigma_px: float) -> float:
    """Distance beyond which a measure does not belong to a consensus; half a pixel is for its model."""
    return 3.0 * sigma_px + 0.5


def robust_affine_inliers(
    position: Array, displacement: Array, candidates: BoolArray, sigma_px: float
) -> tuple[BoolArray, float]:
    """Measures that agree on one affine displacement, as far as they turn out to scatter.

    Points that are worse than declared scatter beyond a tolerance taken from what is declared: cut off
    there, those left would look as good as declared. So the scale is taken from all that lie around.

    Args:
        position, displacement: (n, 2) pixels.
        candidates: (n,) measures to look at.
        sigma_px: declared standard deviation of a measure against its point.

    Returns:
        Members (n,), and how many times the declared sigma they scatter, at least 1.
    """
    scale, agreeing = 1.0, candidates
    for _ in range(MAX_WIDENINGS):
        tolerance_px = consensus_tolerance_px(scale * sigma_px)
        agreeing = affine_inliers(position, displacement, candidates, tolerance_px)
        if agreeing.sum() < LEAST_FOR_SCATTER:
            break
        seen = _scatter_px(position, displacement, candidates, agreeing, 4.0 * tolerance_px)
        if seen <= 1.1 * scale * sigma_px:
            break
        scale = seen / sigma_px
    return agreeing, scale


def _scatter_px(
    position: Array, displacement: Array, candidates: BoolArray, agreeing: BoolArray, reach_px: float
) -> float:
    """Robust standard deviation a coordinate of the candidates around the affine of those that agree."""
    design = np.column_stack([np.ones(len(position)), position])
    affine = np.linalg.lstsq(design[agreeing], displacement[agreeing], rcond=None)[0]
    distance = np.hypot(*(displacement - design @ affine)[candidates].T)
    return float(np.median(distance[distance <= reach_px]) / MEDIAN_DISTANCE)


def affine_inliers(
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
