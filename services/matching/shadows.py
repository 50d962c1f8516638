"""Shadows that differ between a chip and a scene, and the weights that reduce their effect."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from amers.services.types import Acquisition, Array, FloatImage

CASTER_M = 6.0
"""Assumed height of the objects that cast shadows: houses of two floors, small trees."""


@dataclass(frozen=True)
class ShadowShift:
    """How the shadows of a chip differ from those of the image it is searched in.

    Attributes:
        away: (2,) rows and columns, the direction away from the sun of the chip; of any length.
        shift_px: (2,) rows and columns from the end of the shadow of an object of `CASTER_M` in the chip
            to its end in the image, chip pixels.
    """

    away: Array
    shift_px: Array


def shadow_shift(chip: Acquisition, scene: Acquisition, gsd_m: float) -> ShadowShift | None:
    """Shift of the shadows from a chip to a scene; None where the sun of one is unknown.

    Args:
        chip: acquisition of the image that the chip was cut from.
        scene: acquisition of the scene.
        gsd_m: ground sampling of the chip as it is searched, metres.
    """
    before, after = shadow_vector(chip), shadow_vector(scene)
    if not np.isfinite(before + after).all():
        return None
    return ShadowShift(_rows_cols(before), _rows_cols(after - before) * (CASTER_M / gsd_m))


def shadow_vector(image: Acquisition) -> Array:
    """East and north (2,) of the shadow of an object of unit height; NaN without a known sun."""
    azimuth = np.radians(image.sun_azimuth_deg + 180.0)
    length = (
        np.tan(np.radians(90.0 - image.sun_elevation_deg)) if image.sun_elevation_deg > 0.0 else np.nan
    )
    return np.asarray(length * np.array([np.sin(azimuth), np.cos(azimuth)]))


def shadow_weights(chip: FloatImage, score: float, shadows: ShadowShift) -> FloatImage:
    """Weight of each pixel of a chip in its position: small where a shadow may end.

    A shadow may end where the brightness of a chip grows away from its sun. Under another sun this
    gradient lies elsewhere. The grey values then differ by the gradient times the shift, which counts as
    noise in addition to that of all pixels: variances add, and the weight is the ratio of the noise to
    the sum. Gradients of the other sign, such as that of a roof before its own shadow, do not move and
    keep their weight. Under the same sun all pixels have the weight 1.

    Args:
        chip: (s, s) without NaN.
        score: normalised correlation at the position, from which the noise of all pixels follows.
        shadows: their shift.

    Returns:
        (s - 2, s - 2), 0 to 1: of the chip without its outermost pixels.
    """
    spread = float(cv2.meanStdDev(chip)[1][0, 0])
    noise = math.sqrt(max(1.0 - score * score, 0.01)) * spread
    # The factor 0.5: the kernel takes differences over two pixels.
    shift = np.float32(0.5 / noise) * shadows.shift_px.astype(np.float32)
    return _weights(chip, shadows.away.astype(np.float32), shift)


def _rows_cols(east_north: Array) -> Array:
    return np.array([-east_north[1], east_north[0]])


@njit(cache=True, fastmath=True)
def _weights(chip: FloatImage, away: FloatImage, shift: FloatImage) -> FloatImage:
    side = chip.shape[0] - 2
    one = np.float32(1.0)
    weight = np.empty((side, side), dtype=np.float32)
    away_r, away_c, shift_r, shift_c = away[0], away[1], shift[0], shift[1]
    for i in range(side):
        for j in range(side):
            down = chip[i + 2, j + 1] - chip[i, j + 1]
            right = chip[i + 1, j + 2] - chip[i + 1, j]
            change = down * shift_r + right * shift_c
            may_end = down * away_r + right * away_c > np.float32(0.0)
            weight[i, j] = one / (one + change * change) if may_end else one
    return weight
