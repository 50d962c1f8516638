"""Intersection of the rays from several images: ground points with their covariance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit

from amers.services.geodesy import lon_lat_h_from_ecef, move_metres
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, IntArray, Observations

_ITERATIONS = 4


@dataclass(frozen=True)
class Intersection:
    """n ground points from m image observations.

    Attributes:
        lon_lat_h: (n, 3); NaN for points with fewer than two usable rays, or parallel ones.
        covariance_m2: (n, 3, 3) of east, north, up, from the a priori sigmas of the observations.
        residual_px: (m, 2) observed minus computed.
        rays: (n,) int64, number of usable observations.
        angle_deg: (n,) largest angle between two of the rays.
    """

    lon_lat_h: Array
    covariance_m2: Array
    residual_px: Array
    rays: IntArray
    angle_deg: Array


def intersect(models: Sequence[SensorModel], observations: Observations, n_points: int) -> Intersection:
    """The ground points where the rays of observations intersect, all points at once.

    The least-squares intersection of the lines of sight, `[sum(I - v v^T)]^-1 sum((I - v v^T) s)`, is
    the start. Gauss-Newton steps on the image residuals follow, so that the result is the most likely
    point for the given image sigmas.

    Args:
        models: one per image.
        observations: m image positions; `point` below `n_points`, ascending.
        n_points: number of points.
    """
    origin, direction = _lines_of_sight(models, observations)
    ecef, rays, angle = _meeting_points(observations.point, origin, direction, n_points)
    lon_lat_h = lon_lat_h_from_ecef(ecef)
    for _ in range(_ITERATIONS):
        residual, derivative = residuals_and_derivatives(models, observations, lon_lat_h)
        step, covariance = _gauss_newton_step(
            observations.point, observations.sigma_px, residual, derivative, n_points
        )
        lon_lat_h = move_metres(lon_lat_h, step)
    residual, _ = residuals_and_derivatives(models, observations, lon_lat_h)
    return Intersection(lon_lat_h, covariance, residual, rays, angle)


def residuals_and_derivatives(
    models: Sequence[SensorModel], observations: Observations, lon_lat_h: Array
) -> tuple[Array, Array]:
    """Observed minus computed image positions, and the derivative of the computed positions.

    Args:
        models: one per image.
        observations: m image positions.
        lon_lat_h: (n, 3) the points they refer to.

    Returns:
        (m, 2) pixels, and (m, 2, 3) pixels per metre east, north, up.
    """
    residual = np.empty((len(observations), 2))
    derivative = np.empty((len(observations), 2, 3))
    for image, model in enumerate(models):
        rows = np.flatnonzero(observations.image == image)
        ground = lon_lat_h[observations.point[rows]]
        residual[rows] = observations.line_sample[rows] - model.project(ground)
        derivative[rows] = model.project_derivative(ground)
    return residual, derivative


def _lines_of_sight(models: Sequence[SensorModel], observations: Observations) -> tuple[Array, Array]:
    origin = np.empty((len(observations), 3))
    direction = np.empty((len(observations), 3))
    for image, model in enumerate(models):
        rows = np.flatnonzero(observations.image == image)
        origin[rows], direction[rows] = model.line_of_sight(observations.line_sample[rows])
    return origin, direction


@njit(cache=True)
def _meeting_points(
    point: IntArray, origin: Array, direction: Array, n_points: int
) -> tuple[Array, IntArray, Array]:
    """Nearest points to bundles of lines, in ECEF, with the number of rays and their largest angle."""
    ecef = np.full((n_points, 3), np.nan)
    rays = np.zeros(n_points, dtype=np.int64)
    angle = np.full(n_points, np.nan)
    m = len(point)
    first = 0
    while first < m:
        last = first
        while last < m and point[last] == point[first]:
            last += 1
        normal = np.zeros((3, 3))
        right = np.zeros(3)
        count = 0
        smallest_cosine = 1.0
        for i in range(first, last):
            v = direction[i]
            if not np.isfinite(v[0] + origin[i, 0]):
                continue
            count += 1
            across = np.eye(3) - np.outer(v, v)
            normal += across
            right += across @ (origin[i] - origin[first])
            for j in range(first, i):
                cosine = abs(np.dot(v, direction[j]))
                if cosine < smallest_cosine:
                    smallest_cosine = cosine
        p = point[first]
        rays[p] = count
        if count >= 2:
            angle[p] = np.degrees(np.arccos(smallest_cosine))
            if angle[p] > 1e-3:
                ecef[p] = origin[first] + np.linalg.solve(normal, right)
        first = last
    return ecef, rays, angle


@njit(cache=True)
def _gauss_newton_step(
    point: IntArray, sigma_px: Array, residual: Array, derivative: Array, n_points: int
) -> tuple[Array, Array]:
    """Step of every point in metres east, north, up, and its covariance after the step."""
    normal = np.zeros((n_points, 3, 3))
    right = np.zeros((n_points, 3))
    for i in range(len(point)):
        if not np.isfinite(residual[i, 0] + derivative[i, 0, 0]):
            continue
        p = point[i]
        weight = 1.0 / (sigma_px[i] * sigma_px[i])
        for k in range(2):
            for a in range(3):
                right[p, a] += weight * derivative[i, k, a] * residual[i, k]
                for b in range(3):
                    normal[p, a, b] += weight * derivative[i, k, a] * derivative[i, k, b]
    step = np.full((n_points, 3), np.nan)
    covariance = np.full((n_points, 3, 3), np.nan)
    for p in range(n_points):
        scale = np.trace(normal[p])
        if scale > 0.0 and np.linalg.det(normal[p] / scale) > 1e-15:
            covariance[p] = np.linalg.inv(normal[p])
            step[p] = covariance[p] @ right[p]
    return step, covariance
