"""Changed radiometry: gradients for inverted contrast, and the detection of clouds."""

from collections.abc import Sequence

import cv2
import numpy as np

from services.imagery.gaps import LOST_SHARE
from services.types import Array, BoolArray, FloatImage

MIN_FOUND = 5
"""Fewest points found whose surroundings serve as the reference for those of the others."""

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
        (r - 2, c - 2); NaN beside missing pixels.
    """
    with np.errstate(invalid="ignore"):  # between saturated pixels
        down = pixels[2:, 1:-1] - pixels[:-2, 1:-1]
        right = pixels[1:-1, 2:] - pixels[1:-1, :-2]
    return np.asarray(cv2.sqrt(cv2.magnitude(right, down)))


def patch_statistics(pixels: FloatImage) -> Array:
    """Brightness and roughness of the squares of a patch.

    Args:
        pixels: (r, c); NaN where there is no data, +inf where saturated.

    Returns:
        (squares, 2): mean, and mean absolute difference of neighbours, of the valid pixels. Where more
        than half of a square is lost, +inf and 0 when most of that is saturated, else NaN.
    """
    rows, columns = (size // CELL_PX for size in pixels.shape)
    inner = pixels[: rows * CELL_PX, : columns * CELL_PX]
    squares = inner.reshape(rows, CELL_PX, columns, CELL_PX).transpose(0, 2, 1, 3)
    cells = squares.reshape(rows * columns, CELL_PX, CELL_PX).astype(np.float64)
    valid = np.isfinite(cells)
    if valid.all():
        roughness = np.abs(np.diff(cells, axis=2)).mean(axis=(1, 2))
        return np.column_stack([cells.mean(axis=(1, 2)), roughness])
    statistics = _of_valid_pixels(np.where(valid, cells, 0.0), valid)
    lost = valid.mean(axis=(1, 2)) < 1.0 - LOST_SHARE
    saturated = 2 * np.isposinf(cells).sum(axis=(1, 2)) > (~valid).sum(axis=(1, 2))
    statistics[lost] = np.where(saturated[lost, None], (np.inf, 0.0), np.nan)
    return statistics


def _of_valid_pixels(cells: Array, valid: BoolArray) -> Array:
    """Mean and mean absolute difference of neighbours (n, 2), valid pixels of squares (n, r, c) only."""
    both = valid[:, :, 1:] & valid[:, :, :-1]
    steps = np.abs(np.diff(cells, axis=2)) * both
    sums = np.column_stack([cells.sum(axis=(1, 2)), steps.sum(axis=(1, 2))])
    counts = np.column_stack([valid.sum(axis=(1, 2)), both.sum(axis=(1, 2))])
    return np.asarray(np.where(counts > 0, sums / np.maximum(counts, 1), np.nan))


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
