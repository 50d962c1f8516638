"""Least-squares matching: the position of a chip in a patch to a fraction of a pixel, with its noise."""

import math
from dataclasses import dataclass

import numpy as np

from amers.services.imagery.gaps import filled
from amers.services.imagery.resampling import SPLINE_REACH_PX, resample, spline_coefficients
from amers.services.matching.least_squares_kernels import (
    REACH_PX,
    add_bartlett_sums,
    fit_position,
    neighbour_correlation,
)
from amers.services.types import Array, BoolArray, FloatImage

_ALL = np.zeros((0, 0), dtype=np.float32)
"""The mask of pixels in use where all are."""

_MAX_FILLS = 6
"""Largest number of fits of a chip with missing pixels."""

_FILLED_PX = 5e-3
"""A new fill that moves the position by less ends these fits."""

REACH_CELLS = 5
"""Smallest distance in squares beyond which influences are uncorrelated; a fifth of a small chip."""

_REACH_SPANS = 2.5
"""The same distance in spans of the correlation between squares."""

_MIN_FREEDOM = 0.2
"""Smallest share of independent squares that the fit leaves."""


@dataclass(frozen=True)
class Fit:
    """The least-squares position of a chip in a patch.

    Attributes:
        row_col: (2,) position of the chip's first pixel in the patch, pixels.
        score: normalised correlation there.
        influence: (c, c, 2) shift of the position, rows and columns, by the residuals in each square of
            the chip; the sum over the squares is zero.
        leverage: (c, c, 2, 2) shift of the position by a displacement of each square alone; the sum over
            the squares is the unit matrix.
    """

    row_col: Array
    score: float
    influence: Array
    leverage: FloatImage


def fit_chip(
    patch: FloatImage, chip: FloatImage, start: Array, weight: FloatImage | None = None
) -> Fit | None:
    """Position of a chip in a patch by least squares over two displacements, a gain and an offset.

    Gauss-Newton with the constant gradients of the chip, so that a step costs one interpolation of the
    patch. At convergence the residuals are orthogonal to the gradients of the chip: the noise has no
    systematic effect on the position.

    Source: Gruen (1985), Adaptive least squares correlation; Baker and Matthews (2004), Lucas-Kanade 20
    years on, for the direction of the linearisation.

    Pixels that are invalid, in the chip or in the patch under it, have no weight. Filled smoothly, they
    serve the gradients and the interpolation beside them.

    Args:
        patch: larger than the chip; NaN or +inf where it is invalid.
        chip: (s, s); the same.
        start: (2,) row and column of the chip's first pixel in the patch, to about a pixel.
        weight: (s - 2, s - 2) of the chip's pixels without the outermost; None weights all alike.

    Returns:
        None where the iteration leaves `REACH_PX` or the patch.
    """
    margin = SPLINE_REACH_PX + int(np.ceil(REACH_PX))
    first = np.maximum(np.floor(start).astype(int) - margin, 0)
    last = np.minimum(np.ceil(start).astype(int) + chip.shape[0] + margin, patch.shape)
    near = patch[first[0] : last[0], first[1] : last[1]]
    if np.isfinite(near).all() and np.isfinite(chip).all():
        if weight is None:
            weight = np.ones((chip.shape[0] - 2, chip.shape[1] - 2), dtype=np.float32)
        row_col, score, influence, leverage = fit_position(
            spline_coefficients(near), chip, weight, _ALL, start - first
        )
    else:
        row_col, score, influence, leverage = _fit_valid(near, chip, weight, start - first)
    return Fit(first + row_col, score, influence, leverage) if np.isfinite(score) else None


def _fit_valid(
    patch: FloatImage, chip: FloatImage, weight: FloatImage | None, row_col: Array
) -> tuple[Array, float, Array, FloatImage]:
    """As `fit_position`, from a patch and over the pixels valid in patch and chip.

    A missing pixel of the patch enters the interpolation beside it. There it has the value that the chip
    predicts at the position found, which is then found again.
    """
    seen, valid = np.isfinite(patch), np.isfinite(chip)
    chip, whole = filled(chip), filled(patch)
    side = chip.shape[0] - 2
    for _ in range(_MAX_FILLS):
        used = np.zeros((side, side), dtype=np.float32)
        i, j = np.rint(row_col).astype(int) + 1
        under = seen[i : i + side, j : j + side]
        used[: under.shape[0], : under.shape[1]] = under
        used *= valid[1:-1, 1:-1]
        weighted = used if weight is None else weight * used
        found = fit_position(spline_coefficients(whole), chip, weighted, used, row_col)
        moved_px = np.hypot(*(found[0] - row_col))
        row_col = found[0]
        if not np.isfinite(found[1]) or moved_px < _FILLED_PX or seen.all():
            break
        whole = _filled_by_chip(whole, seen, chip, row_col)
    return found


def _filled_by_chip(patch: FloatImage, seen: BoolArray, chip: FloatImage, row_col: Array) -> FloatImage:
    """A patch whose missing pixels (not `seen`) have the values that a chip at a position predicts."""
    lines, samples = patch.shape
    grid = np.empty((lines, samples, 2))
    grid[..., 0] = (np.arange(lines) - row_col[0])[:, None]
    grid[..., 1] = np.arange(samples) - row_col[1]
    predicted = resample(spline_coefficients(chip), grid)
    under = np.isfinite(predicted)
    common = under & seen
    x, y = predicted[common].astype(np.float64), patch[common].astype(np.float64)
    gain = (x - x.mean()) @ y / ((x - x.mean()) @ x)
    whole = patch.copy()
    missing = under & ~seen
    whole[missing] = y.mean() + gain * (predicted[missing] - x.mean())
    return whole


def covariance_from_influence(influence: Array) -> Array:
    """Covariance (2, 2) of a position from the influences of the squares of its chip.

    The residuals between chip and patch are rarely white: they are correlated over short distances and
    concentrated at shadows and roofs. So the products of neighbouring squares count, with Bartlett
    weights that fall to zero at a distance (a sandwich estimator). The distance follows from the
    correlation between neighbouring squares, which also gives the number of independent squares: of
    these, the two displacements, the gain and the offset of the fit take four.

    Source: Newey and West (1987), in two dimensions as in Conley (1999).

    Args:
        influence: (c, c, 2) with a sum of zero.
    """
    influence = np.ascontiguousarray(influence)
    used, correlation = neighbour_correlation(influence)
    if used == 0:
        return np.zeros((2, 2))
    side = math.sqrt(used)
    correlation = min(max(correlation, 0.0), 0.9)
    span = (1.0 + correlation) / (1.0 - correlation)
    reach = max(1, min(REACH_CELLS, int(side) // 5), min(int(side) // 2, math.ceil(_REACH_SPANS * span)))
    covariance = np.zeros((2, 2))
    add_bartlett_sums(influence, reach, covariance)
    # The constraint of a zero sum reduces the variance of the influences: this factor restores it.
    covariance /= 1.0 - reach**2 / max(used, reach**2 + 1)
    return covariance / max(_MIN_FREEDOM, 1.0 - 4.0 * span**2 / used)
