"""Ground that does not look as it did: edges where contrast has changed, clouds over the rest."""

import cv2
import numpy as np

from services.types import Array, BoolArray, FloatImage

ENOUGH_FOUND = 5
"""From so many points found on, others can be compared with them."""

CLOUD_ROUGHNESS = 0.4
"""A cloud is at most so rough as the ground of points that were found."""


def edges(pixels: FloatImage) -> FloatImage:
    """Root of the length of the gradient, without the outermost pixels.

    It keeps where things end, not which side is brighter: inverted bands, other crops and wet ground
    have the same. The root keeps a few roofs from deciding alone.

    Args:
        pixels: (r, c); what is beside a NaN is one.

    Returns:
        (r - 2, c - 2).
    """
    down = pixels[2:, 1:-1] - pixels[:-2, 1:-1]
    right = pixels[1:-1, 2:] - pixels[1:-1, :-2]
    return np.asarray(cv2.sqrt(cv2.magnitude(right, down)))


def brightness_and_roughness(pixels: FloatImage) -> tuple[float, float]:
    """Mean of the pixels, and mean difference of neighbours; NaN where there are none."""
    step = np.abs(pixels[:, 1:] - pixels[:, :-1])
    seen = np.isfinite(step)
    if not seen.any():
        return float("nan"), float("nan")
    return float(np.nanmean(pixels)), float(step[seen].mean())


def clouded(looks: Array, found: BoolArray) -> BoolArray:
    """Which points lie under a cloud: not found, brighter than most that were, and much smoother.

    Args:
        looks: (n, 2) brightness and roughness around each point; NaN where nothing was seen.
        found: (n,) points that were found. With fewer than `ENOUGH_FOUND` nothing is called a cloud.
    """
    if found.sum() < ENOUGH_FOUND:
        return np.zeros(len(found), dtype=bool)
    bright, rough = np.nanmedian(looks[found], axis=0)
    return np.asarray(~found & (looks[:, 0] > bright) & (looks[:, 1] < CLOUD_ROUGHNESS * rough))
