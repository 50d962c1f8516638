"""Bundle adjustment: the corrections of all images of a block, from tie points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.special import gammaincinv

from services.adjustment.intersection import intersect, residuals_and_derivatives
from services.adjustment.robust import cauchy_weights
from services.errors import NoConvergence, NotEnoughPoints
from services.geodesy import move_metres
from services.sensors.base import SensorModel
from services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from services.types import Array, BoolArray, IntArray, Observations


@dataclass(frozen=True)
class BlockOptions:
    """How a block is adjusted.

    Attributes:
        tolerance: an observation is deactivated at the end when its residual exceeds this many standard
            deviations.
        max_iterations: the adjustment fails when it has not converged after this many iterations.
        converged_px: the adjustment has converged when no correction changes by more than this.
        min_points: smallest number of tie points.
    """

    tolerance: float = 4.0
    max_iterations: int = 100
    converged_px: float = 1e-3
    min_points: int = 6


@dataclass(frozen=True)
class BlockAdjustment:
    """A block whose images agree.

    Attributes:
        models: the images' models with their corrections.
        covariance_px2: (2 n, 2 n) of the shifts, line and sample, image after image.
        lon_lat_h: (p, 3) the tie points; NaN where they cannot be intersected.
        point_covariance_m2: (p, 3, 3) east, north, up, for exact corrections: it is relative to the
            frame of the block.
        residual_px: (m, 2) observed minus computed.
        active: (m,) observations within tolerance, of points with at least two such observations.
        sigma_px: a posteriori standard deviation of an observation with an a priori sigma of one.
        iterations: number of iterations.
    """

    models: tuple[CorrectedModel, ...]
    covariance_px2: Array
    lon_lat_h: Array
    point_covariance_m2: Array
    residual_px: Array
    active: BoolArray
    sigma_px: float
    iterations: int


class _Linearised(NamedTuple):
    """The observation equations at the current shifts and points; a named tuple, for compiled functions.

    Attributes:
        point, image: (m,) the point and the image of every observation; points ascending.
        residual: (m, 2) observed minus computed, pixels.
        derivative: (m, 2, 3) pixels per metre east, north, up.
        weight: (m,) per px^2; 0 for observations that do not count.
    """

    point: IntArray
    image: IntArray
    residual: Array
    derivative: Array
    weight: Array


class _PointSolution(NamedTuple):
    """The part of the normal equations that concerns each point alone.

    Attributes:
        inverse: (p, 3, 3) inverse normal matrices; NaN where a point is undetermined.
        right: (p, 3) right sides.
    """

    inverse: Array
    right: Array


def adjust_block(
    models: Sequence[SensorModel],
    shapes: Sequence[tuple[int, int]],
    observations: Observations,
    sigma_px: Array,
    options: BlockOptions = BlockOptions(),
) -> BlockAdjustment:
    """The shift of every image for which the rays of the tie points intersect.

    Gauss-Newton on image residuals. The points are eliminated (Schur complement), and Cauchy weights are
    renewed in every iteration with the robust scale of the residuals. The a priori sigmas of the images
    determine what tie points cannot: the frame of the whole block, and the parallax of pairs.

    Args:
        models: one per image, as delivered.
        shapes: lines and samples of the images.
        observations: m image positions of tie points, by point.
        sigma_px: (n,) a priori standard deviation of the shift of each image, pixels.
        options: thresholds.

    Raises:
        NotEnoughPoints: too few tie points can be intersected.
        NoConvergence: the corrections still change after the last iteration.
    """
    n_points = int(observations.point[-1]) + 1 if len(observations) else 0
    lon_lat_h = intersect(models, observations, n_points).lon_lat_h
    intersected = int(np.isfinite(lon_lat_h[:, 0]).sum())
    if intersected < options.min_points:
        raise NotEnoughPoints(
            intersected, options.min_points, f"tie points between {len(models)} images"
        )
    shift_px = np.zeros((len(models), 2))
    change_px = np.inf
    iterations = 0
    while change_px > options.converged_px:
        if iterations == options.max_iterations:
            raise NoConvergence(
                f"the block of {len(models)} images still moves by {change_px:.2g} px "
                f"after {iterations} iterations"
            )
        iterations += 1
        linearised = _linearised(models, shift_px, observations, lon_lat_h)
        step_px, step_m, normal = _schur_step(linearised, shift_px, sigma_px, n_points)
        shift_px = shift_px + step_px
        lon_lat_h = move_metres(lon_lat_h, np.where(np.isfinite(step_m), step_m, 0.0))
        change_px = float(np.abs(step_px).max())
    corrected = tuple(_shifted(m, s, v) for m, s, v in zip(models, shapes, shift_px, strict=True))
    residual, _ = residuals_and_derivatives(corrected, observations, lon_lat_h)
    scale = _scale(residual, observations)
    active = _within_tolerance(residual, observations, options.tolerance * scale)
    used = replace(observations.take(active), sigma_px=observations.sigma_px[active] * scale)
    final = intersect(corrected, used, n_points)
    final_residual, _ = residuals_and_derivatives(corrected, observations, final.lon_lat_h)
    return BlockAdjustment(
        models=corrected,
        covariance_px2=np.asarray(np.linalg.inv(normal)),
        lon_lat_h=final.lon_lat_h,
        point_covariance_m2=final.covariance_m2,
        residual_px=np.where(np.isfinite(final_residual), final_residual, residual),
        active=active,
        sigma_px=scale,
        iterations=iterations,
    )


def _linearised(
    models: Sequence[SensorModel], shift_px: Array, observations: Observations, lon_lat_h: Array
) -> _Linearised:
    residual, derivative = residuals_and_derivatives(models, observations, lon_lat_h)
    residual = residual - shift_px[observations.image]
    weight = _weights(residual, observations, _scale(residual, observations))
    # Rows without a weight must not bring their NaN into the sums.
    residual, derivative = np.nan_to_num(residual), np.nan_to_num(derivative)
    return _Linearised(observations.point, observations.image, residual, derivative, weight)


def _magnitude(residual: Array, observations: Observations) -> tuple[Array, Array, IntArray]:
    """Sizes of residuals in units that do not depend on the number of rays of a point.

    A point with k rays takes three of their 2 k values: the residuals of a pair are small and
    perpendicular to the rays, whatever the error was.

    Returns:
        (m,) normalised size of every observation's residual, near 1 on average for true sigmas;
        (p,) chi2 of every point and (p,) its degrees of freedom.
    """
    chi2 = (residual**2).sum(axis=1) / observations.sigma_px**2
    finite = np.isfinite(chi2)
    n_points = int(observations.point[-1]) + 1
    rays = np.bincount(observations.point[finite], minlength=n_points)
    point_chi2 = np.bincount(observations.point[finite], chi2[finite], n_points).astype(np.float64)
    redundancy = np.maximum(2 * rays - 3, 1) / np.maximum(rays, 1)
    freedom = (2 * rays - 3).astype(np.int64)
    return np.asarray(np.sqrt(chi2 / redundancy[observations.point])), point_chi2, freedom


def _scale(residual: Array, observations: Observations) -> float:
    """Robust standard deviation of the observations in units of their sigmas."""
    _, point_chi2, freedom = _magnitude(residual, observations)
    redundant = freedom > 0
    typical = 2.0 * gammaincinv(freedom[redundant] / 2.0, 0.5)  # the median of the chi-square law
    median = np.median(np.sqrt(point_chi2[redundant] / typical))
    return max(float(median), 1e-6)


def _weights(residual: Array, observations: Observations, scale: float) -> Array:
    magnitude, _, _ = _magnitude(residual, observations)
    weight = cauchy_weights(magnitude / scale) / (scale * observations.sigma_px) ** 2
    return np.where(np.isfinite(weight), weight, 0.0)


def _within_tolerance(residual: Array, observations: Observations, tolerance: float) -> BoolArray:
    """Observations (m,) within a tolerance, of points with at least two such observations."""
    magnitude, point_chi2, _ = _magnitude(residual, observations)
    within = np.nan_to_num(magnitude, nan=np.inf) <= tolerance
    rays = np.bincount(observations.point[within], minlength=len(point_chi2))
    return np.asarray(within & (rays[observations.point] >= 2))


def _shifted(model: SensorModel, shape: tuple[int, int], shift_px: Array) -> CorrectedModel:
    frame = no_correction(shape)
    parameters = np.column_stack([shift_px, np.zeros((2, 2))])
    return CorrectedModel(model, ImageCorrection(parameters, frame.centre, frame.half_size))


@njit(cache=True)
def _eliminated(equations: _Linearised, n_points: int) -> _PointSolution:
    """The normal equations of every point alone, solved."""
    point, residual, derivative = equations.point, equations.residual, equations.derivative
    weight = equations.weight
    own = np.zeros((n_points, 3, 3))
    right = np.zeros((n_points, 3))
    for i in range(len(point)):
        if weight[i] > 0.0:
            own[point[i]] += weight[i] * (derivative[i].T @ derivative[i])
            right[point[i]] += weight[i] * (derivative[i].T @ residual[i])
    for p in range(n_points):
        scale = np.trace(own[p])
        if scale > 0.0 and np.linalg.det(own[p] / scale) > 1e-13:
            own[p] = np.linalg.inv(own[p])
        else:
            own[p] = np.nan
    return _PointSolution(own, right)


@njit(cache=True)
def _reduced(equations: _Linearised, points: _PointSolution, n_images: int) -> tuple[Array, Array]:
    """Normal matrix (2 n, 2 n) and right side (2 n,) of the shifts, with the points eliminated."""
    point, image, residual = equations.point, equations.image, equations.residual
    derivative, weight = equations.derivative, equations.weight
    normal = np.zeros((2 * n_images, 2 * n_images))
    right = np.zeros(2 * n_images)
    first = 0
    for i in range(len(point)):
        if point[i] != point[first]:
            first = i
        p = point[i]
        if weight[i] == 0.0 or np.isnan(points.inverse[p, 0, 0]):
            continue
        a = 2 * image[i]
        across = weight[i] * (derivative[i] @ points.inverse[p])
        right[a : a + 2] += weight[i] * residual[i] - across @ points.right[p]
        normal[a, a] += weight[i]
        normal[a + 1, a + 1] += weight[i]
        j = first
        while j < len(point) and point[j] == p:
            if weight[j] > 0.0:
                b = 2 * image[j]
                normal[a : a + 2, b : b + 2] -= weight[j] * (across @ derivative[j].T)
            j += 1
    return normal, right


def _translation_free(equations: _Linearised, n_images: int) -> Array:
    """Projector (2 n, 2 n) that removes the shifts that a translation of the whole block would cause.

    Tie points do not determine the position of a block. Its images see it under slightly different
    angles from edge to edge, though, and a distortion of 0.1 px would pass for a translation by metres:
    such a translation is left to the a priori sigmas alone.
    """
    moves = np.zeros((n_images, 2, 3))
    np.add.at(moves, equations.image, equations.derivative * equations.weight[:, None, None])
    total = np.bincount(equations.image, equations.weight, n_images)
    directions = (moves / np.maximum(total, 1e-300)[:, None, None]).reshape(-1, 3)
    return np.asarray(np.eye(2 * n_images) - directions @ np.linalg.pinv(directions))


def _schur_step(
    equations: _Linearised, shift_px: Array, sigma_px: Array, n_points: int
) -> tuple[Array, Array, Array]:
    """One Gauss-Newton step with the points eliminated.

    Args:
        equations: at the current shifts and points.
        shift_px: (n, 2) current shifts.
        sigma_px: (n,) their a priori standard deviations.
        n_points: number of points.

    Returns:
        Steps of the shifts (n, 2) in pixels and of the points (p, 3) in metres, and the reduced normal
        matrix (2 n, 2 n).
    """
    n_images = len(sigma_px)
    points = _eliminated(equations, n_points)
    normal, right = _reduced(equations, points, n_images)
    projector = _translation_free(equations, n_images)
    prior = np.repeat(sigma_px, 2) ** -2.0
    normal = projector @ normal @ projector + np.diag(prior)
    right = projector @ right
    step_px = np.linalg.solve(normal, right - prior * shift_px.ravel()).reshape(-1, 2).astype(np.float64)
    moved = equations.weight[:, None] * np.einsum(
        "mij,mi->mj", equations.derivative, step_px[equations.image]
    )
    point_right = points.right
    np.subtract.at(point_right, equations.point, moved)
    return step_px, np.einsum("pij,pj->pi", points.inverse, point_right), normal
