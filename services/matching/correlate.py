"""A chip found in a scene: correlation for the pixel, least squares for the position and its sigma."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from services.matching.least_squares import covariance_from_influence, fit_chip
from services.matching.shadows import ShadowShift, shadow_weights
from services.types import Array, FloatImage

FOUND = ""

INTERPOLATION_SIGMA_PX = 0.003
"""Error that remains without any noise: that of the interpolation."""

_BLOCKED = -1.0
"""Score of positions where the patch lacks data under the chip."""

_SUBPIXEL_LOSS = 0.1
"""Largest loss of score by a displacement of half a pixel; peaks less than this below `min_score` are
refined."""


@dataclass(frozen=True)
class PeakThresholds:
    """Scores at which a correlation peak is accepted.

    Attributes:
        min_score: smallest normalised correlation.
        max_second: largest ratio of the second peak to the first.
    """

    min_score: float
    max_second: float


@dataclass(frozen=True)
class CorrelationOptions:
    """When a correlation peak is accepted.

    Attributes:
        min_score: smallest normalised correlation of a chip that is found (SRP's published example).
        max_second: largest ratio of the second peak to the first; above it the position is ambiguous.
        second_distance_px: smallest distance between the first and the second peak.
        min_contrast: smallest standard deviation over mean; below it a chip is flat.
        max_sigma_px: largest sigma along any direction, chip pixels; above it the position is ambiguous.
    """

    min_score: float = 0.8
    max_second: float = 0.9
    second_distance_px: int = 6
    min_contrast: float = 0.01
    max_sigma_px: float = 1.0

    @property
    def thresholds(self) -> PeakThresholds:
        """The scores at which a peak of grey values is accepted."""
        return PeakThresholds(self.min_score, self.max_second)


@dataclass(frozen=True)
class Peak:
    """Where a chip was found in a patch, or why it was not.

    Attributes:
        row_col: (2,) displacement of the chip from the centre of the patch, chip pixels.
        score: normalised correlation at the peak.
        sigma_px: one standard deviation a coordinate, chip pixels.
        influence: (c, c, 2) of the squares of the chip on its position; see `least_squares.Fit`.
        reason: `FOUND`, or why the peak is rejected: "flat", "nodata", "low_score", "border_peak",
            "ambiguous".
    """

    row_col: Array
    score: float
    sigma_px: float
    influence: Array
    reason: str


def find_chip(
    patch: FloatImage,
    chip: FloatImage,
    options: CorrelationOptions,
    *,
    thresholds: PeakThresholds | None = None,
    shadows: ShadowShift | None = None,
) -> Peak:
    """Position of a chip in a larger patch of the same geometry.

    Zero-mean normalised correlation in float32 finds the pixel, least squares the fraction.

    Args:
        patch: (s + 2 r, s + 2 r); NaN where there is no data.
        chip: (s, s); NaN where nodata.
        options: when a peak is accepted.
        thresholds: scores that replace those of the options, for images other than grey values.
        shadows: shift of the shadows between chip and patch; None when unknown.
    """
    thresholds = thresholds or options.thresholds
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
    reason = _pixel_rejection(scores, (row, col), thresholds, options.second_distance_px)
    if reason:
        return _rejected(reason, score)
    weight = None if shadows is None else shadow_weights(chip, score, shadows)
    fit = fit_chip(patch, chip, np.array([row, col], dtype=np.float64), weight)
    score = score if fit is None else max(score, fit.score)
    if score < thresholds.min_score:
        return _rejected("low_score", score)
    if fit is None:
        return _rejected("ambiguous", score)
    covariance = covariance_from_influence(fit.influence)
    if not math.sqrt(max(np.linalg.eigvalsh(covariance)[1], 0.0)) <= options.max_sigma_px:
        return _rejected("ambiguous", score)
    centre = (np.array(patch.shape) - chip.shape[0]) / 2.0
    return Peak(fit.row_col - centre, score, sigma_per_coordinate(covariance), fit.influence, FOUND)


def _rejected(reason: str, score: float = math.nan) -> Peak:
    return Peak(np.full(2, np.nan), score, math.nan, np.zeros((0, 0, 2)), reason)


def _pixel_rejection(
    scores: FloatImage, peak: tuple[int, int], thresholds: PeakThresholds, second_distance_px: int
) -> str:
    """Why the highest pixel of a correlation map is rejected; "" when it is not."""
    row, col = peak
    score = float(scores[row, col])
    if score < thresholds.min_score - _SUBPIXEL_LOSS:
        return "low_score"
    if row in (0, scores.shape[0] - 1) or col in (0, scores.shape[1] - 1):
        return "border_peak"
    if scores[row - 1 : row + 2, col - 1 : col + 2].min() <= _BLOCKED:
        return "border_peak"
    if _second_peak(scores, row, col, second_distance_px) > thresholds.max_second * score:
        return "ambiguous" if score >= thresholds.min_score else "low_score"
    return ""


def sigma_per_coordinate(covariance: Array) -> float:
    """One standard deviation per coordinate, pixels: root mean square over both, and interpolation."""
    return math.hypot(math.sqrt(np.trace(covariance) / 2.0), INTERPOLATION_SIGMA_PX)


def correlation_map(patch: FloatImage, chip: FloatImage) -> FloatImage | None:
    """Normalised correlation of a chip at every position of a patch that it fits in completely.

    Returns:
        (2 r + 1, 2 r + 1), -1 where the patch lacks data under the chip; None when it does everywhere.
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
    """Largest score farther than `distance` from the peak; -1 when the map does not reach so far."""
    others = scores.copy()
    others[
        max(0, row - distance) : row + distance + 1, max(0, col - distance) : col + distance + 1
    ] = -1.0
    return float(others.max())
