"""Noise of image observations: the stated part, and the part that all observations have."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.sensors.base import SensorModel
from amers.services.types import Array, Observations

_POINTS = 2_000
"""Points that are enough to estimate the noise."""
_LEAST_FREEDOM = 60
"""Fewest redundant coordinates that tell two kinds of noise apart."""
_LEAST_SCALE2 = 0.25
_LARGEST_RATIO2 = 9.0
"""Squares of residuals count up to this many times what is expected."""
_ITERATIONS = 30


@dataclass(frozen=True)
class ObservationNoise:
    """The variance a s^2 + b of observations with a stated sigma s.

    Attributes:
        scale2: a.
        own2_px2: b, pixels squared.
    """

    scale2: float = 1.0
    own2_px2: float = 0.0

    def applied(self, sigma_px: Array) -> Array:
        """Standard deviations (m,) of observations with stated ones."""
        return np.asarray(np.sqrt(self.scale2 * sigma_px**2 + self.own2_px2))


def found_noise(
    observations: Observations, models: Sequence[SensorModel], lon_lat_h: Array, residual_px: Array
) -> ObservationNoise:
    """The noise that residuals show.

    A measure of two images of one date may be precise to 0.02 px, and yet both images are bent by 0.1 px
    (jitter, relief of the model): such errors do not scale with the stated sigma s, and rays that are
    weighted as if they were absent hide them, as they pull their point along. So the residuals here are
    those of unweighted intersections, in which every ray counts alike. For a point with the derivatives
    A of its positions, R = I - A (A^T A)^-1 A^T projects errors to residuals v, and
    E[v^T v] = a tr(R S) + b tr(R) with S = diag(s^2). Both are fitted to all points by iterated weighted
    least squares.

    Args:
        observations: m of them, all active.
        models: of the images, adjusted.
        lon_lat_h: (p, 3) adjusted points.
        residual_px: (m, 2) of the adjustment.

    Returns:
        The stated noise where too few observations are redundant.
    """
    measured, expected_a, expected_b = _squares(observations, models, lon_lat_h, residual_px)
    if expected_b.sum() < _LEAST_FREEDOM:
        return ObservationNoise()
    a, b = 1.0, 0.0
    for _ in range(_ITERATIONS):
        expected = a * expected_a + b * expected_b
        square = np.minimum(measured, _LARGEST_RATIO2 * expected)
        # The variance of a sum of k squares is in proportion to their mean's square times k.
        design = np.column_stack([expected_a, expected_b]) * (np.sqrt(expected_b) / expected)[:, None]
        target = square * np.sqrt(expected_b) / expected
        a, b = _not_negative(design, target)
    return ObservationNoise(a, b)


def _not_negative(design: Array, target: Array) -> tuple[float, float]:
    """Least squares for a of at least its limit, and b of at least 0."""
    (a, b), *_ = np.linalg.lstsq(design, target, rcond=None)
    if b < 0.0:
        a, b = float(design[:, 0] @ target / (design[:, 0] @ design[:, 0])), 0.0
    if a < _LEAST_SCALE2:
        rest = target - _LEAST_SCALE2 * design[:, 0]
        a, b = _LEAST_SCALE2, max(float(design[:, 1] @ rest / (design[:, 1] @ design[:, 1])), 0.0)
    return float(a), float(b)


def _squares(
    observations: Observations, models: Sequence[SensorModel], lon_lat_h: Array, residual_px: Array
) -> tuple[Array, Array, Array]:
    """Sums of squares (k,) of points, and their expectations for a = 1 and for b = 1."""
    by_ground = np.empty((len(observations), 2, 3))
    for image in np.unique(observations.image):
        rows = observations.image == image
        by_ground[rows] = models[image].project_derivative(lon_lat_h[observations.point[rows]])
    _, first, count = np.unique(observations.point, return_index=True, return_counts=True)
    chosen = np.flatnonzero(count >= 2)
    chosen = chosen[:: max(1, len(chosen) // _POINTS)]
    squares = np.empty((len(chosen), 3))
    for row, number in enumerate(chosen):
        rows = slice(first[number], first[number] + count[number])
        basis, _ = np.linalg.qr(by_ground[rows].reshape(-1, 3))
        residual = residual_px[rows].ravel()
        residual = residual - basis @ (basis.T @ residual)
        share = 1.0 - (basis**2).sum(axis=1)
        variance = np.repeat(observations.sigma_px[rows] ** 2, 2)
        squares[row] = residual @ residual, share @ variance, share.sum()
    return squares[:, 0], squares[:, 1], squares[:, 2]
