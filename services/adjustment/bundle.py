"""One adjustment for all images of a block: tie points in, a correction for every image out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
        tolerance: an observation leaves at the end when its residual exceeds so many of them.
        max_iterations: before the adjustment is said not to converge.
        converged_px: largest change of a correction at which it has.
        min_points: tie points needed.
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
        point_covariance_m2: (p, 3, 3) east, north, up, as if the corrections were exact: it is
            relative to the frame of the block.
        residual_px: (m, 2) observed minus computed.
        active: (m,) observations within tolerance, of points that two such observations hold.
        sigma_px: a posteriori standard deviation of an observation with an a priori sigma of one.
        iterations: how many it took.
    """

    models: tuple[CorrectedModel, ...]
    covariance_px2: Array
    lon_lat_h: Array
    point_covariance_m2: Array
    residual_px: Array
    active: BoolArray
    sigma_px: float
    iterations: int


def adjust_block(
    models: Sequence[SensorModel],
    shapes: Sequence[tuple[int, int]],
    observations: Observations,
    sigma_px: Array,
    options: BlockOptions = BlockOptions(),
) -> BlockAdjustment:
    """Shift every image so that the rays of all tie points meet.

    Gauss-Newton on image residuals; the points are eliminated (Schur complement), Cauchy weights are
    renewed at every step with the robust scale of the residuals. The a priori sigmas of the images hold
    what tie points cannot: the frame of the whole block, and the parallax of pairs.

    Args:
        models: one per image, as delivered.
        shapes: lines and samples of the images.
        observations: m image positions of tie points, by point.
        sigma_px: (n,) how far each image may be shifted, one standard deviation, pixels.
        options: thresholds.

    Raises:
        NotEnoughPoints: when too few tie points can be intersected.
        NoConvergence: when the corrections do not settle.
    """
    n_points = int(observations.point[-1]) + 1 if len(observations) else 0
    lon_lat_h = intersect(models, observations, n_points).lon_lat_h
    found = int(np.isfinite(lon_lat_h[:, 0]).sum())
    if found < options.min_points:
        raise NotEnoughPoints(found, options.min_points, f"tie points between {len(models)} images")
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
        residual, derivative = _linearised(models, shift_px, observations, lon_lat_h)
        scale = _scale(residual, observations)
        weight = _weights(residual, observations, scale)
        step_px, step_m, normal = _schur_step(
            observations,
            residual,
            derivative,
            weight,
            shift_px,
            sigma_px,
            n_points,
        )
        shift_px = shift_px + step_px
        lon_lat_h = move_metres(lon_lat_h, np.where(np.isfinite(step_m), step_m, 0.0))
        change_px = float(np.abs(step_px).max())
    return _finished(models, shapes, observations, shift_px, lon_lat_h, normal, options, iterations)


def _linearised(
    models: Sequence[SensorModel], shift_px: Array, observations: Observations, lon_lat_h: Array
) -> tuple[Array, Array]:
    residual, derivative = residuals_and_derivatives(models, observations, lon_lat_h)
    return residual - shift_px[observations.image], derivative


