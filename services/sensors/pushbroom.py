"""The rigorous model of a line scanner: orbit, attitude and look directions of the detectors."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from services.geodesy import ecef_to_geodetic, geodetic_to_ecef
from services.sensors.rpc import VALIDITY
from services.types import Array

_NODES = 8
"""Samples of orbit and attitude in an interpolation, by a polynomial of degree seven."""

_PROJECT_TOLERANCE_PX = 1e-7
_PROJECT_ITERATIONS = 30
_LOCATE_TOLERANCE_M = 1e-7
_LOCATE_ITERATIONS = 20


@dataclass(frozen=True)
class PushbroomModel:
    """One row of detectors that scans the ground, line by line.

    In the body frame x points forwards, y to the right and z to the ground. The detector of a sample
    looks along `(tan_along, tan_across, 1)`; both tangents are polynomials of
    `(sample - centre) / half_width`, -1 to 1 over the row.

    Orbit and attitude are interpolated by Lagrange polynomials over eight samples; the quaternion is
    then normalised. The tables should extend half an image beyond the first and the last line, where
    the model ends.

    Attributes:
        image_shape: lines and samples.
        first_line_s: time of the centre of the first line, seconds.
        line_period_s: time from one line to the next, seconds.
        orbit_s: (m,) times of the orbit samples, seconds, increasing, at least eight.
        position: (m, 3) ECEF metres.
        attitude_s: (k,) times of the attitude samples, seconds, increasing, at least eight.
        ecef_from_body: (k, 4) unit quaternions x, y, z, w, without changes of sign.
        look: (2, degree + 1) coefficients of `tan_along` and `tan_across`, constant first.
        height_range_m: lowest and highest ground the model is meant for, metres above the ellipsoid.
    """

    image_shape: tuple[int, int]
    first_line_s: float
    line_period_s: float
    orbit_s: Array
    position: Array
    attitude_s: Array
    ecef_from_body: Array
    look: Array
    height_range_m: tuple[float, float]

    def project(self, lon_lat_h: Array) -> Array:
        """Image position of ground points, by secant steps on the line until 1e-7 px.

        Args:
            lon_lat_h: (n, 3) degrees, degrees, metres.

        Returns:
            (n, 2) line, sample in pixels; NaN more than half an image beyond the border.
        """
        return _project(_packed(self), np.ascontiguousarray(lon_lat_h, dtype=np.float64))

    def project_derivative(self, lon_lat_h: Array) -> Array:
        """Derivative of `project`, from the implicit equations of the projection.

        Returns:
            (n, 2, 3) pixels per metre east, north, up; NaN where `project` is.
        """
        ground = np.ascontiguousarray(lon_lat_h, dtype=np.float64)
        packed = _packed(self)
        return _project_derivative(packed, ground, _project(packed, ground))

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        """Ground position of image points at given heights, by Newton steps along the line of sight.

        Args:
            line_sample: (n, 2) pixels.
            height_m: (n,) metres above the ellipsoid.

        Returns:
            (n, 3) lon, lat, height; NaN where the line of sight misses that height, or more than half
            an image beyond the border.
        """
        origin, direction = self.line_of_sight(line_sample)
        return _intersect_height(origin, direction, np.ascontiguousarray(height_m, dtype=np.float64))

    def line_of_sight(self, line_sample: Array) -> tuple[Array, Array]:
        """The exact lines of sight.

        Returns:
            Origin (n, 3) ECEF metres, on the orbit, and unit direction (n, 3) downwards; NaN more than
            half an image beyond the border.
        """
        return _line_of_sight(_packed(self), np.ascontiguousarray(line_sample, dtype=np.float64))


def _packed(model: PushbroomModel) -> tuple[Any, ...]:
    """The model as a tuple of arrays for the kernels."""
    lines, samples = model.image_shape
    return (
        np.array([lines, samples, model.first_line_s, model.line_period_s], dtype=np.float64),
        np.ascontiguousarray(model.orbit_s, dtype=np.float64),
        np.ascontiguousarray(model.position, dtype=np.float64),
        np.ascontiguousarray(model.attitude_s, dtype=np.float64),
        np.ascontiguousarray(model.ecef_from_body, dtype=np.float64),
        np.ascontiguousarray(model.look, dtype=np.float64),
    )


@njit(cache=True)
def _interpolate(times: Array, values: Array, t: float, out: Array) -> None:
    """Write into `out` the Lagrange polynomial over the eight samples around time t."""
    first = min(max(int(np.searchsorted(times, t)) - _NODES // 2, 0), len(times) - _NODES)
    out[:] = 0.0
    for i in range(first, first + _NODES):
        weight = 1.0
        for j in range(first, first + _NODES):
            if j != i:
                weight *= (t - times[j]) / (times[i] - times[j])
        for k in range(len(out)):
            out[k] += weight * values[i, k]


@njit(cache=True)
def _pose(model: Any, line: float, position: Array, rotation: Array) -> None:
    """Write into `position` (3,) and `rotation` (3, 3) the position and ecef_from_body at a line."""
    scalars, orbit_s, orbit, attitude_s, attitude, _ = model
    t = scalars[2] + line * scalars[3]
    _interpolate(orbit_s, orbit, t, position)
    quaternion = np.empty(4)
    _interpolate(attitude_s, attitude, t, quaternion)
    x, y, z, w = quaternion / np.sqrt((quaternion * quaternion).sum())
    rotation[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    rotation[0, 1] = 2.0 * (x * y - z * w)
    rotation[0, 2] = 2.0 * (x * z + y * w)
    rotation[1, 0] = 2.0 * (x * y + z * w)
    rotation[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    rotation[1, 2] = 2.0 * (y * z - x * w)
    rotation[2, 0] = 2.0 * (x * z - y * w)
    rotation[2, 1] = 2.0 * (y * z + x * w)
    rotation[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True)
def _tangent(coefficients: Array, t: float) -> tuple[float, float]:
    """Value and derivative of one look polynomial."""
    value = 0.0
    slope = 0.0
    for c in coefficients[::-1]:
        slope = slope * t + value
        value = value * t + c
    return value, slope


@njit(cache=True)
def _inside(position: float, size: float) -> bool:
    """Whether a line or sample is within the model, up to half an image beyond the border."""
    return abs(position - (size - 1.0) / 2.0) <= VALIDITY * size / 2.0


@njit(cache=True)
def _line_of_sight(model: Any, image: Array) -> tuple[Array, Array]:
    scalars, look = model[0], model[5]
    origin = np.full((len(image), 3), np.nan)
    direction = np.full((len(image), 3), np.nan)
    position = np.empty(3)
    rotation = np.empty((3, 3))
    for i in range(len(image)):
        line, sample = image[i]
        if not (_inside(line, scalars[0]) and _inside(sample, scalars[1])):
            continue
        t = (sample - (scalars[1] - 1.0) / 2.0) / (scalars[1] / 2.0)
        along, _ = _tangent(look[0], t)
        across, _ = _tangent(look[1], t)
        _pose(model, line, position, rotation)
        norm = np.sqrt(along * along + across * across + 1.0)
        for k in range(3):
            origin[i, k] = position[k]
            direction[i, k] = (rotation[k, 0] * along + rotation[k, 1] * across + rotation[k, 2]) / norm
    return origin, direction


@njit(cache=True)
def _intersect_height(origin: Array, direction: Array, height: Array) -> Array:
    """Intersection (n, 3) of lines of sight with given heights above the ellipsoid."""
    out = np.full((len(origin), 3), np.nan)
    for i in range(len(origin)):
        ox, oy, oz = origin[i]
        dx, dy, dz = direction[i]
        distance = 0.0
        for _ in range(_LOCATE_ITERATIONS):
            lon, lat, h = ecef_to_geodetic(ox + distance * dx, oy + distance * dy, oz + distance * dz)
            sin_lat, cos_lat = np.sin(np.radians(lat)), np.cos(np.radians(lat))
            sin_lon, cos_lon = np.sin(np.radians(lon)), np.cos(np.radians(lon))
            descent = -(dx * cos_lat * cos_lon + dy * cos_lat * sin_lon + dz * sin_lat)
            if not descent > 0.0:
                break
            step = (h - height[i]) / descent
            distance += step
            if abs(step) < _LOCATE_TOLERANCE_M:
                out[i, 0] = lon
                out[i, 1] = lat
                out[i, 2] = height[i]
                break
    return out


@njit(cache=True)
def _row_misfit(
    model: Any, line: float, ground: Array, position: Array, rotation: Array
) -> tuple[float, float]:
    """Distance of a ground point ahead of the row of detectors, and its position along the row.

    The first is a tangent; the second is -1 to 1 over the row.
    """
    look = model[5]
    _pose(model, line, position, rotation)
    body = rotation.T @ (ground - position)
    if not body[2] > 0.0:
        return np.nan, np.nan
    across = body[1] / body[2]
    t = 0.0
    for _ in range(10):
        value, slope = _tangent(look[1], t)
        step = (across - value) / slope
        t += step
        if abs(step) < 1e-14:
            break
    along, _ = _tangent(look[0], t)
    return body[0] / body[2] - along, t


@njit(cache=True, error_model="numpy")
def _project(model: Any, ground: Array) -> Array:
    scalars = model[0]
    lines, samples = scalars[0], scalars[1]
    out = np.full((len(ground), 2), np.nan)
    position = np.empty(3)
    rotation = np.empty((3, 3))
    point = np.empty(3)
    lowest = (lines - 1.0) / 2.0 - VALIDITY * lines / 2.0
    highest = (lines - 1.0) / 2.0 + VALIDITY * lines / 2.0
    for i in range(len(ground)):
        point[0], point[1], point[2] = geodetic_to_ecef(ground[i, 0], ground[i, 1], ground[i, 2])
        last = (lines - 1.0) / 2.0
        line = last + 0.1 * lines
        last_misfit, _ = _row_misfit(model, last, point, position, rotation)
        for _ in range(_PROJECT_ITERATIONS):
            misfit, t = _row_misfit(model, line, point, position, rotation)
            step = -misfit * (line - last) / (misfit - last_misfit)
            if not np.isfinite(step):
                break
            last, last_misfit = line, misfit
            line = min(max(line + step, lowest), highest)
            if abs(step) < _PROJECT_TOLERANCE_PX:
                sample = (samples - 1.0) / 2.0 + t * samples / 2.0
                if _inside(sample, samples):
                    out[i, 0] = line
                    out[i, 1] = sample
                break
    return out


@njit(cache=True, error_model="numpy")
def _project_derivative(model: Any, ground: Array, image: Array) -> Array:
    scalars, look = model[0], model[5]
    out = np.full((len(ground), 2, 3), np.nan)
    position = np.empty(3)
    rotation = np.empty((3, 3))
    point = np.empty(3)
    by_ground = np.empty((2, 3))
    by_image = np.empty((2, 2))
    enu = np.empty((3, 3))
    for i in range(len(ground)):
        if np.isnan(image[i, 0]):
            continue
        point[0], point[1], point[2] = geodetic_to_ecef(ground[i, 0], ground[i, 1], ground[i, 2])
        for k in range(2):
            _pose(model, image[i, 0] + 0.5 - k, position, rotation)
            body = rotation.T @ (point - position)
            sign = 1.0 - 2.0 * k
            by_image[0, 0] = (by_image[0, 0] if k else 0.0) + sign * body[0] / body[2]
            by_image[1, 0] = (by_image[1, 0] if k else 0.0) + sign * body[1] / body[2]
        t = (image[i, 1] - (scalars[1] - 1.0) / 2.0) / (scalars[1] / 2.0)
        for k in range(2):
            _, slope = _tangent(look[k], t)
            by_image[k, 1] = -slope / (scalars[1] / 2.0)
        _pose(model, image[i, 0], position, rotation)
        body = rotation.T @ (point - position)
        lon, lat = np.radians(ground[i, 0]), np.radians(ground[i, 1])
        enu[:, 0] = np.array([-np.sin(lon), np.cos(lon), 0.0])
        enu[:, 1] = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
        enu[:, 2] = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        for k in range(2):
            by_ground[k] = (rotation[:, k] - rotation[:, 2] * body[k] / body[2]) / body[2]
        out[i] = -np.linalg.solve(by_image, by_ground @ enu)
    return out
