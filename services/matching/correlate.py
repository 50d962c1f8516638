"""A chip found in the scene: normalised correlation, its peak to a fraction of a pixel, its sigma."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from services.types import Array, FloatImage

FOUND = ""

_BLOCKED = -1.0
"""Score of places that cannot be judged."""


@dataclass(frozen=True)
class CorrelationOptions:
    """When a correlation peak is believed.

    Attributes:
        min_score: normalised correlation below which a chip is not found (SRP's published example).
        max_second: a second peak above this fraction of the first makes the place ambiguous.
        second_distance_px: how far from the first a second peak begins.
        min_contrast: standard deviation over mean below which a chip is flat.
    """

    min_score: float = 0.8
    max_second: float = 0.9
    second_distance_px: int = 6
    min_contrast: float = 0.01


@dataclass(frozen=True)
class Peak:
    """Where a chip was found in a patch, or why it was not.

    Attributes:
        row_col: (2,) displacement of the chip from the centre of the patch, chip pixels.
        score: normalised correlation at the peak.
        sigma_px: one standard deviation a coordinate, chip pixels.
        reason: `FOUND`, or why the peak is not believed: "flat", "nodata", "low_score",
            "border_peak", "ambiguous".
    """

    row_col: Array
    score: float
    sigma_px: float
    reason: str


def _rejected(reason: str, score: float = math.nan) -> Peak:
    return Peak(np.full(2, np.nan), score, math.nan, reason)


def find_chip(patch: FloatImage, chip: FloatImage, options: CorrelationOptions) -> Peak:
    """Find a chip in a larger patch of the same geometry.

    Zero-mean normalised correlation in float32; a quadratic surface through the nine values round the
    peak gives the fraction of a pixel.

    Args:
        patch: (s + 2 r, s + 2 r); NaN where there is nothing to see.
        chip: (s, s); NaN where nodata.
        options: thresholds.
    """
    if not np.isfinite(chip).all():
        return _rejected("nodata")
    mean, spread = (float(value[0, 0]) for value in cv2.meanStdDev(chip))
    if spread < options.min_contrast * abs(mean) or spread == 0.0:
        return _rejected("flat")
    scores = correlation_map(patch, chip)
    if scores is None:
        return _rejected("nodata")
    row, col = np.unravel_index(int(np.argmax(scores)), scores.shape)
    score = float(scores[row, col])
    if score < options.min_score:
        return _rejected("low_score", score)
    if row in (0, scores.shape[0] - 1) or col in (0, scores.shape[1] - 1):
        return _rejected("border_peak", score)
    around = scores[row - 1 : row + 2, col - 1 : col + 2].astype(np.float64)
    if around.min() <= _BLOCKED:
        return _rejected("border_peak", score)
    if _second_peak(scores, int(row), int(col), options.second_distance_px) > options.max_second * score:
        return _rejected("ambiguous", score)
    offset, curvature = _quadratic_peak(around)
    if curvature <= 0.0 or np.abs(offset).max() > 1.0:
        return _rejected("ambiguous", score)
    centre = (np.array(scores.shape) - 1) / 2.0
    return Peak(
        np.array([row, col]) + offset - centre, score, _peak_sigma(score, curvature, chip.size), FOUND
    )


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


_GRID = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], indexing="ij"), axis=-1).reshape(9, 2)
_QUADRATIC = np.linalg.pinv(
    np.column_stack(
        [np.ones(9), _GRID, _GRID[:, 0] ** 2 / 2.0, _GRID[:, 1] ** 2 / 2.0, _GRID[:, 0] * _GRID[:, 1]]
    )
)


def _quadratic_peak(around: Array) -> tuple[Array, float]:
    """Offset of the top of a quadratic through 3 x 3 scores, and its smaller curvature."""
    _, by_row, by_col, row_row, col_col, row_col = (_QUADRATIC @ around.ravel()).tolist()
    curvature = -(row_row + col_col) / 2.0 - math.hypot((row_row - col_col) / 2.0, row_col)
    if curvature <= 0.0:
        return np.zeros(2), curvature
    determinant = row_row * col_col - row_col * row_col
    offset = row_col * by_col - col_col * by_row, row_col * by_row - row_row * by_col
    return np.array(offset) / determinant, curvature


def _peak_sigma(score: float, curvature: float, pixels: int) -> float:
    """Standard deviation of a correlation peak, pixels.

    What chip and scene do not share has a variance of 2 (1 - score) and moves the peak by its square
    root over the slope, `curvature * pixels` independent values of it. It is as smooth as the texture
    itself, whose correlation length is `curvature ** -0.5`, so that pi / curvature pixels count as one.
    """
    return float(np.sqrt(2.0 * np.pi * max(1.0 - score, 1e-4) / pixels) / curvature)
