"""Matching of one chip in a scene: correlation to a pixel, least squares for position and sigma."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from amers.services.imagery.gaps import filled, missing_reason
from amers.services.matching.least_squares import covariance_from_influence, fit_chip
from amers.services.matching.shadows import ShadowShift, shadow_weights
from amers.services.types import Array, BoolArray, FloatImage

FOUND = ""

INTERPOLATION_SIGMA_PX = 0.003
"""Error that remains without any noise: that of the interpolation."""

MAX_MISSING_SHARE = 0.5
"""Largest share of a chip that is missing, in the chip or in the patch under it."""

_BLOCKED = -1.0
"""Score of positions where more of the chip is missing."""

_MIN_VARIANCE = 1e-5
"""Smallest variance of the patch under a chip, over the mean square there: below it lies rounding."""

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
        max_missing_share: largest share of a chip that is missing, in the chip or in the patch under it.
    """

    min_score: float = 0.8
    max_second: float = 0.9
    second_distance_px: int = 6
    min_contrast: float = 0.01
    max_sigma_px: float = 1.0
    max_missing_share: float = MAX_MISSING_SHARE

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
        influence, leverage: (c, c, 2) and (c, c, 2, 2) of the squares of the chip on its position; see
            `least_squares.Fit`.
        reason: `FOUND`, or why the peak is rejected: "flat", "nodata", "saturated", "low_score",
            "border_peak", "ambiguous".
    """

    row_col: Array
    score: float
    sigma_px: float
    influence: Array
    leverage: FloatImage
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

    Zero-mean normalised correlation finds the pixel, least squares the fraction, both over the pixels
    that are valid in patch and chip.

    Args:
        patch: (s + 2 r, s + 2 r); NaN where there is no data, +inf where saturated.
        chip: (s, s); the same.
        options: when a peak is accepted.
        thresholds: scores that replace those of the options, for images other than grey values.
        shadows: shift of the shadows between chip and patch; None when unknown.
    """
    thresholds = thresholds or options.thresholds
    valid, mask = np.isfinite(chip), None
    if not valid.all():
        if valid.mean() < 1.0 - options.max_missing_share:
            return rejected(missing_reason(chip))
        mask = valid.astype(np.uint8)
    mean, spread = (float(value[0, 0]) for value in cv2.meanStdDev(chip, mask=mask))
    if spread < options.min_contrast * abs(mean) or spread == 0.0:
        return rejected("flat")
    scores = correlation_map(patch, chip, options.max_missing_share)
    if scores is None:
        return rejected(missing_reason(patch))
    row, col = (int(v) for v in np.unravel_index(int(np.argmax(scores)), scores.shape))
    score = float(scores[row, col])
    reason = _pixel_rejection(scores, (row, col), thresholds, options.second_distance_px)
    if reason:
        return rejected(reason, score)
    weight = None if shadows is None else shadow_weights(filled(chip), score, shadows)
    fit = fit_chip(patch, chip, np.array([row, col], dtype=np.float64), weight)
    score = score if fit is None else max(score, fit.score)
    if score < thresholds.min_score:
        return rejected("low_score", score)
    if fit is None:
        return rejected("ambiguous", score)
    covariance = covariance_from_influence(fit.influence)
    if not _largest_sigma_px(covariance) <= options.max_sigma_px:
        return rejected("ambiguous", score)
    centre = (np.array(patch.shape) - chip.shape[0]) / 2.0
    sigma_px = sigma_per_coordinate(covariance)
    return Peak(fit.row_col - centre, score, sigma_px, fit.influence, fit.leverage, FOUND)


def rejected(reason: str, score: float = math.nan) -> Peak:
    """A peak that was not accepted, or not searched."""
    nothing = np.zeros((0, 0, 2)), np.zeros((0, 0, 2, 2), dtype=np.float32)
    return Peak(np.full(2, np.nan), score, math.nan, *nothing, reason)


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


def _largest_sigma_px(covariance: Array) -> float:
    """Largest standard deviation in any direction, of a covariance (2, 2)."""
    mean, difference = np.trace(covariance) / 2.0, (covariance[0, 0] - covariance[1, 1]) / 2.0
    return math.sqrt(max(mean + math.hypot(difference, covariance[0, 1]), 0.0))


def sigma_per_coordinate(covariance: Array) -> float:
    """One standard deviation per coordinate, pixels: root mean square over both, and interpolation."""
    return math.hypot(math.sqrt(np.trace(covariance) / 2.0), INTERPOLATION_SIGMA_PX)


