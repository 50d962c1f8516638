"""CE90 and LE90 of a normal distribution, without the imports of sample statistics."""

from collections.abc import Callable
from functools import lru_cache
from statistics import NormalDist

import numpy as np

from amers.services.types import Array

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


def overall_ce90(covariance: Array) -> float:
    """CE90 of normal errors without bias at n places alike: the radius that holds 90 % of all of them.

    Args:
        covariance: (n, 2, 2) of each place.

    Returns:
        The radius, in the square root of the covariance's unit; NaN if one place is unknown.
    """
    if not np.isfinite(covariance).all():
        return float("nan")
    variance = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    largest = float(normal_ce90(covariance).max())
    return float(_radius(variance[:, 0], variance[:, 1], lambda outside: outside.mean(), largest))


@lru_cache(maxsize=1)
def _ce90_of_ratio() -> tuple[Array, Array]:
    """CE90 (129,) of normal laws of standard deviations 1 and a ratio (129,)."""
    ratio = np.linspace(0.0, 1.0, 129)
    return ratio, _radius(ratio**2, np.ones_like(ratio), lambda outside: outside, 3.0)


def _radius(small: Array, large: Array, over: Callable[[Array], Array], largest: float) -> Array:
    """Radius beyond which a tenth of normal laws lies, by bisection of their integral.

    In polar coordinates, the share of a law outside of a radius R is the mean of
    exp(-R^2 / (2 (large cos^2 t + small sin^2 t))) over the eccentric angle t, also for a small of 0
    (J. W. Craig, A new, simple and exact result for calculating the probability of error, MILCOM 1991).
    The midpoint rule is exact to rounding for such smooth periodic functions.

    Args:
        small, large: variances (n,) of the laws along their axes.
        over: what is made of their shares (n,): a tenth of each, or of all.
        largest: that it may be.
    """
    angle = (np.arange(64) + 0.5) * np.pi / 128.0
    variance = np.outer(large, np.cos(angle) ** 2) + np.outer(small, np.sin(angle) ** 2)
    variance = np.maximum(variance, 1e-300)
    low, high = np.zeros(np.shape(over(small))), np.full(np.shape(over(small)), largest)
    for _ in range(40):
        radius = (low + high) / 2.0
        outside = over(np.exp(-(radius[..., None] ** 2) / (2.0 * variance)).mean(axis=1))
        low, high = np.where(outside < 0.1, low, radius), np.where(outside < 0.1, radius, high)
    return np.asarray((low + high) / 2.0)
