"""Missing pixels of chips and patches: what is missing, and a smooth fill that filters can pass over."""

import cv2
import numpy as np

from services.types import Array, FloatImage

_FILL_SIDES = (3, 7, 15, 31)
"""Sides of the squares whose valid pixels fill a missing one: the smallest that has any."""


def missing_reason(pixels: FloatImage | Array) -> str:
    """Why most invalid pixels are invalid: "saturated" (+inf) or "nodata" (NaN)."""
    saturated = int(np.isposinf(pixels).sum())
    return "saturated" if 2 * saturated > int((~np.isfinite(pixels)).sum()) else "nodata"


def fill_missing(pixels: FloatImage) -> FloatImage:
    """Pixels whose invalid ones are replaced by the mean of the valid ones around them.

    Far from any valid pixel the fill is the mean of all. An image without invalid pixels is returned as
    it is.
    """
    valid = np.isfinite(pixels)
    if valid.all():
        return pixels
    if not valid.any():
        return np.zeros_like(pixels)
    mean = np.float32(pixels[valid].mean(dtype=np.float64))
    share = valid.astype(np.float32)
    value = np.where(valid, pixels - mean, np.float32(0.0))
    filled, empty = value.copy(), ~valid
    for side in _FILL_SIDES:
        shares = cv2.blur(share, (side, side))
        near = empty & (shares > 0.5 / side**2)
        filled[near] = cv2.blur(value, (side, side))[near] / shares[near]
        empty &= ~near
        if not empty.any():
            break
    return np.where(valid, pixels, filled + mean)
