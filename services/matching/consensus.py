"""Outlier rejection: the largest set of consistent displacements, with its a-contrario significance."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.types import Array, BoolArray, IntArray

MEDIAN_DISTANCE = float(np.sqrt(2.0 * np.log(2.0)))
"""Median distance from the centre of a circular normal distribution of unit sigma (1.177)."""

MIN_FOR_SCATTER = 6
"""Fewest inliers around whose affine field the scatter is estimated."""

MIN_FOR_AFFINE = 6
"""Fewest measures from which an affine displacement field is estimated robustly."""

MAX_SCALE_UPDATES = 4

_AFFINE_FREEDOM = 3
"""Measures that an affine field passes through."""

_CELLS = 8
"""Cells along the side of a chip in which the area that chips cover is counted."""


@dataclass(frozen=True)
class Consensus:
    """A set of displacements that agree with each other.

    Attributes:
        inliers: (n,) members of the set.
        displacement: (2,) their mean; NaN without any.
        false_alarms: expected number of sets with as many voters in random displacements; far below 1
            for a significant set.
    """

    inliers: BoolArray
    displacement: Array
    false_alarms: float


@dataclass(frozen=True)
class Voters:
    """Where the chips lie whose displacements are compared.

    Attributes:
        position: (n, 2) centres of the chips.
        side: of a chip, same unit.
    """

    position: Array
    side: float


def a_contrario_consensus(
    displacement: Array, tolerance: float, search: float | Array, voters: Voters | None = None
) -> Consensus:
    """The set of displacements within a tolerance of a common centre with most voters, and its
    significance.

    The background model is a uniform distribution of each displacement over the area of its search.
    Chips that overlap show the same ground and err together: a set has as many voters as chips fit into
    the area that its chips cover. Where overlapping chips differ, each of their displacements is a
    chance of its own for the voter they form.

    Source: Desolneux, Moisan and Morel (2000), Meaningful alignments: the number of false alarms.

    Args:
        displacement: (n, 2); rows with NaN do not take part.
        tolerance: radius within which two displacements agree, in the unit of the displacements.
        search: half side of the square search window, same unit; or (n, 2, 2) the smallest and the
            largest displacement that each could have.
        voters: where the chips lie; None when they are independent.
    """
    rows = np.flatnonzero(np.isfinite(displacement).all(axis=1))
    inliers = np.zeros(len(displacement), dtype=bool)
    if len(rows) == 0:
        return Consensus(inliers, np.full(2, np.nan), 1.0)
    valid = displacement[rows]
    tree = cKDTree(valid)
    best: list[int] = []
    most = 0
    for members in sorted(tree.query_ball_point(valid, tolerance), key=len, reverse=True):
        if len(members) <= most:
            break
        count = _count_voters(rows[members], voters)
        if count > most:
            best, most = members, count
    around = tree.query_ball_point(valid[best].mean(axis=0), tolerance)
    if _count_voters(rows[around], voters) >= most:
        best = around
    inliers[rows[best]] = True
    centre = valid[best].mean(axis=0)
    tried = rows[_reaches(centre, tolerance, search, rows) | inliers[rows]]
    trials, agreeing = _count_voters(tried, voters), _count_voters(rows[best], voters)
    trials = max(trials, agreeing)
    chance = _chance(tolerance, search, tried)[_distinct(displacement[tried], tolerance, tried, voters)]
    probability = min(1.0, float(chance.sum()) / trials)
    false_alarms = len(rows) * float(bdtrc(agreeing - 2, trials - 1, probability))
    return Consensus(inliers, centre, false_alarms)


def _chance(tolerance: float, search: float | Array, rows: IntArray) -> Array:
    """Probability (k,) that a random displacement of each row lies within the tolerance of a place."""
    area = np.pi * tolerance**2
    if not isinstance(search, np.ndarray):
        return np.full(len(rows), min(1.0, area / (2.0 * search) ** 2))
    sides = np.maximum(search[rows, 1] - search[rows, 0], 0.0)
    return np.asarray(area / np.maximum(sides.prod(axis=1), area))


def _reaches(centre: Array, tolerance: float, search: float | Array, rows: IntArray) -> BoolArray:
    """Which searches (k,) reach a displacement."""
    if not isinstance(search, np.ndarray):
        return np.ones(len(rows), dtype=bool)
    low, high = search[rows, 0] - tolerance, search[rows, 1] + tolerance
    return np.asarray(((centre >= low) & (centre <= high)).all(axis=1))


def _distinct(displacement: Array, tolerance: float, rows: IntArray, voters: Voters | None) -> BoolArray:
    """Which displacements (k, 2) differ from those before them that overlapping chips have."""
    distinct = np.ones(len(rows), dtype=bool)
    if voters is None:
        return distinct
    position = voters.position[rows]
    for row in range(1, len(rows)):
        near = np.hypot(*(position[:row] - position[row]).T) < voters.side
        near &= np.hypot(*(displacement[:row] - displacement[row]).T) <= tolerance
        distinct[row] = not (near & distinct[:row]).any()
    return distinct


def _count_voters(rows: IntArray, voters: Voters | None) -> int:
    """Number of chips; those that overlap are counted by the area that they cover together."""
    if voters is None or len(rows) == 0:
        return len(rows)
    corner = np.round(voters.position[rows] / voters.side * _CELLS).astype(np.int64)
    of_chip = np.stack(np.meshgrid(np.arange(_CELLS), np.arange(_CELLS)), axis=-1).reshape(-1, 2)
    covered = (corner - corner.min(axis=0))[:, None] + of_chip
    # As one number each: unique rows take ten times as long.
    width = int(covered[..., 1].max()) + 1
    return len(np.unique(covered[..., 0] * width + covered[..., 1])) // _CELLS**2


def consensus_tolerance_px(sigma_px: float) -> float:
    """Largest distance of an inlier from the consensus: three sigmas and 0.5 px for the model error."""
    return MAX_ERROR_SIGMAS * sigma_px + 0.5


def robust_affine_inliers(
    position: Array,
    displacement: Array,
    candidates: BoolArray,
    sigma_px: float,
    block: IntArray | None = None,
) -> tuple[BoolArray, float]:
    """Measures that fit one affine displacement field, with the scale of their observed scatter.

    The frames of blocks differ by offsets that exceed the scatter of points: those of a block that agree
    on an offset against the largest block fit the field with this offset.

    Points worse than declared scatter beyond a tolerance taken from the declared sigma. Cutting them off
    there would leave a set that looks as good as declared. So the tolerance is widened until it matches
    the scatter of all candidates near the field.

    Args:
        position, displacement: (n, 2) pixels.
        candidates: (n,) measures to consider.
        sigma_px: declared standard deviation of a measure relative to its point.
        block: (n,) block that each point comes from; None when all come from one.

    Returns:
        Inliers (n,), and the ratio of their observed scatter to the declared sigma, at least 1.
    """
    if block is not None:
        displacement = _without_offsets(position, displacement, candidates, sigma_px, block)
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


def _without_offsets(
    position: Array, displacement: Array, candidates: BoolArray, sigma_px: float, block: IntArray
) -> Array:
    """Displacements (n, 2) less the offset of each block against the largest.

    An offset is removed where half of the candidates of its block, and enough for an affine, agree on it
    within the tolerance of the largest block.
    """
    blocks, counts = np.unique(block[candidates], return_counts=True)
    if len(blocks) < 2:
        return displacement
    largest = candidates & (block == blocks[counts.argmax()])
    inliers, scale = robust_affine_inliers(position, displacement, largest, sigma_px)
    residual = displacement - _affine_field(position, displacement, inliers)
    without = displacement.copy()
    for number in blocks[counts >= MIN_FOR_AFFINE]:
        of_block = residual[candidates & (block == number)]
        offset = np.median(of_block, axis=0)
        agreeing = np.hypot(*(of_block - offset).T) <= consensus_tolerance_px(scale * sigma_px)
        if agreeing.sum() >= max(MIN_FOR_AFFINE, len(of_block) / 2.0):
            without[block == number] -= offset
    return without


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
    misfit = displacement - _affine_field(position, displacement, inliers)
    distance = np.hypot(*misfit[candidates].T)
    near = distance[distance <= reach_px]
    # An affine field of a few measures passes through them.
    freedom = max(1.0 - _AFFINE_FREEDOM / len(near), 1.0 / len(near))
    return float(np.median(near) / MEDIAN_DISTANCE / np.sqrt(freedom))


def _affine_field(position: Array, displacement: Array, inliers: BoolArray) -> Array:
    """Displacements (n, 2) of the affine field of the inliers."""
    design = np.column_stack([np.ones(len(position)), position])
    return np.asarray(design @ np.linalg.lstsq(design[inliers], displacement[inliers], rcond=None)[0])