def _magnitude(residual: Array, observations: Observations) -> tuple[Array, Array, IntArray]:
    """Sizes of residuals in units that do not depend on how many rays a point has.

    A point takes three of the 2 k values its k rays bring: what is left in a pair is small and points
    across the rays, whatever the error was.

    Returns:
        (m,) normalised size of every observation's residual, near 1 on average for sigmas that are true;
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
    held = freedom > 0
    typical = 2.0 * gammaincinv(freedom[held] / 2.0, 0.5)  # the median of the chi-square law
    median = np.median(np.sqrt(point_chi2[held] / typical))
    return max(float(median), 1e-6)


def _weights(residual: Array, observations: Observations, scale: float) -> Array:
    magnitude, _, _ = _magnitude(residual, observations)
    weight = cauchy_weights(magnitude / scale) / (scale * observations.sigma_px) ** 2
    return np.where(np.isfinite(weight), weight, 0.0)


def _finished(
    models: Sequence[SensorModel],
    shapes: Sequence[tuple[int, int]],
    observations: Observations,
    shift_px: Array,
    lon_lat_h: Array,
    normal: Array,
    options: BlockOptions,
    iterations: int,
) -> BlockAdjustment:
    """The block after its last step, with what is left out of tolerance marked."""
    corrected = tuple(_shifted(m, s, v) for m, s, v in zip(models, shapes, shift_px, strict=True))
    residual, _ = residuals_and_derivatives(corrected, observations, lon_lat_h)
    scale = _scale(residual, observations)
    magnitude, _, _ = _magnitude(residual, observations)
    active = np.nan_to_num(magnitude, nan=np.inf) <= options.tolerance * scale
    rays = np.bincount(observations.point[active], minlength=len(lon_lat_h))
    active &= rays[observations.point] >= 2
    kept = replace(observations.take(active), sigma_px=observations.sigma_px[active] * scale)
    again = intersect(corrected, kept, len(lon_lat_h))
    final, _ = residuals_and_derivatives(corrected, observations, again.lon_lat_h)
    return BlockAdjustment(
        models=corrected,
        covariance_px2=np.asarray(np.linalg.inv(normal)),
        lon_lat_h=again.lon_lat_h,
        point_covariance_m2=again.covariance_m2,
        residual_px=np.where(np.isfinite(final), final, residual),
        active=active,
        sigma_px=scale,
        iterations=iterations,
    )


def _shifted(model: SensorModel, shape: tuple[int, int], shift_px: Array) -> CorrectedModel:
    frame = no_correction(shape)
    parameters = np.column_stack([shift_px, np.zeros((2, 2))])
    return CorrectedModel(model, ImageCorrection(parameters, frame.centre, frame.half_size))


@njit(cache=True)
def _eliminated(
    point: IntArray, residual: Array, derivative: Array, weight: Array, n_points: int
) -> tuple[Array, Array]:
    """Inverse normal matrix (p, 3, 3) and right side (p, 3) of every point by itself."""
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
    return own, right


@njit(cache=True)
def _reduced(
    point: IntArray,
    image: IntArray,
    residual: Array,
    derivative: Array,
    weight: Array,
    inverse: Array,
    point_right: Array,
    n_images: int,
) -> tuple[Array, Array]:
    """Normal matrix (2 n, 2 n) and right side (2 n,) of the shifts once the points are eliminated."""
    normal = np.zeros((2 * n_images, 2 * n_images))
    right = np.zeros(2 * n_images)
    first = 0
    for i in range(len(point)):
        if point[i] != point[first]:
            first = i
        p = point[i]
        if weight[i] == 0.0 or np.isnan(inverse[p, 0, 0]):
            continue
        a = 2 * image[i]
        across = weight[i] * (derivative[i] @ inverse[p])
        right[a : a + 2] += weight[i] * residual[i] - across @ point_right[p]
        normal[a, a] += weight[i]
        normal[a + 1, a + 1] += weight[i]
        j = first
        while j < len(point) and point[j] == p:
            if weight[j] > 0.0:
                b = 2 * image[j]
                normal[a : a + 2, b : b + 2] -= weight[j] * (across @ derivative[j].T)
            j += 1
    return normal, right


def _translation_free(image: IntArray, derivative: Array, weight: Array, n_images: int) -> Array:
    """Projector (2 n, 2 n) that takes out of shifts what moving the whole block on the ground would do.

    Tie points cannot tell where a block is. Its images see it under slightly different angles from
    edge to edge, though, and a distortion of a tenth of a pixel would pass for a move by metres: such a
    move is left to the a priori sigmas alone.
    """
    moves = np.zeros((n_images, 2, 3))
    np.add.at(moves, image, derivative * weight[:, None, None])
    total = np.bincount(image, weight, n_images)
    directions = (moves / np.maximum(total, 1e-300)[:, None, None]).reshape(-1, 3)
    return np.asarray(np.eye(2 * n_images) - directions @ np.linalg.pinv(directions))


def _schur_step(
    observations: Observations,
    residual: Array,
    derivative: Array,
    weight: Array,
    shift_px: Array,
    sigma_px: Array,
    n_points: int,
) -> tuple[Array, Array, Array]:
    """One Gauss-Newton step with the points eliminated.

    Returns:
        Steps of the shifts (n, 2) in pixels and of the points (p, 3) in metres, and the reduced normal
        matrix (2 n, 2 n).
    """
    point, image = observations.point, observations.image
    # Rows without a weight must not bring their NaN into the sums.
    residual, derivative = np.nan_to_num(residual), np.nan_to_num(derivative)
    inverse, point_right = _eliminated(point, residual, derivative, weight, n_points)
    normal, right = _reduced(
        point, image, residual, derivative, weight, inverse, point_right, len(sigma_px)
    )
    held = _translation_free(image, derivative, weight, len(sigma_px))
    prior = np.repeat(sigma_px, 2) ** -2.0
    normal = held @ normal @ held + np.diag(prior)
    right = held @ right
    step_px = np.linalg.solve(normal, right - prior * shift_px.ravel()).reshape(-1, 2).astype(np.float64)
    moved = weight[:, None] * np.einsum("mij,mi->mj", derivative, step_px[image])
    np.subtract.at(point_right, point, moved)
    return step_px, np.einsum("pij,pj->pi", inverse, point_right), normal
