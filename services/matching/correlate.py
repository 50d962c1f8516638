"""A chip found in the scene: normalised correlation, then least squares for the place and its sigma."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from services.matching.least_squares import covariance_from_influence, fit_chip
from services.matching.shadows import ShadowShift, shadow_weights
from services.types import Array, FloatImage

FOUND = ""

INTERPOLATION_SIGMA_PX = 0.003
"""What is left of an error where there is no noise at all."""

_BLOCKED = -1.0
"""Score of places that cannot be judged."""

_SUBPIXEL_LOSS = 0.1
"""How much of its score a chip may lose half a pixel beside its place."""


@dataclass(frozen=True)
class CorrelationOptions:
    """When a correlation peak is believed.

    Attributes:
        min_score: normalised correlation below which a chip is not found (SRP's published example).
        max_second: a second peak above this fraction of the first makes the place ambiguous.
        second_distance_px: how far from the first a second peak begins.
        min_contrast: standard deviation over mean below which a chip is flat.
        max_sigma_px: a place known worse than this, along any direction, is ambiguous, chip pixels.
    """

    min_score: float = 0.8
    max_second: float = 0.9
    second_distance_px: int = 6
    min_contrast: float = 0.01
    max_sigma_px: float = 1.0


@dataclass(frozen=True)
class Peak:
    """Where a chip was found in a patch, or why it was not.

    Attributes:
        row_col: (2,) displacement of the chip from the centre of the patch, chip pixels.
        score: normalised correlation at the peak.
        sigma_px: one standard deviation a coordinate, chip pixels.
        influence: (c, c, 2) of the squares of the chip on its place; see `least_squares.Fit`.
        reason: `FOUND`, or why the peak is not believed: "flat", "nodata", "low_score",
            "border_peak", "ambiguous".
    """

    row_col: Array
    score: float
    sigma_px: float
    influence: Array
    reason: str


def _rejected(reason: str, score: float = math.nan) -> Peak:
    return Peak(np.full(2, np.nan), score, math.nan, np.zeros((0, 0, 2)), reason)


def find_chip(
    patch: FloatImage,
    chip: FloatImage,
    options: CorrelationOptions,
    shadows: ShadowShift | None = None,
) -> Peak:
    """Find a chip in a larger patch of the same geometry.

    Zero-mean normalised correlation in float32 finds the pixel, least squares its fraction.

    Args:
        patch: (s + 2 r, s + 2 r); NaN where there is nothing to see.
        chip: (s, s); NaN where nodata.
        options: thresholds.
        shadows: how they have moved from the chip to the patch, where that is known.
    """
    if not np.isfinite(chip).all():
        return _rejected("nodata")
    mean, spread = (float(value[0, 0]) for value in cv2.meanStdDev(chip))
    if spread < options.min_contrast * abs(mean) or spread == 0.0:
        return _rejected("flat")
    scores = correlation_map(patch, chip)
    if scores is None:
        return _rejected("nodata")
    row, col = (int(v) for v in np.unravel_index(int(np.argmax(scores)), scores.shape))
    score = float(scores[row, col])
    if score < options.min_score - _SUBPIXEL_LOSS:
        return _rejected("low_score", score)
    if row in (0, scores.shape[0] - 1) or col in (0, scores.shape[1] - 1):
        return _rejected("border_peak", score)
    if scores[row - 1 : row + 2, col - 1 : col + 2].min() <= _BLOCKED:
        return _rejected("border_peak", score)
    if _second_peak(scores, row, col, options.second_distance_px) > options.max_second * score:
        return _rejected("ambiguous" if score >= options.min_score else "low_score", score)
    return refine_peak(patch, chip, np.array([row, col], dtype=np.float64), score, options, shadows)


def refine_peak(
    patch: FloatImage,
    chip: FloatImage,
    start: Array,
    score: float,
    options: CorrelationOptions,
    shadows: ShadowShift | None = None,
) -> Peak:
    """The place of a chip whose pixel is known.

    Args:
        patch, chip, shadows: as in `find_chip`.
        start: (2,) row and column of the chip's first pixel in the patch.
        score: normalised correlation there.
        options: thresholds.
    """
    weight = None if shadows is None else shadow_weights(chip, score, shadows)
    fit = fit_chip(patch, chip, start, weight=weight)
    score = score if fit is None else max(score, fit.score)
    if score < options.min_score:
        return _rejected("low_score", score)
    if fit is None:
        return _rejected("ambiguous", score)
    covariance = covariance_from_influence(fit.influence)
    if not math.sqrt(max(np.linalg.eigvalsh(covariance)[1], 0.0)) <= options.max_sigma_px:
        return _rejected("ambiguous", score)
    centre = (np.array(patch.shape) - chip.shape[0]) / 2.0
    return Peak(fit.row_col - centre, score, sigma_per_coordinate(covariance), fit.influence, FOUND)


def sigma_per_coordinate(covariance: Array) -> float:
    """One standard deviation a coordinate (root mean square over both), pixels."""
    return math.hypot(math.sqrt(np.trace(covariance) / 2.0), INTERPOLATION_SIGMA_PX)


def correlation_map(patch: FloatImage, chip: FloatImage) -> FloatImage | None:
    """Normalised correlation of a chip at every place of a patch it fits in wholly.

    Returns:
        (2 r + 1, 2 r + 1), -1 where the patch has no data under the chip; None when that is everywhere.
    """
    missing = ~np.isfinite(patch)
    if not missing.any():
        return np.asarray(cv2.matchTemplate(patch, chip, cv2.TM_CCOEFF_NORMED))
    if missing.all():
        return None
    filled = np.where(missing, np.float32(np.nanmean(patch)), patch)
    scores = cv2.matchTemplate(filled, chip, cv2.TM_CCOEFF_NORMED)
    count = cv2.integral(missing.astype(np.uint8))
    lines, samples = chip.shape
    covered = (
        count[lines:, samples:]
        - count[:-lines, samples:]
        - count[lines:, :-samples]
        + count[:-lines, :-samples]
    )
    blocked = covered > 0
    return None if blocked.all() else np.where(blocked, np.float32(_BLOCKED), scores)


def _second_peak(scores: FloatImage, row: int, col: int, distance: int) -> float:
    """Largest score at least `distance` away from the peak; -1 when the map ends before."""
    kept = scores.copy()
    kept[max(0, row - distance) : row + distance + 1, max(0, col - distance) : col + distance + 1] = -1.0
    return float(kept.max())
