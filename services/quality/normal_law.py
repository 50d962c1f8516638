"""CE90 and LE90 of the normal law, without the statistics of samples and what these load."""

from functools import lru_cache
from statistics import NormalDist

import numpy as np

from services.types import Array

CIRCULAR_CE90 = float(np.sqrt(2.0 * np.log(10.0)))
"""CE90 of a circular normal law of unit sigma (2.1460)."""
LINEAR_LE90 = NormalDist().inv_cdf(0.95)
"""LE90 of a normal law of unit sigma (1.6449)."""


def normal_ce90(covariance: Array) -> Array:
    """CE90 of normal errors without bias, predicted by their covariance.

    Args:
        covariance: (n, 2, 2).

    Returns:
        (n,) radius that holds 90 %, in the square root of the covariance's unit; NaN for a NaN.
    """
    (a, b), (c, d) = covariance.transpose(1, 2, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        # The larger eigenvalue, and the square of the ratio of both.
        large = np.maximum((a + d) / 2.0 + np.hypot((a - d) / 2.0, (b + c) / 2.0), 0.0)
        ratio = np.where(large > 0.0, np.clip((a * d - b * c) / large**2, 0.0, 1.0), 0.0)
        return np.sqrt(large) * np.interp(np.sqrt(ratio), *_ce90_of_ratio())


@lru_cache(maxsize=1)
def _ce90_of_ratio() -> tuple[Array, Array]:
    """CE90 of normal laws of standard deviations 1 and a ratio, by bisection of their integral.

    In polar coordinates, the share of the law outside of a radius R is the mean of
    exp(-R^2 / (2 (cos^2 t + ratio^2 sin^2 t))) over the eccentric angle t, also for the ratio 0
    (J. W. Craig, A new, simple and exact result for calculating the probability of error, MILCOM 1991).
    The midpoint rule is exact to rounding for such smooth periodic functions.
    """
    ratio = np.linspace(0.0, 1.0, 129)
    angle = (np.arange(64) + 0.5) * np.pi / 128.0
    variance = np.cos(angle) ** 2 + (ratio[:, None] * np.sin(angle)) ** 2
    low, high = np.full(len(ratio), 1.0), np.full(len(ratio), 3.0)
    for _ in range(40):
        radius = (low + high) / 2.0
        outside = np.exp(-(radius[:, None] ** 2) / (2.0 * variance)).mean(axis=1)
        enough = outside < 0.1
        low, high = np.where(enough, low, radius), np.where(enough, radius, high)
    return ratio, (low + high) / 2.0
