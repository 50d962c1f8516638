"""The compiled loops of least-squares matching."""

import numpy as np
from numba import njit

from amers.services.imagery.resampling import spline_weights
from amers.services.types import Array, FloatImage

MAX_STEPS = 12
STEP_PX = 2e-3
"""A step shorter than this ends the iteration."""

REACH_PX = 1.5
"""Largest distance of the fitted position from the start, along each axis."""

CELL_PX = 4
"""Side of the squares of the chip in which influences are summed."""

_SUMS = {"reassoc", "contract", "nsz", "arcp"}
"""Fast-math flags that let the compiler vectorise sums; NaN and infinity keep their meaning."""


@njit(cache=True, error_model="numpy")
def fit_position(
    coefficients: FloatImage,
    chip: FloatImage,
    weight: FloatImage,
    used: FloatImage,
    start: Array,
) -> tuple[Array, float, Array, FloatImage]:
    """Row and column (2,), score, influence and leverage of the fit; a NaN score where there is none.

    Args:
        coefficients: of the spline through the patch.
        chip: (s, s) without NaN.
        weight: (s - 2, s - 2) of the chip's pixels without the outermost; 0 where `used` is.
        used: (s - 2, s - 2) 1 where a pixel is valid, else 0; (0, 0) where all are.
        start: (2,) row and column of the chip's first pixel in the patch.
    """
    side = chip.shape[0] - 2
    lines, samples = coefficients.shape
    gradients, inverse = _design(chip, weight)
    centred = chip[1:-1, 1:-1].copy()
    _centre(centred, used)
    square = _projected(centred, centred, gradients, inverse)[0]
    at = np.empty((side, side), dtype=np.float32)
    failed = (start, np.nan, np.zeros((1, 1, 2)), np.zeros((1, 1, 2, 2), dtype=np.float32))
    row, col = start
    r, c = row, col
    for _ in range(MAX_STEPS):
        if r < 0.0 or c < 0.0 or r > lines - side - 3.0 or c > samples - side - 3.0:
            return failed
        _interpolated(coefficients, r + 1.0, c + 1.0, at, 0)
        _centre(at, used)
        product, by_row, by_col = _projected(at, centred, gradients, inverse)
        gain = product / square
        if not gain > 0.0:
            return failed
        step_r, step_c = -by_row / gain, -by_col / gain
        size = np.hypot(step_r, step_c)
        if not np.isfinite(size):
            return failed
        scale = min(1.0, 0.7 / max(size, 1e-9))
        r, c = r + scale * step_r, c + scale * step_c
        if abs(r - row) > REACH_PX or abs(c - col) > REACH_PX:
            return failed
        if size < STEP_PX:
            break
    if r < 0.0 or c < 0.0 or r > lines - side - 3.0 or c > samples - side - 3.0:
        return failed
    _interpolated(coefficients, r + 1.0, c + 1.0, at, 0)
    _centre(at, used)
    position = np.array([r, c])
    score, influence, leverage = _influence(coefficients, at, centred, gradients, position)
    return position, score, influence, leverage


@njit(cache=True, fastmath=_SUMS)
def _centre(pixels: FloatImage, used: FloatImage) -> None:
    """Subtract the mean over the pixels in use (1 in `used`; all where it is empty); others become 0."""
    values, mask = pixels.ravel(), used.ravel()
    total, count = 0.0, 0.0
    if len(mask) == 0:
        count = float(len(values))
        for k in range(len(values)):
            total += values[k]
    for k in range(len(mask)):
        total += mask[k] * values[k]
        count += mask[k]
    mean = np.float32(total / count)
    for k in range(len(values)):
        values[k] -= mean
    for k in range(len(mask)):
        values[k] *= mask[k]


@njit(cache=True, fastmath=_SUMS)
def _design(chip: FloatImage, weight: FloatImage) -> tuple[FloatImage, Array]:
    """Weighted gradients (2, s, s) of the chip, orthogonal to gain and offset; inverse normal matrix.

    A scalar product with them weights the other factor and removes its gain and offset.
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
            w = weight[i, j]
            value = chip[i + 1, j + 1] - mean[0]
            weighted = w * value
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
    """Fill `out` with the patch from a position on, or with its derivative by row (1) or column (2)."""
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
    """Fill `out` (4,) with the spline weights at a fraction `t`, or with their derivatives."""
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
    """Scalar product of chip and patch, and the components of the patch along the chip's gradients."""
    side = at.shape[0]
    product, by_r, by_c = 0.0, 0.0, 0.0
    for i in range(side):
        for j in range(side):
            other = at[i, j]
            product += chip[i, j] * other
            by_r += gradients[0, i, j] * other
            by_c += gradients[1, i, j] * other
    r = inverse[0, 0] * by_r + inverse[0, 1] * by_c
    c = inverse[1, 0] * by_r + inverse[1, 1] * by_c
    return product, r, c


