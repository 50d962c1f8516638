"""Least-squares matching: a chip laid on a patch to a fraction of a pixel, and what noise did to it."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from services.imagery.resampling import SPLINE_REACH_PX, spline_coefficients, spline_weights
from services.types import Array, FloatImage

MAX_STEPS = 12
STEP_PX = 2e-3
"""A step this small ends the search."""

CELL_PX = 4
"""Side of the squares of the chip over which influences are summed."""

REACH_CELLS = 5
"""Squares this far apart have nothing to do with each other; fewer in a small chip."""


_SUMS = {"reassoc", "contract", "nsz", "arcp"}
"""What the compiler may do to sums to fill vector registers; NaN and infinity stay what they are."""


@dataclass(frozen=True)
class Fit:
    """A chip laid on a patch.

    Attributes:
        row_col: (2,) where the chip's first pixel lies in the patch, pixels.
        score: normalised correlation there.
        influence: (c, c, 2) by how much what chip and patch do not share in each square of the chip has
            moved the place, rows and columns; their sum is zero.
    """

    row_col: Array
    score: float
    influence: Array


def fit_chip(
    patch: FloatImage,
    chip: FloatImage,
    start: Array,
    reach_px: float = 1.5,
    weight: FloatImage | None = None,
) -> Fit | None:
    """Lay a chip on a patch by least squares: two displacements, a gain and an offset.

    Gauss-Newton with the gradients of the chip, which stay, so that a step costs one interpolation of
    the patch. Where it ends, the chip's gradients are orthogonal to what is left: noise does not
    move the place but by chance.

    Source: Gruen (1985), Adaptive least squares correlation; Baker and Matthews (2004), Lucas-Kanade 20
    years on, for the direction of the linearisation.

    Args:
        patch: larger than the chip; NaN where there is nothing.
        chip: (s, s) without NaN.
        start: (2,) row and column of the chip's first pixel in the patch, to a pixel or so.
        reach_px: how far from there the place may be.
        weight: (s - 2, s - 2) of the chip's pixels without the outermost; all alike when None.

    Returns:
        None where there is no such place, or the patch has nothing beside it.
    """
    margin = SPLINE_REACH_PX + int(np.ceil(reach_px))
    first = np.maximum(np.floor(start).astype(int) - margin, 0)
    last = np.minimum(np.ceil(start).astype(int) + chip.shape[0] + margin, patch.shape)
    coefficients = spline_coefficients(patch[first[0] : last[0], first[1] : last[1]])
    if weight is None:
        weight = np.ones((chip.shape[0] - 2, chip.shape[1] - 2), dtype=np.float32)
    row, col, score, influence = _fit(
        coefficients, chip, weight, float(start[0] - first[0]), float(start[1] - first[1]), reach_px
    )
    if not np.isfinite(score):
        return None
    return Fit(first + np.array([row, col]), score, influence)


def covariance_from_influence(influence: Array) -> Array:
    """Covariance (2, 2) of a place from the influences of the squares of its chip.

    What chip and patch do not share is rarely white: it is as smooth as the land, and sits where
    shadows and roofs are. So neighbouring squares count as they vary together, up to some distance
    and less with it (a sandwich with Bartlett's weights).

    Source: Newey and West (1987), in two dimensions as in Conley (1999).

    Args:
        influence: (c, c, 2) summing to zero.
    """
    cells = len(influence)
    reach = min(REACH_CELLS, max(1, cells // 5))
    covariance = np.zeros((2, 2))
    _bartlett(np.ascontiguousarray(influence), reach, covariance)
    # Influences that sum to zero vary less than those they stand for.
    return covariance / (1.0 - (reach / cells) ** 2)


@njit(cache=True, error_model="numpy")
def _fit(
    coefficients: FloatImage,
    chip: FloatImage,
    weight: FloatImage,
    row: float,
    col: float,
    reach_px: float,
) -> tuple[float, float, float, Array]:
    side = chip.shape[0] - 2
    lines, samples = coefficients.shape
    gradients, inverse = _design(chip, weight)
    at = np.empty((side, side), dtype=np.float32)
    failed = (np.nan, np.nan, np.nan, np.zeros((1, 1, 2)))
    r, c = row, col
    for _ in range(MAX_STEPS):
        if r < 0.0 or c < 0.0 or r > lines - side - 3.0 or c > samples - side - 3.0:
            return failed
        _interpolated(coefficients, r + 1.0, c + 1.0, at, 0)
        gain, by_row, by_col = _projected(at, chip, gradients, inverse)
        if not gain > 0.0:
            return failed
        step_r, step_c = -by_row / gain, -by_col / gain
        size = np.hypot(step_r, step_c)
        if not np.isfinite(size):
            return failed
        scale = min(1.0, 0.7 / max(size, 1e-9))
        r, c = r + scale * step_r, c + scale * step_c
        if abs(r - row) > reach_px or abs(c - col) > reach_px:
            return failed
        if size < STEP_PX:
            break
    if r < 0.0 or c < 0.0 or r > lines - side - 3.0 or c > samples - side - 3.0:
        return failed
    score, influence = _influence(coefficients, chip, gradients, r, c)
    return r, c, score, influence


@njit(cache=True, fastmath=_SUMS)
def _design(chip: FloatImage, weight: FloatImage) -> tuple[FloatImage, Array]:
    """Weighted gradients of the chip without its grey values and mean; their normal matrix inverted.

    What they are multiplied with is weighted by them, and freed of gain and offset.
    """
    side = chip.shape[0] - 2
    gradients = np.empty((2, side, side), dtype=np.float32)
    mean = np.zeros(3)
    total = 0.0
    for i in range(side):
        for j in range(side):
            w = weight[i, j]
            gradients[0, i, j] = np.float32(0.5) * (chip[i + 2, j + 1] - chip[i, j + 1])
            gradients[1, i, j] = np.float32(0.5) * (chip[i + 1, j + 2] - chip[i + 1, j])
            total += w
            mean[0] += w * chip[i + 1, j + 1]
            mean[1] += w * gradients[0, i, j]
            mean[2] += w * gradients[1, i, j]
    mean /= total
    own, across_r, across_c = 0.0, 0.0, 0.0
    for i in range(side):
        for j in range(side):
            value = chip[i + 1, j + 1] - mean[0]
            weighted = weight[i, j] * value
            own += weighted * value
            across_r += weighted * gradients[0, i, j]
            across_c += weighted * gradients[1, i, j]
    rr, rc, cc = 0.0, 0.0, 0.0
    for i in range(side):
        for j in range(side):
            value = chip[i + 1, j + 1] - mean[0]
            w = weight[i, j]
            g = gradients[0, i, j] - mean[1] - across_r / own * value
            h = gradients[1, i, j] - mean[2] - across_c / own * value
            gradients[0, i, j] = w * g
            gradients[1, i, j] = w * h
            rr += w * g * g
            rc += w * g * h
            cc += w * h * h
    determinant = rr * cc - rc * rc
    inverse = np.array([[cc, -rc], [-rc, rr]]) / determinant
    return gradients, inverse


@njit(cache=True, fastmath=_SUMS)
def _interpolated(
    coefficients: FloatImage, row: float, col: float, out: FloatImage, derivative: int
) -> None:
    """The patch from one place on; or its derivative by row (1) or by column (2)."""
    i, j = int(row), int(col)
    u, v = np.empty(4, np.float32), np.empty(4, np.float32)
    _taps(row - i, u, derivative == 1)
    _taps(col - j, v, derivative == 2)
    side_r, side_c = out.shape
    lines, samples = coefficients.shape
    line = np.empty(side_c + 3, dtype=np.float32)
    for k in range(side_r):
        a, b = max(i + k - 1, 0), i + k
        c, d = min(i + k + 1, lines - 1), min(i + k + 2, lines - 1)
        first = max(j - 1, 0)
        for m in range(side_c + 3):
            n = min(first + m, samples - 1)
            line[m] = (
                u[0] * coefficients[a, n]
                + u[1] * coefficients[b, n]
                + u[2] * coefficients[c, n]
                + u[3] * coefficients[d, n]
            )
        for m in range(side_c):
            out[k, m] = v[0] * line[m] + v[1] * line[m + 1] + v[2] * line[m + 2] + v[3] * line[m + 3]


@njit(cache=True)
def _taps(t: float, out: FloatImage, derivative: bool) -> None:
    if derivative:
        s = 1.0 - t
        out[0] = -0.5 * s * s
        out[1] = t * (1.5 * t - 2.0)
        out[2] = -s * (1.5 * s - 2.0)
        out[3] = 0.5 * t * t
    else:
        out[0], out[1], out[2], out[3] = spline_weights(t)


@njit(cache=True, fastmath=_SUMS)
def _projected(
    at: FloatImage, chip: FloatImage, gradients: FloatImage, inverse: Array
) -> tuple[float, float, float]:
    """Gain of the chip in a patch, and how much of its gradients is in there."""
    side = at.shape[0]
    mean, chip_mean = 0.0, 0.0
    for i in range(side):
        for j in range(side):
            mean += at[i, j]
            chip_mean += chip[i + 1, j + 1]
    mean, chip_mean = mean / side**2, chip_mean / side**2
    product, square, by_r, by_c = 0.0, 0.0, 0.0, 0.0
    for i in range(side):
        for j in range(side):
            value, other = chip[i + 1, j + 1] - chip_mean, at[i, j] - mean
            product += value * other
            square += value * value
            by_r += gradients[0, i, j] * other
            by_c += gradients[1, i, j] * other
    r = inverse[0, 0] * by_r + inverse[0, 1] * by_c
    c = inverse[1, 0] * by_r + inverse[1, 1] * by_c
    return product / square, r, c


@njit(cache=True, fastmath=_SUMS)
def _influence(
    coefficients: FloatImage, chip: FloatImage, gradients: FloatImage, row: float, col: float
) -> tuple[float, Array]:
    """Correlation of chip and patch, and the influence of the squares of the chip."""
    side = chip.shape[0] - 2
    at = np.empty((side, side), dtype=np.float32)
    down = np.empty((side, side), dtype=np.float32)
    right = np.empty((side, side), dtype=np.float32)
    _interpolated(coefficients, row + 1.0, col + 1.0, at, 0)
    _interpolated(coefficients, row + 1.0, col + 1.0, down, 1)
    _interpolated(coefficients, row + 1.0, col + 1.0, right, 2)
    mean, chip_mean = 0.0, 0.0
    for i in range(side):
        for j in range(side):
            mean += at[i, j]
            chip_mean += chip[i + 1, j + 1]
    mean, chip_mean = mean / side**2, chip_mean / side**2
    product, square, chip_square = 0.0, 0.0, 0.0
    m00, m01, m10, m11 = 0.0, 0.0, 0.0, 0.0
    for i in range(side):
        for j in range(side):
            value, other = chip[i + 1, j + 1] - chip_mean, at[i, j] - mean
            product += value * other
            square += other * other
            chip_square += value * value
            m00 += gradients[0, i, j] * down[i, j]
            m01 += gradients[0, i, j] * right[i, j]
            m10 += gradients[1, i, j] * down[i, j]
            m11 += gradients[1, i, j] * right[i, j]
    score = product / np.sqrt(square * chip_square)
    # Noise in the chip makes the regression's gain too small, noise in the patch its inverse: between
    # the two lies the one that leaves of both what is noise.
    gain = np.sqrt(square / chip_square)
    determinant = m00 * m11 - m01 * m10
    cells = -(-side // CELL_PX)
    influence = np.zeros((cells, cells, 2))
    for i in range(side):
        for j in range(side):
            left = at[i, j] - mean - gain * (chip[i + 1, j + 1] - chip_mean)
            by_r, by_c = gradients[0, i, j] * left, gradients[1, i, j] * left
            influence[i // CELL_PX, j // CELL_PX, 0] -= (m11 * by_r - m01 * by_c) / determinant
            influence[i // CELL_PX, j // CELL_PX, 1] -= (m00 * by_c - m10 * by_r) / determinant
    return score, influence


@njit(cache=True, fastmath=_SUMS)
def _bartlett(influence: Array, reach: int, covariance: Array) -> None:
    """Sum over all squares `reach` wide, whole or not, of the products of their sums."""
    cells = influence.shape[0]
    for i in range(1 - reach, cells):
        for j in range(1 - reach, cells):
            by_r, by_c = 0.0, 0.0
            for k in range(max(i, 0), min(i + reach, cells)):
                for m in range(max(j, 0), min(j + reach, cells)):
                    by_r += influence[k, m, 0]
                    by_c += influence[k, m, 1]
            covariance[0, 0] += by_r * by_r
            covariance[0, 1] += by_r * by_c
            covariance[1, 1] += by_c * by_c
    covariance[1, 0] = covariance[0, 1]
    covariance /= reach**2
