"""Ends of shadows: edges that lie elsewhere under another sun, and how little they count for a place."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from services.types import Acquisition, Array, FloatImage

CASTER_M = 6.0
"""How high that is which casts shadows: houses of two floors, small trees."""


@dataclass(frozen=True)
class ShadowShift:
    """How the shadows of a chip lie in the image it is searched in.

    Attributes:
        away: (2,) rows and columns away from the sun of the chip; of any length.
        move_px: (2,) rows and columns by which the end of a shadow of `CASTER_M` moved, chip pixels.
    """

    away: Array
    move_px: Array


def shadow_shift(chip: Acquisition, scene: Acquisition, gsd_m: float) -> ShadowShift | None:
    """How shadows have moved from a chip to a scene; None where one of the suns is not known.

    Args:
        chip: how the image it was cut from was taken.
        scene: how the scene was taken.
        gsd_m: of the chip as it is searched.
    """
    before, after = shadow_vector(chip), shadow_vector(scene)
    if not np.isfinite(before + after).all():
        return None
    return ShadowShift(_rows_cols(before), _rows_cols(after - before) * (CASTER_M / gsd_m))


def shadow_vector(image: Acquisition) -> Array:
    """East and north (2,) by which a metre of height throws its shadow; NaN when unknown."""
    azimuth = np.radians(image.sun_azimuth_deg + 180.0)
    length = np.tan(np.radians(90.0 - image.sun_elevation_deg))
    return np.asarray(length * np.array([np.sin(azimuth), np.cos(azimuth)]))


def shadow_weights(chip: FloatImage, score: float, shadows: ShadowShift) -> FloatImage:
    """How much each pixel of a chip counts for its place: little, where a shadow may have ended.

    Where a chip grows brighter away from its sun, a shadow may end. Under another sun that edge lies
    elsewhere: it differs there by its slope times the move, which counts as noise beside that of all
    pixels (variances add; the weight is that of the noise over their sum). Edges of the other sign, such
    as a roof before its own shadow, stay where they are, and so does their weight; under the same
    sun all have theirs.

    Args:
        chip: (s, s) without NaN.
        score: normalised correlation at the place, which tells the noise of all pixels.
        shadows: how they have moved.

    Returns:
        (s - 2, s - 2), 0 to 1: of the chip without its outermost pixels.
    """
    spread = float(cv2.meanStdDev(chip)[1][0, 0])
    noise = math.sqrt(max(1.0 - score * score, 0.01)) * spread
    # Half of it: differences of neighbours are over two pixels.
    move = np.float32(0.5 / noise) * shadows.move_px.astype(np.float32)
    return _weights(chip, shadows.away.astype(np.float32), move)


def _rows_cols(east_north: Array) -> Array:
    return np.array([-east_north[1], east_north[0]])


@njit(cache=True, fastmath=True)
def _weights(chip: FloatImage, away: FloatImage, move: FloatImage) -> FloatImage:
    side = chip.shape[0] - 2
    one = np.float32(1.0)
    weight = np.empty((side, side), dtype=np.float32)
    away_r, away_c, move_r, move_c = away[0], away[1], move[0], move[1]
    for i in range(side):
        for j in range(side):
            down = chip[i + 2, j + 1] - chip[i, j + 1]
            right = chip[i + 1, j + 2] - chip[i + 1, j]
            changed = down * move_r + right * move_c
            tip = down * away_r + right * away_c > np.float32(0.0)
            weight[i, j] = one / (one + changed * changed) if tip else one
    return weight
