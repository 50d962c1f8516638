"""Comparison of intersected points with known ground, and residual parallaxes of their marks."""

from dataclasses import dataclass

import numpy as np

from amers.services.geodesy import metres_per_degree_at, wrapped_degrees
from amers.services.types import Array, BoolArray, IntArray


@dataclass(frozen=True)
class GroundErrors:
    """Errors of n points, intersected minus known.

    Attributes:
        error_m: (n, 3) east, north, up; NaN where unknown.
        rms_m: (3,) root mean square over the points that are compared; NaN without one.
        mean_m: (3,) mean over them.
        normalised: mean square of the errors over their stated covariance, a coordinate; NaN when
            unknown.
    """

    error_m: Array
    rms_m: Array
    mean_m: Array
    normalised: float


def ground_errors(
    lon_lat_h: Array, covariance_m2: Array, known: Array, sigma_m: Array, compared: BoolArray
) -> GroundErrors:
    """The errors of intersected points.

    Args:
        lon_lat_h: (n, 3) intersected; NaN where unknown.
        covariance_m2: (n, 3, 3) of east, north, up.
        known: (n, 3); NaN where unknown, also for heights alone.
        sigma_m: (n, 3) of the known ground; NaN counts as 0.
        compared: (n,) points that the figures are of.
    """
    error_m = lon_lat_h - known
    error_m[:, 0] = wrapped_degrees(error_m[:, 0])
    error_m[:, :2] *= metres_per_degree_at(lon_lat_h)
    own = error_m[compared]
    rms_m, mean_m = np.full(3, np.nan), np.full(3, np.nan)
    for axis, values in enumerate(own.T):
        values = values[np.isfinite(values)]
        if len(values):
            rms_m[axis], mean_m[axis] = np.sqrt(np.mean(values**2)), np.mean(values)
    total_m2 = covariance_m2[compared] + np.nan_to_num(sigma_m[compared])[:, :, None] ** 2 * np.eye(3)
    square, count = 0.0, 0
    for error, covariance in zip(own, total_m2, strict=True):
        axes = np.flatnonzero(np.isfinite(error))
        part = covariance[np.ix_(axes, axes)]
        if len(axes) and np.isfinite(part).all():
            square += float(error[axes] @ np.linalg.solve(part, error[axes]))
            count += len(axes)
    return GroundErrors(error_m, rms_m, mean_m, square / count if count else float("nan"))


def residual_parallaxes_m(residual_m: Array, point: IntArray, used: BoolArray) -> Array:
    """Residual parallaxes (2,) along lines and samples: by how much residuals of a point differ, rms.

    Source: Toutin and Carbonneau (1992), whose tables have them as Y and X parallaxes.

    Args:
        residual_m: (m, 2) of the marks, in metres of the ground.
        point: (m,) rows of their points.
        used: (m,) marks that count.

    Returns:
        Root mean squares of the differences between two images; NaN where no point has two marks.
    """
    numbers, own = np.unique(point[used], return_inverse=True)
    count = np.bincount(own, minlength=len(numbers))
    out = np.full(2, np.nan)
    if not (count >= 2).any():
        return out
    for axis in range(2):
        values = residual_m[used, axis]
        mean = np.bincount(own, values) / count
        spread = np.bincount(own, (values - mean[own]) ** 2)[count >= 2] / (count[count >= 2] - 1)
        out[axis] = np.sqrt(2.0 * spread.mean())
    return out
