"""Shear between chips and a scene, caused by relief and different viewing directions.

Chip and scene are compared on the horizontal plane through a point. Ground above it is displaced in each
of them along its own line of sight, so that a slope shears one against the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.matching.correlate import Peak
from amers.services.matching.least_squares_kernels import CELL_PX
from amers.services.types import Array, BoolArray, IntArray


@dataclass(frozen=True)
class ChipShears:
    """Views v of points that were found.

    Attributes:
        point: (v,) rows of their points, ascending.
        lean: (v, 2) east and north by which a view displaces ground, metres for a metre of height; NaN
            where its direction is unknown.
        gradient: (v, 2, 2) displacement of the scene against the chip, east and north, by a step to the
            east and to the north.
        sigma: (v,) one standard deviation of these.
    """

    point: IntArray
    lean: Array
    gradient: Array
    sigma: Array

    def take(self, rows: IntArray | BoolArray) -> "ChipShears":
        """Some of the views."""
        return ChipShears(self.point[rows], self.lean[rows], self.gradient[rows], self.sigma[rows])

    def replaced(self, points: IntArray, by: "ChipShears") -> "ChipShears":
        """The views of these, of which some points (k,) have others."""
        kept = self.take(~np.isin(self.point, points))
        point = np.concatenate([kept.point, by.point])
        both = ChipShears(
            point,
            np.concatenate([kept.lean, by.lean]),
            np.concatenate([kept.gradient, by.gradient]),
            np.concatenate([kept.sigma, by.sigma]),
        )
        return both.take(np.argsort(point, kind="stable"))


def chip_shears(point: IntArray, lean: Array, peaks: Sequence[Peak]) -> ChipShears:
    """How the chips of views (v,) that were found are sheared.

    The displacement of a square of a chip, as least squares would place it alone, is fitted by one that
    is linear over the chip.

    Args:
        point: rows of the points of the views, ascending.
        lean: (v, 2) of the views, see `ChipShears`.
        peaks: of the views, all found.
    """
    if not len(peaks):
        return ChipShears(point, np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))
    gradient, sigma = np.full((len(peaks), 2, 2), np.nan), np.full(len(peaks), np.nan)
    for cells in {peak.influence.shape[0] for peak in peaks}:
        rows = [row for row, peak in enumerate(peaks) if peak.influence.shape[0] == cells]
        gradient[rows], unit = _linear(
            np.stack([peaks[row].influence for row in rows]),
            np.stack([peaks[row].leverage for row in rows]),
        )
        sigma[rows] = unit * [peaks[row].sigma_px for row in rows]
    known = np.isfinite(gradient).all(axis=(1, 2)) & np.isfinite(sigma) & np.isfinite(lean).all(axis=1)
    return ChipShears(point, lean, gradient, sigma).take(known)


def _linear(influence: Array, leverage: Array) -> tuple[Array, Array]:
    """Gradients (m, 2, 2) of m chips, and their sigmas (m,) for a position of one pixel.

    Args:
        influence: (m, c, c, 2) of the squares, see `least_squares.Fit`.
        leverage: (m, c, c, 2, 2) of them.
    """
    m, cells = influence.shape[:2]
    middle = CELL_PX * (np.arange(cells) - (cells - 1) / 2.0)
    row, col = np.meshgrid(middle, middle, indexing="ij")
    # A constant, a step to the east and one to the north; displacements in this order, too.
    basis = np.stack([np.ones((cells, cells)), col, -row]).reshape(3, -1)
    products = (basis[:, None] * basis[None, :]).reshape(9, -1)
    flat = leverage.reshape(m, -1, 4).astype(np.float64)
    normal = (products @ flat).reshape(m, 3, 3, 2, 2).transpose(0, 1, 3, 2, 4).reshape(m, 6, 6)
    right = (basis @ influence.reshape(m, -1, 2)).reshape(m, 6)
    finite = np.isfinite(normal).all(axis=(1, 2)) & np.isfinite(right).all(axis=1)
    normal[~finite] = 0.0
    regular = finite & (np.linalg.cond(normal) < 1e10)
    gradient, unit = np.full((m, 2, 2), np.nan), np.full(m, np.nan)
    inverse = np.linalg.inv(normal[regular])
    by_row_col = (inverse @ right[regular][:, :, None]).reshape(-1, 3, 2)[:, 1:]
    gradient[regular] = np.stack([by_row_col[:, :, 1], -by_row_col[:, :, 0]], axis=1)
    variance = np.trace(inverse[:, 2:, 2:], axis1=1, axis2=2) / 4.0
    unit[regular] = np.sqrt(np.where(variance > 0.0, variance, np.nan))
    return gradient, unit