@njit(cache=True, fastmath=_SUMS)
def _influence(
    coefficients: FloatImage,
    at: FloatImage,
    chip: FloatImage,
    gradients: FloatImage,
    row_col: Array,
) -> tuple[float, Array, FloatImage]:
    """Correlation of chip and patch, influences (c, c, 2) and leverages (c, c, 2, 2) of the squares.

    `at` is the patch under the chip; both are centred.
    """
    side = chip.shape[0]
    row, col = row_col
    down = np.empty((side, side), dtype=np.float32)
    right = np.empty((side, side), dtype=np.float32)
    _interpolated(coefficients, row + 1.0, col + 1.0, down, 1)
    _interpolated(coefficients, row + 1.0, col + 1.0, right, 2)
    product, square, chip_square = 0.0, 0.0, 0.0
    cells = -(-side // CELL_PX)
    information = np.zeros((2, 2, cells, cells))
    for i in range(side):
        for j in range(side):
            value, other = chip[i, j], at[i, j]
            product += value * other
            square += other * other
            chip_square += value * value
            a, b = i // CELL_PX, j // CELL_PX
            information[0, 0, a, b] += gradients[0, i, j] * down[i, j]
            information[0, 1, a, b] += gradients[0, i, j] * right[i, j]
            information[1, 0, a, b] += gradients[1, i, j] * down[i, j]
            information[1, 1, a, b] += gradients[1, i, j] * right[i, j]
    score = product / np.sqrt(square * chip_square)
    # Noise in the chip biases the regression gain low, noise in the patch biases its inverse low. The
    # ratio of the spreads lies between the two.
    gain = np.sqrt(square / chip_square)
    m00, m01 = information[0, 0].sum(), information[0, 1].sum()
    m10, m11 = information[1, 0].sum(), information[1, 1].sum()
    determinant = m00 * m11 - m01 * m10
    # Hundreds of points keep those of all their views.
    leverage = np.empty((cells, cells, 2, 2), dtype=np.float32)
    for k in range(2):
        leverage[:, :, 0, k] = (m11 * information[0, k] - m01 * information[1, k]) / determinant
        leverage[:, :, 1, k] = (m00 * information[1, k] - m10 * information[0, k]) / determinant
    influence = np.zeros((cells, cells, 2))
    for i in range(side):
        for j in range(side):
            left = at[i, j] - gain * chip[i, j]
            by_r, by_c = gradients[0, i, j] * left, gradients[1, i, j] * left
            influence[i // CELL_PX, j // CELL_PX, 0] -= (m11 * by_r - m01 * by_c) / determinant
            influence[i // CELL_PX, j // CELL_PX, 1] -= (m00 * by_c - m10 * by_r) / determinant
    return score, influence, leverage


@njit(cache=True, fastmath=_SUMS)
def add_bartlett_sums(influence: Array, reach: int, covariance: Array) -> None:
    """Fill `covariance` (2, 2) with the products of the sums over all windows `reach` cells wide.

    Windows beyond the border count with the cells they contain. The result is the double sum over pairs
    of cells with Bartlett weights.
    """
    cells = influence.shape[0]
    total = np.zeros((2, cells + 1, cells + 1))
    for k in range(2):
        for i in range(cells):
            line = 0.0
            for j in range(cells):
                line += influence[i, j, k]
                total[k, i + 1, j + 1] = total[k, i, j + 1] + line
    for i in range(1 - reach, cells):
        a, b = max(i, 0), min(i + reach, cells)
        for j in range(1 - reach, cells):
            c, d = max(j, 0), min(j + reach, cells)
            by_r = total[0, b, d] - total[0, a, d] - total[0, b, c] + total[0, a, c]
            by_c = total[1, b, d] - total[1, a, d] - total[1, b, c] + total[1, a, c]
            covariance[0, 0] += by_r * by_r
            covariance[0, 1] += by_r * by_c
            covariance[1, 1] += by_c * by_c
    covariance[1, 0] = covariance[0, 1]
    covariance /= reach**2


@njit(cache=True, error_model="numpy")
def neighbour_correlation(influence: Array) -> tuple[int, float]:
    """Number of cells in use, and the correlation of neighbouring ones (`influence` (c, c, 2)).

    The constraint of a zero sum makes independent cells slightly negatively correlated, which is undone.
    """
    cells = influence.shape[0]
    used, pairs, square, product = 0, 0, 0.0, 0.0
    for i in range(cells):
        for j in range(cells):
            r, c = influence[i, j]
            if r == 0.0 and c == 0.0:
                continue
            used += 1
            square += r * r + c * c
            for k, m in ((i + 1, j), (i, j + 1)):
                if k < cells and m < cells:
                    other_r, other_c = influence[k, m]
                    if other_r != 0.0 or other_c != 0.0:
                        pairs += 1
                        product += r * other_r + c * other_c
    if pairs == 0:
        return used, 0.0
    return used, (product / pairs) / (square / used) + 1.0 / used
