"""Robust scale of residuals relative to their stated sigmas, with up to a third of outliers."""

import numpy as np
from scipy.special import chdtr, chdtri

from amers.services.errors import NoConsensus
from amers.services.types import Array, BoolArray, IntArray

MAX_SCALE = 5.0
"""Residuals so many times as large as stated are not those of the observations that were stated."""

LEAST_SCALE = 0.5
"""Sigmas are scaled by the residuals, at least by this: those of two rays only show the errors across
the epipolar line, so that the scale may be too small; and images with few points fit some of them
exactly."""

_LOW = 0.2
"""Quantile of the residuals that a third of blunders, and what they spoil in a pair, leaves alone."""
_REACH = 3.5
"""Residuals up to so many standard deviations tell the scale."""


def magnitude(square: Array, point: IntArray, active: BoolArray, coordinates: Array) -> Array:
    """Sizes (m,) of residuals, near 1 on average for true sigmas whatever the number of rays.

    A point with k rays takes three of their 2 k values: the residuals of a pair are small and
    perpendicular to the rays, whatever the error was. Where rays tell no height it takes two.

    Args:
        square: (m,) squared length of the residuals in units of their sigmas.
        point: (m,) of the observations.
        active: (m,) observations that the points were intersected from.
        coordinates: (p,) of every point, that its rays determine.
    """
    rays = np.bincount(point[active], minlength=int(point.max(initial=-1)) + 1)[point]
    free = 2.0 * rays - coordinates[point]
    redundancy = np.where(active & (rays >= 2), free / np.maximum(rays, 2), 1.0)
    return np.asarray(np.sqrt(square / redundancy))


def low_scale(square: Array, point: IntArray, coordinates: Array) -> float:
    """Standard deviation of observations in units of their sigmas, by the smallest residuals.

    Within a factor of two where a third of the observations are wrong, also in pairs, of which half are
    then spoilt; and never drawn up by them.

    Args:
        square: (m,) squared length of the residuals after a robust intersection; NaN where unusable.
        point: (m,) of the observations.
        coordinates: (p,) of every point, that its rays determine.
    """
    usable = np.isfinite(square)
    rays = np.bincount(point[usable], minlength=int(point.max(initial=-1)) + 1)[point]
    several = usable & (rays >= 2)
    if not several.any():
        return 1.0
    lost = coordinates[point[several]] / 2.0 / rays[several]
    low = np.quantile(square[several] / (1.0 - lost), _LOW)
    return float(np.sqrt(max(low / (-2.0 * np.log(1.0 - _LOW)), 1e-12)))


def robust_scale(square: Array, point: IntArray, coordinates: Array) -> float:
    """Standard deviation of observations in units of their sigmas, from those within its reach.

    From the smallest residuals on, the variance of what lies within its reach moves until it agrees with
    itself. Blunders spread over a hundred standard deviations add little within three.

    Args:
        square: (m,) squared length of the residuals after a robust intersection; NaN where unusable.
        point: (m,) of the observations.
        coordinates: (p,) of every point, that its rays determine.
    """
    scale2 = max(low_scale(square, point, coordinates), LEAST_SCALE) ** 2
    for _ in range(50):
        within = np.nan_to_num(square, nan=np.inf) <= _REACH**2 * scale2
        rays = np.bincount(point[within], minlength=len(coordinates))
        counted = within & (rays[point] >= 2)
        freedom = float((2.0 * rays - coordinates)[rays >= 2].sum())
        if freedom <= 0.0:
            break
        last, scale2 = scale2, square[counted].sum() / freedom / _WITHIN_REACH
        if abs(scale2 - last) <= 1e-3 * last:
            break
    return float(np.sqrt(max(scale2, 1e-12)))


_WITHIN_REACH = 1.0 - (_REACH**2 / 2.0) * np.exp(-(_REACH**2) / 2.0) / (1.0 - np.exp(-(_REACH**2) / 2.0))
"""Variance of a normal law in the plane, cut off at the reach."""


def posterior_scale(square: Array, point: IntArray, coordinates: Array, parameters: float) -> float:
    """A posteriori standard deviation of unit weight of active observations.

    The residuals of real measures have longer tails than the normal law, and a few of them would make
    the precision of a whole block. A point counts for at most what nine of ten have (Huber's second
    proposal).

    Args:
        square: (m,) squared length of their residuals in units of their sigmas.
        point: (m,) of the observations.
        coordinates: (p,) of every point, that its rays determine.
        parameters: number of parameters that they determine besides their points.
    """
    rays = np.bincount(point, minlength=len(coordinates))
    of_point = np.bincount(point, square, minlength=len(coordinates))[rays >= 2]
    freedom = (2.0 * rays - coordinates)[rays >= 2]
    if not len(freedom):
        return 1.0
    most = chdtri(freedom, 1.0 - _COUNTED)
    expected = freedom * chdtr(freedom + 2.0, most) + most * (1.0 - _COUNTED)
    scale2 = of_point.sum() / freedom.sum()
    for _ in range(100):
        last, scale2 = scale2, np.minimum(of_point, most * scale2).sum() / expected.sum()
        if abs(scale2 - last) <= 1e-6 * last:
            break
    left = max(freedom.sum() - parameters, 1.0)
    missing = max(_TELLING - left, 0.0)
    return float(np.sqrt(max((scale2 * freedom.sum() + missing) / (left + missing), 1e-12)))


_TELLING = 10.0
"""Degrees of freedom that tell a scale; of fewer, the rest are as large as stated."""
_COUNTED = 0.9
"""Probability of the residuals of a point beyond which larger ones do not count for more."""


def check_scale(scale: float) -> None:
    """Refuse a scale that no noise of the stated observations has.

    Raises:
        NoConsensus: it exceeds `MAX_SCALE`.
    """
    if scale > MAX_SCALE:
        raise NoConsensus(
            f"the residuals of the tie points are {scale:.1f} times their sigmas, at most "
            f"{MAX_SCALE:g} times is credible: give larger sigmas, allow drifts of the images, or "
            "remove wrong tie points"
        )
