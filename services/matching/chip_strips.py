"""How the parts of a chip move against each other along the lines of a scene.

A sensor that shakes faster than a chip is long displaces its parts, while the chip as a whole stays in
its place: positions of chips cannot show it. The residuals of the least-squares match can.
"""

from collections.abc import Sequence

import numpy as np

from amers.services.matching.least_squares_kernels import CELL_PX
from amers.services.matching.view_combination import ViewCombination
from amers.services.misfit.short_motion import STRIPS, ChipStrips
from amers.services.types import Array

_LEAST_LEVERAGE = 0.01
"""Smallest leverage of a strip, in each direction, from which on its displacement is known."""


def chip_strips(combinations: Sequence[ViewCombination], pixels_per_chip_pixel: Array) -> ChipStrips:
    """The displacements of strips of chips that were found.

    Args:
        combinations: of the views of n points.
        pixels_per_chip_pixel: (n, 2, 2) derivative of line and sample of the scene by row and column of
            the chips.
    """
    n = len(combinations)
    line = np.full((n, STRIPS), np.nan)
    displacement, sigma = np.full((n, STRIPS, 2), np.nan), np.full((n, STRIPS, 2), np.nan)
    for i, (match, derivative) in enumerate(zip(combinations, pixels_per_chip_pixel, strict=True)):
        if match.influence.size and np.isfinite(derivative).all():
            line[i], displacement[i], sigma[i] = _of_chip(match, derivative)
    return ChipStrips(line, displacement, sigma)


def _of_chip(match: ViewCombination, derivative: Array) -> tuple[Array, Array, Array]:
    """Lines (s,), displacements (s, 2) and standard deviations (s, 2) of the strips of a chip."""
    cells = match.influence.shape[0]
    middle = CELL_PX * (np.arange(cells) - (cells - 1) / 2.0)
    line = derivative[0, 0] * middle[:, None] + derivative[0, 1] * middle[None, :]
    half = np.abs(line).max()
    strip = np.clip(((line / half + 1.0) / 2.0 * STRIPS).astype(np.int64), 0, STRIPS - 1).ravel()
    count = np.maximum(np.bincount(strip, minlength=STRIPS), 1)
    middle_line = np.bincount(strip, line.ravel(), STRIPS) / count

    def sums(values: Array) -> Array:
        flat = values.reshape(cells * cells, -1)
        return np.stack([np.bincount(strip, column, STRIPS) for column in flat.T], axis=1)

    influence = sums(match.influence)
    leverage = sums(match.leverage).reshape(STRIPS, 2, 2)
    known = np.linalg.eigvalsh((leverage + leverage.transpose(0, 2, 1)) / 2.0)[:, 0] > _LEAST_LEVERAGE
    displacement, sigma = np.full((STRIPS, 2), np.nan), np.full((STRIPS, 2), np.nan)
    inverse = np.linalg.inv(leverage[known])
    displacement[known] = (inverse @ influence[known][:, :, None])[:, :, 0] @ derivative.T
    covariance = match.sigma_px**2 * derivative @ (inverse + inverse.transpose(0, 2, 1)) @ derivative.T
    sigma[known] = np.sqrt(np.maximum(np.diagonal(covariance, 0, 1, 2) / 2.0, 1e-12))
    return middle_line, displacement, sigma
