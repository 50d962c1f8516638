"""Gaps of images: pixels without data (NaN) or saturated (+inf). Small gaps are interpolated.

An output pixel is lost where gaps are more than half of its footprint: NaN where most of them have no
data, +inf where most are saturated. Elsewhere the gaps are filled from the pixels around them.
"""

import cv2
import numpy as np
from numba import njit

from amers.services.types import Array, BoolArray, FloatImage

LOST_SHARE = 0.5
"""Share of gaps in the footprint of a pixel above which the pixel is lost."""

_FOOTPRINT_PX = 0.9
"""Smallest standard deviation of a footprint: a hole of 2 x 2 pixels and a line one pixel wide are less
than half of every footprint, two lines side by side are more."""
_NEIGHBOUR_WEIGHTS = np.exp(-0.5 * (np.arange(5) / 0.8) ** 2)
"""Weights along each axis of the neighbours that fill a gap, by their distance: the nearest count most.
Gaps farther from valid pixels get the mean."""


def bridged(pixels: FloatImage) -> FloatImage:
    """Pixels with their small gaps filled from the neighbours; NaN and +inf where gaps are large."""
    if np.isfinite(pixels).all():
        return pixels
    return filled(pixels) + lost_pixels(pixels)


def filled(pixels: FloatImage) -> FloatImage:
    """Pixels with every gap filled: by the weighted mean of valid neighbours, far from any by the mean.

    Source: Knutsson and Westin (1993), Normalized and differential convolution.
    """
    return np.asarray(_filled(np.ascontiguousarray(pixels), _NEIGHBOUR_WEIGHTS))


def lost_pixels(pixels: FloatImage, footprint_px: float = 0.0) -> FloatImage:
    """What to add to filtered pixels: 0, or NaN and +inf where more than half of the footprint is gaps.

    Args:
        pixels: before the filter.
        footprint_px: standard deviation of the Gaussian filter; that of a footprint is 0.9 at least.
    """
    sigma_px = max(footprint_px, _FOOTPRINT_PX)
    share = _blurred(~np.isfinite(pixels), sigma_px)
    saturated = np.isposinf(pixels)
    lost = np.zeros_like(pixels)
    is_lost = share > LOST_SHARE
    lost[is_lost] = np.nan
    if saturated.any():
        lost[is_lost & (_blurred(saturated, sigma_px) > share / 2.0)] = np.inf
    return lost


def missing_reason(pixels: FloatImage | Array) -> str:
    """Why most invalid pixels are invalid: "saturated" (+inf) or "nodata" (NaN)."""
    saturated = int(np.isposinf(pixels).sum())
    return "saturated" if 2 * saturated > int((~np.isfinite(pixels)).sum()) else "nodata"


def _blurred(where: BoolArray, sigma_px: float) -> FloatImage:
    return np.asarray(cv2.GaussianBlur(where.astype(np.float32), (0, 0), sigma_px))


@njit(cache=True, error_model="numpy")
def _filled(pixels: FloatImage, weights: Array) -> FloatImage:
    lines, samples = pixels.shape
    total, count = 0.0, 0
    has_valid = np.zeros(pixels.shape, dtype=np.bool_)
    for i in range(lines):
        within = 0
        for j in range(-len(weights) + 1, samples):
            ahead = j + len(weights) - 1
            if ahead < samples and np.isfinite(pixels[i, ahead]):
                total += pixels[i, ahead]
                count += 1
                within += 1
            behind = j - len(weights)
            if behind >= 0 and np.isfinite(pixels[i, behind]):
                within -= 1
            if j >= 0:
                has_valid[i, j] = within > 0
    out = pixels.copy()
    for i in range(lines):
        for j in range(samples):
            if not np.isfinite(pixels[i, j]):
                value = _mean_around(pixels, i, j, weights, has_valid) if count else 0.0
                out[i, j] = value if value == value else total / count
    return out


@njit(cache=True, error_model="numpy")
def _mean_around(pixels: FloatImage, i: int, j: int, weights: Array, has_valid: BoolArray) -> float:
    """Weighted mean of the valid pixels around one; NaN without any.

    Args:
        pixels: with gaps.
        i, j: line and sample of the one.
        weights: along each axis, by the distance.
        has_valid: whether pixels of the same line have valid ones around them.
    """
    lines, samples = pixels.shape
    reach = len(weights) - 1
    value, weight = 0.0, 0.0
    for k in range(max(i - reach, 0), min(i + reach + 1, lines)):
        if not has_valid[k, j]:
            continue
        for m in range(max(j - reach, 0), min(j + reach + 1, samples)):
            if np.isfinite(pixels[k, m]):
                w = weights[abs(k - i)] * weights[abs(m - j)]
                value += w * pixels[k, m]
                weight += w
    return value / weight