def correlation_map(
    patch: FloatImage, chip: FloatImage, max_missing_share: float = MAX_MISSING_SHARE
) -> FloatImage | None:
    """Normalised correlation of a chip at every position of a patch that it fits in completely.

    Returns:
        (2 r + 1, 2 r + 1), -1 where more than the largest share of the chip is missing; None when that
        holds everywhere.
    """
    seen, valid = np.isfinite(patch), np.isfinite(chip)
    if seen.all() and valid.all():
        return np.asarray(cv2.matchTemplate(patch, chip, cv2.TM_CCOEFF_NORMED))
    if not valid.any():
        return None
    # Of a scene's border, what is within reach of chips that show enough.
    lines = _reached(np.asarray(seen.any(axis=1)), chip.shape[0], max_missing_share)
    samples = _reached(np.asarray(seen.any(axis=0)), chip.shape[1], max_missing_share)
    part = patch[lines, samples]
    if part.shape[0] < chip.shape[0] or part.shape[1] < chip.shape[1]:
        return None
    scores, common = _masked_correlation(part, seen[lines, samples], chip, valid)
    blocked = common < (1.0 - max_missing_share) * chip.size - 0.5
    if blocked.all():
        return None
    rows, columns = np.array(patch.shape) - chip.shape + 1
    whole = np.full((rows, columns), _BLOCKED, dtype=np.float32)
    filled_lines = slice(lines.start, lines.start + scores.shape[0])
    filled_samples = slice(samples.start, samples.start + scores.shape[1])
    whole[filled_lines, filled_samples] = np.where(blocked, np.float32(_BLOCKED), scores)
    return whole


def _reached(seen: BoolArray, length: int, max_missing_share: float) -> slice:
    """The part of lines or samples (n,) that chips reach of which no larger share is missing."""
    rows = np.flatnonzero(seen)
    if not len(rows):
        return slice(0, 0)
    beyond = int(max_missing_share * length) + 1
    return slice(max(0, int(rows[0]) - beyond), int(rows[-1]) + 1 + beyond)


def _masked_correlation(
    patch: FloatImage, seen: BoolArray, chip: FloatImage, valid: BoolArray
) -> tuple[FloatImage, FloatImage]:
    """Normalised correlation over the pixels valid in patch and chip, and the number of these.

    Source: Padfield (2012), Masked object registration in the Fourier domain. The sums are those of
    `cv2.matchTemplate`, after a mean is removed so that float32 is precise enough for them.
    """
    p = np.where(seen, patch - _mean_of(patch, seen), np.float32(0.0))
    c = np.where(valid, chip - _mean_of(chip, valid), np.float32(0.0))
    p_mask, c_mask = seen.astype(np.float32), valid.astype(np.float32)

    def sums(image: FloatImage, template: FloatImage) -> Array:
        if template is c_mask and valid.all():
            return _sums_under(image, chip.shape)
        return np.asarray(cv2.matchTemplate(image, template, cv2.TM_CCORR), dtype=np.float64)

    n = np.maximum(sums(p_mask, c_mask), 1.0)
    p_sum, p_square = sums(p, c_mask), sums(p * p, c_mask)
    c_sum, c_square = sums(p_mask, c), sums(p_mask, c * c)
    p_variance, c_variance = p_square - p_sum**2 / n, c_square - c_sum**2 / n
    distinct = (p_variance > _MIN_VARIANCE * p_square) & (c_variance > _MIN_VARIANCE * c_square)
    covariance = sums(p, c) - p_sum * c_sum / n
    scores = covariance / np.sqrt(np.where(distinct, p_variance * c_variance, np.inf))
    return np.clip(scores, -1.0, 1.0).astype(np.float32), n.astype(np.float32)


def _mean_of(pixels: FloatImage, valid: BoolArray) -> np.float32:
    return np.float32(pixels[valid].mean(dtype=np.float64))


def _sums_under(image: FloatImage, shape: tuple[int, ...]) -> Array:
    """Sums of an image over a window of a shape, at all positions."""
    lines, samples = shape
    total = cv2.integral(image, sdepth=cv2.CV_64F)
    below = total[lines:] - total[:-lines]
    return np.asarray(below[:, samples:] - below[:, :-samples])


def _second_peak(scores: FloatImage, row: int, col: int, distance: int) -> float:
    """Largest score farther than `distance` from the peak; -1 when the map does not reach so far."""
    others = scores.copy()
    others[
        max(0, row - distance) : row + distance + 1, max(0, col - distance) : col + distance + 1
    ] = -1.0
    return float(others.max())
