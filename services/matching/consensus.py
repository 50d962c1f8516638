"""Outlier rejection: the largest set of consistent displacements, with its a-contrario significance."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from services.conventions import MAX_ERROR_SIGMAS
from services.types import Array, BoolArray

MEDIAN_DISTANCE = float(np.sqrt(2.0 * np.log(2.0)))
"""Median distance from the centre of a circular normal distribution of unit sigma (1.177)."""

MIN_FOR_SCATTER = 10
"""Fewest inliers whose scatter is estimated well enough to replace the declared sigma."""

MIN_FOR_AFFINE = 6
"""Fewest measures from which an affine displacement field is estimated robustly."""

MAX_SCALE_UPDATES = 4


@dataclass(frozen=True)
class Consensus:
    """A set of displacements that agree with each other.

    Attributes:
        inliers: (n,) members of the set.
        displacement: (2,) their mean.
        false_alarms: expected number of sets as large as this one in random displacements; far below 1
            for a significant set.
    """

    inliers: BoolArray
    displacement: Array
    false_alarms: float


def a_contrario_consensus(displacement: Array, tolerance: float, search_radius: float) -> Consensus:
    """The largest set of displacements within a tolerance of a common centre, and its significance.

    The background model is a uniform distribution of random displacements over the search window.

    Source: Desolneux, Moisan and Morel (2000), Meaningful alignments: the number of false alarms.

    Args:
        displacement: (n, 2); rows with NaN do not take part.
        tolerance: radius within which two displacements agree, in the unit of the displacements.
        search_radius: half side of the square search window, same unit.
    """
    valid = np.isfinite(displacement).all(axis=1)
    inliers = np.zeros(len(displacement), dtype=bool)
    count = int(valid.sum())
    if count == 0:
        return Consensus(inliers, np.full(2, np.nan), np.inf)
    tree = cKDTree(displacement[valid])
    neighbours = tree.query_ball_point(displacement[valid], tolerance)
    largest = max(neighbours, key=len)
    centre = displacement[valid][largest].mean(axis=0)
    members = tree.query_ball_point(centre, tolerance)
    members = members if len(members) >= len(largest) else largest
    inliers[np.flatnonzero(valid)[members]] = True
    probability = min(1.0, np.pi * tolerance**2 / (2.0 * search_radius) ** 2)
    false_alarms = count * float(bdtrc(len(members) - 2, count - 1, probability))
    return Consensus(inliers, displacement[inliers].mean(axis=0), false_alarms)


def consensus_tolerance_px(sigma_px: float) -> float:
    """Largest distance of an inlier from the consensus: three sigmas and 0.5 px for the model error."""
    return MAX_ERROR_SIGMAS * sigma_px + 0.5


def robust_affine_inliers(
    position: Array, displacement: Array, candidates: BoolArray, sigma_px: float
) -> tuple[BoolArray, float]:
    """Measures that fit one affine displacement field, with the scale of their observed scatter.

    Points worse than declared scatter beyond a tolerance taken from the declared sigma. Cutting them off
    there would leave a set that looks as good as declared. So the tolerance is widened until it matches
    the scatter of all candidates near the field.

    Args:
        position, displacement: (n, 2) pixels.
        candidates: (n,) measures to consider.
        sigma_px: declared standard deviation of a measure relative to its point.

    Returns:
        Inliers (n,), and the ratio of their observed scatter to the declared sigma, at least 1.
    """
    scale, inliers = 1.0, candidates
    for _ in range(MAX_SCALE_UPDATES):
        tolerance_px = consensus_tolerance_px(scale * sigma_px)
        inliers = affine_inliers(position, displacement, candidates, tolerance_px)
        if inliers.sum() < MIN_FOR_SCATTER:
            break
        scatter_px = _scatter_px(position, displacement, inliers, candidates, 4.0 * tolerance_px)
        if scatter_px <= 1.1 * scale * sigma_px:
            break
        scale = scatter_px / sigma_px
    return inliers, scale


def affine_inliers(
    position: Array, displacement: Array, candidates: BoolArray, tolerance: float
) -> BoolArray:
    """Measures that fit one affine displacement field.

    Source: Barath et al. (2019), MAGSAC, as implemented by OpenCV.

    Args:
        position: (n, 2) pixels.
        displacement: (n, 2) pixels.
        candidates: (n,) measures to consider; fewer than `MIN_FOR_AFFINE` are returned unchanged.
        tolerance: distance beyond which a measure is certainly wrong, pixels.

    Returns:
        (n,) a subset of `candidates`.
    """
    rows = np.flatnonzero(candidates)
    if len(rows) < MIN_FOR_AFFINE:
        return candidates
    matrix, inside = cv2.estimateAffine2D(
        position[rows],
        position[rows] + displacement[rows],
        method=cv2.USAC_MAGSAC,
        ransacReprojThreshold=tolerance,
        maxIters=5000,
        confidence=0.9999,
    )
    inliers = np.zeros(len(position), dtype=bool)
    if matrix is not None:
        inliers[rows[inside.ravel().astype(bool)]] = True
    return inliers


def _scatter_px(
    position: Array, displacement: Array, inliers: BoolArray, candidates: BoolArray, reach_px: float
) -> float:
    """Robust standard deviation per coordinate of the candidates around the affine of the inliers.

    Candidates farther than `reach_px` from the affine are outliers and do not count.
    """
    design = np.column_stack([np.ones(len(position)), position])
    affine = np.linalg.lstsq(design[inliers], displacement[inliers], rcond=None)[0]
    distance = np.hypot(*(displacement - design @ affine)[candidates].T)
    return float(np.median(distance[distance <= reach_px]) / MEDIAN_DISTANCE)
