"""Changed radiometry: gradients for inverted contrast, and the detection of clouds."""

from collections.abc import Sequence

import cv2
import numpy as np
from numba import njit

from amers.services.imagery.gaps import LOST_SHARE
from amers.services.types import Array, BoolArray, FloatImage

MIN_FOUND = 5
"""Fewest found points: their surroundings are the reference for the surroundings of all others."""

CLOUD_ROUGHNESS = 0.4
"""Largest roughness of a cloud, as a fraction of the median roughness around the points found."""

CLOUD_BRIGHTNESS = 0.9
"""Quantile of the brightness around the points found that a cloud exceeds."""

CLOUD_SHARE = 0.1
"""Smallest share of cloud around a point that hides it: nothing else is as bright, and correlation
follows the brightest part."""

CELL_PX = 10
"""Side of the squares in which brightness and roughness are computed."""


def gradient_image(pixels: FloatImage) -> FloatImage:
    """Square root of the gradient magnitude, without the outermost pixels.

    It depends on where the brightness changes, not on which side is brighter: inverted bands, other
    crops and wet ground leave it unchanged. The square root keeps a few roofs from dominating the
    correlation.

    Args:
        pixels: (r, c); NaN where there is no data.

    Returns:
        (r - 2, c - 2), empty for fewer than 3 pixels a side; NaN beside missing pixels.
    """
    with np.errstate(invalid="ignore"):  # between saturated pixels
        down = pixels[2:, 1:-1] - pixels[:-2, 1:-1]
        right = pixels[1:-1, 2:] - pixels[1:-1, :-2]
    if right.size == 0:
        return right
    return np.asarray(cv2.sqrt(cv2.magnitude(right, down)))


def patch_statistics(pixels: FloatImage) -> Array:
    """Brightness and roughness of the squares of a patch.

    Args:
        pixels: (r, c); NaN where there is no data, +inf where saturated.

    Returns:
        (squares, 2): mean, and mean absolute difference of neighbours, of the valid pixels. Where more
        than half of a square is lost, +inf and 0 when most of that is saturated, else NaN.
    """
    return np.asarray(_statistics(pixels))


@njit(cache=True, error_model="numpy")
def _statistics(pixels: FloatImage) -> Array:
    rows, columns = pixels.shape[0] // CELL_PX, pixels.shape[1] // CELL_PX
    out = np.full((rows * columns, 2), np.nan)
    for square in range(rows * columns):
        first_row, first_column = square // columns * CELL_PX, square % columns * CELL_PX
        total, valid, steps, pairs, saturated = 0.0, 0, 0.0, 0, 0
        for i in range(first_row, first_row + CELL_PX):
            before = np.nan
            for j in range(first_column, first_column + CELL_PX):
                value = np.float64(pixels[i, j])
                if not np.isfinite(value):
                    saturated += value == np.inf
                    before = np.nan
                    continue
                total += value
                valid += 1
                if np.isfinite(before):
                    steps += abs(value - before)
                    pairs += 1
                before = value
        lost = CELL_PX * CELL_PX - valid
        if lost > LOST_SHARE * CELL_PX * CELL_PX:
            if 2 * saturated > lost:
                out[square] = np.inf, 0.0
        else:
            out[square] = total / valid, steps / pairs
    return out


def mark_clouds(reason: np.ndarray, statistics: Sequence[Array]) -> None:
    """Set the reasons (n,) of points that clouds hide; "" is found. See `cloud_mask`.

    A point beyond the border of the scene, or in a saturated area, keeps its own reason.
    """
    clouded = cloud_mask(statistics, reason == "")
    reason[clouded & ~np.isin(reason, ("nodata", "saturated"))] = "cloud"


def cloud_mask(statistics: Sequence[Array], found: BoolArray) -> BoolArray:
    """Which points (n,) clouds hide: not found, and much of their surroundings is bright and smooth.

    A saturated square is both.

    Args:
        statistics: (squares, 2) around each of n points, see `patch_statistics`.
        found: (n,) points that were found. With fewer than `MIN_FOUND` of them the mask is empty.
    """
    hidden = np.zeros(len(found), dtype=bool)
    if found.sum() < MIN_FOUND:
        return hidden
    ground = np.concatenate([of_point for of_point, seen in zip(statistics, found, strict=True) if seen])
    ground = ground[np.isfinite(ground).all(axis=1)]
    if not len(ground):
        return hidden
    min_brightness = np.quantile(ground[:, 0], CLOUD_BRIGHTNESS)
    median_roughness = np.median(ground[:, 1])
    for row in np.flatnonzero(~found).tolist():
        squares = statistics[row][~np.isnan(statistics[row]).any(axis=1)]
        cloud = (squares[:, 0] > min_brightness) & (squares[:, 1] < CLOUD_ROUGHNESS * median_roughness)
        hidden[row] = len(squares) > 0 and cloud.mean() >= CLOUD_SHARE
    return hidden
