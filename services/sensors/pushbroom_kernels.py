"""Compiled computations of the pushbroom model; `services.sensors.pushbroom` explains them."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from services.geodesy import WGS84_A, WGS84_B, WGS84_E2
from services.sensors.light_path import (
    EARTH_ROTATION_RAD_S,
    height_and_vertical,
    refraction_lift_m,
)
from services.sensors.piecewise import horner, horner_with_slope, piece_at
from services.sensors.rpc import VALIDITY
from services.types import Array

_PROJECT_TOLERANCE_PX = 1e-6
"""The last secant step; its own error is a thousand times smaller."""
_PROJECT_ITERATIONS = 30
_LOOK_TOLERANCE_PX = 1e-6
_LOOK_ITERATIONS = 10
_LOCATE_TOLERANCE_M = 1e-6
"""The last Newton step; its own error is a million times smaller."""
_LOCATE_ITERATIONS = 20
_EXACT_AFTER = 2
"""Rounds in which the small effects of light are computed from a direction that contains them."""


class Packed(NamedTuple):
    """A pushbroom model as arrays and numbers.

    Attributes:
        lines, samples: size of the image.
        line_breaks, line_times, orbit_breaks, orbit, attitude_breaks, attitude, look_breaks, look:
            breaks and coefficients of the piecewise polynomials of the model.
        per_light_speed: s/m, 0 without velocity aberration.
        turn_per_m: rotation of the Earth while light travels a metre, radians; 0 without light time.
        refraction: 1, or 0 without refraction.
        ground_radius: distance of the ground at the image centre from the centre of the Earth, metres.
        guess_frame: (2, 3) centre in metres and inverse scale of ECEF positions.
        guess: (10,) quadratic polynomial from there to the line.
        line_slope: change of the misfit of `_row_misfit` per line, at the image centre.
    """

    lines: float
    samples: float
    line_breaks: Array
    line_times: Array
    orbit_breaks: Array
    orbit: Array
    attitude_breaks: Array
    attitude: Array
    look_breaks: Array
    look: Array
    per_light_speed: float
    turn_per_m: float
    refraction: float
    ground_radius: float
    guess_frame: Array
    guess: Array
    line_slope: float


@njit(cache=True, inline="always", fastmath={"contract"}, error_model="numpy")
def _pose(m: Packed, line: float, pose: Array) -> None:
    """Write the pose (5, 3) at a line: position, velocity in ECEF, and the rotation ecef_from_body.

    The velocity is right only where aberration needs it.
    """
    piece, u = piece_at(m.line_breaks, line)
    time = horner(m.line_times, piece, 0, u)
    piece, u = piece_at(m.orbit_breaks, time)
    for k in range(3):
        pose[0, k], pose[1, k] = horner_with_slope(m.orbit, piece, k, u)
    if m.per_light_speed > 0.0:
        per_s = 2.0 / (m.orbit_breaks[piece + 1] - m.orbit_breaks[piece])
        for k in range(3):
            pose[1, k] *= per_s
    piece, u = piece_at(m.attitude_breaks, time)
    x = horner(m.attitude, piece, 0, u)
    y = horner(m.attitude, piece, 1, u)
    z = horner(m.attitude, piece, 2, u)
    w = horner(m.attitude, piece, 3, u)
    scale = 1.0 / math.sqrt(x * x + y * y + z * z + w * w)
    x, y, z, w = x * scale, y * scale, z * scale, w * scale
    pose[2, 0] = 1.0 - 2.0 * (y * y + z * z)
    pose[2, 1] = 2.0 * (x * y - z * w)
    pose[2, 2] = 2.0 * (x * z + y * w)
    pose[3, 0] = 2.0 * (x * y + z * w)
    pose[3, 1] = 1.0 - 2.0 * (x * x + z * z)
    pose[3, 2] = 2.0 * (y * z - x * w)
    pose[4, 0] = 2.0 * (x * z - y * w)
    pose[4, 1] = 2.0 * (y * z + x * w)
    pose[4, 2] = 1.0 - 2.0 * (x * x + y * y)


@njit(cache=True, inline="always", fastmath={"contract"}, error_model="numpy")
def _inside(position: float, size: float) -> bool:
    """Whether a line or sample is within the model, up to half an image beyond the border."""
    return abs(position - (size - 1.0) / 2.0) <= VALIDITY * size / 2.0


@njit(cache=True, inline="always", fastmath={"contract"}, error_model="numpy")
def _aberration(
    m: Packed, pose: Array, apparent: tuple[float, float, float]
) -> tuple[float, float, float]:
    """What to add to the apparent unit direction of light to get the direction to the ground.

    The first part takes the inertial velocity of the satellite away. The second moves the ground by
    the turn of the Earth while the light travels; `s` is the distance to a sphere through the ground.
    """
    ax, ay, az = 0.0, 0.0, 0.0
    ox, oy, oz = pose[0]
    dx, dy, dz = apparent
    if m.per_light_speed > 0.0:
        ax = -m.per_light_speed * (pose[1, 0] - EARTH_ROTATION_RAD_S * oy)
        ay = -m.per_light_speed * (pose[1, 1] + EARTH_ROTATION_RAD_S * ox)
        az = -m.per_light_speed * pose[1, 2]
    if m.turn_per_m > 0.0:
        along = ox * dx + oy * dy + oz * dz
        square = along * along + m.ground_radius**2 - (ox * ox + oy * oy + oz * oz)
        s = -along - math.sqrt(max(square, 0.0))
        ax -= m.turn_per_m * (oy + s * dy)
        ay += m.turn_per_m * (ox + s * dx)
    return ax, ay, az


@njit(cache=True, inline="always", fastmath={"contract"}, error_model="numpy")
def _ray(m: Packed, line: float, sample: float, pose: Array, direction: Array) -> None:
    """Write pose (5, 3) and unit direction (3,) in ECEF of the straight ray of an image position."""
    piece, u = piece_at(m.look_breaks, sample)
    along, across = horner(m.look, piece, 0, u), horner(m.look, piece, 1, u)
    _pose(m, line, pose)
    norm = 1.0 / math.sqrt(along * along + across * across + 1.0)
    for k in range(3):
        direction[k] = norm * (pose[2 + k, 0] * along + pose[2 + k, 1] * across + pose[2 + k, 2])
    if m.per_light_speed > 0.0 or m.turn_per_m > 0.0:
        ax, ay, az = _aberration(m, pose, (direction[0], direction[1], direction[2]))
        direction[0] += ax
        direction[1] += ay
        direction[2] += az
        norm = 1.0 / math.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
        for k in range(3):
            direction[k] *= norm


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _meet_height(m: Packed, o: Array, d: Array, height: float, ground: Array) -> float:
    """Write the point (3,) in ECEF where a ray meets a height; returns tan(latitude), NaN if it misses.

    Starts from the ellipsoid whose axes are longer by the height. With refraction the point is the
    ground, below the straight ray.
    """
    per_a, per_b = 1.0 / (WGS84_A + height), 1.0 / (WGS84_B + height)
    ox, oy, oz = o[0] * per_a, o[1] * per_a, o[2] * per_b
    dx, dy, dz = d[0] * per_a, d[1] * per_a, d[2] * per_b
    square = dx * dx + dy * dy + dz * dz
    along = ox * dx + oy * dy + oz * dz
    root = along * along - square * (ox * ox + oy * oy + oz * oz - 1.0)
    if not (root >= 0.0 and height > -WGS84_B / 2.0):
        return np.nan
    distance = (-along - math.sqrt(root)) / square
    for _ in range(_LOCATE_ITERATIONS):
        x, y, z = o[0] + distance * d[0], o[1] + distance * d[1], o[2] + distance * d[2]
        h, ux, uy, uz, tan_lat = height_and_vertical(x, y, z)
        descent = -(d[0] * ux + d[1] * uy + d[2] * uz)
        if not descent > 0.0:
            return np.nan
        lift = refraction_lift_m(height, descent) if m.refraction > 0.0 else 0.0
        step = (h - height - lift) / descent
        distance += step
        if abs(step) < _LOCATE_TOLERANCE_M:
            ground[0] = x + step * d[0] - lift * ux
            ground[1] = y + step * d[1] - lift * uy
            ground[2] = z + step * d[2] - lift * uz
            return tan_lat
    return np.nan


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def line_of_sight(m: Packed, image: Array, height: float) -> tuple[Array, Array]:
    """Origins and unit directions (n, 3) of the rays of image positions (n, 2)."""
    origin = np.full((len(image), 3), np.nan)
    direction = np.full((len(image), 3), np.nan)
    pose, ground = np.empty((5, 3)), np.empty(3)
    for i in range(len(image)):
        if not (_inside(image[i, 0], m.lines) and _inside(image[i, 1], m.samples)):
            continue
        _ray(m, image[i, 0], image[i, 1], pose, direction[i])
        origin[i] = pose[0]
        if m.refraction > 0.0:
            tan_lat = _meet_height(m, origin[i], direction[i], height, ground)
            if np.isnan(tan_lat):
                origin[i] = np.nan
                direction[i] = np.nan
                continue
            _, ux, uy, uz, _ = height_and_vertical(ground[0], ground[1], ground[2])
            descent = -(direction[i, 0] * ux + direction[i, 1] * uy + direction[i, 2] * uz)
            lift = refraction_lift_m(height, descent)
            origin[i, 0] -= lift * ux
            origin[i, 1] -= lift * uy
            origin[i, 2] -= lift * uz
    return origin, direction


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def locate_ecef(m: Packed, image: Array, height: Array) -> Array:
    """Ground (n, 3) in ECEF of image positions (n, 2) at heights (n,)."""
    out = np.full((len(image), 3), np.nan)
    pose, direction = np.empty((5, 3)), np.empty(3)
    for i in range(len(image)):
        if _inside(image[i, 0], m.lines) and _inside(image[i, 1], m.samples):
            _ray(m, image[i, 0], image[i, 1], pose, direction)
            _meet_height(m, pose[0], direction, height[i], out[i])
    return out


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def locate(m: Packed, image: Array, height: Array) -> Array:
    """Longitude, latitude, height (n, 3) of image positions (n, 2) at heights (n,)."""
    out = np.full((len(image), 3), np.nan)
    pose, direction, ground = np.empty((5, 3)), np.empty(3), np.empty(3)
    for i in range(len(image)):
        if not (_inside(image[i, 0], m.lines) and _inside(image[i, 1], m.samples)):
            continue
        _ray(m, image[i, 0], image[i, 1], pose, direction)
        tan_lat = _meet_height(m, pose[0], direction, height[i], ground)
        if not np.isnan(tan_lat):
            out[i, 0] = math.degrees(math.atan2(ground[1], ground[0]))
            out[i, 1] = math.degrees(math.atan(tan_lat))
            out[i, 2] = height[i]
    return out


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _ground_point(lon_lat_h: Array, ground: Array) -> None:
    """Write ECEF position, upward unit vector and height (7,) of a ground point (3,)."""
    lon, lat = math.radians(lon_lat_h[0]), math.radians(lon_lat_h[1])
    sin_lat, cos_lat, h = math.sin(lat), math.cos(lat), lon_lat_h[2]
    ground[3] = cos_lat * math.cos(lon)
    ground[4] = cos_lat * math.sin(lon)
    ground[5] = sin_lat
    ground[6] = h
    n = WGS84_A / math.sqrt(1.0 - WGS84_E2 * sin_lat * sin_lat)
    ground[0] = (n + h) * ground[3]
    ground[1] = (n + h) * ground[4]
    ground[2] = (n * (1.0 - WGS84_E2) + h) * sin_lat


@njit(cache=True, inline="always", fastmath={"contract"}, error_model="numpy")
def _towards(m: Packed, pose: Array, ground: Array, direction: Array) -> None:
    """Write the apparent direction (3,), not of unit length, of a ground point from a pose.

    `ground` (7,) has its ECEF position, the upward unit vector there and its height.
    """
    dx, dy, dz = ground[0] - pose[0, 0], ground[1] - pose[0, 1], ground[2] - pose[0, 2]
    if m.refraction > 0.0:
        lift = 0.0
        for _ in range(_EXACT_AFTER):
            x, y, z = dx + lift * ground[3], dy + lift * ground[4], dz + lift * ground[5]
            descent = -(x * ground[3] + y * ground[4] + z * ground[5]) / math.sqrt(x * x + y * y + z * z)
            lift = refraction_lift_m(ground[6], descent)
        dx, dy, dz = dx + lift * ground[3], dy + lift * ground[4], dz + lift * ground[5]
    if m.per_light_speed > 0.0 or m.turn_per_m > 0.0:
        norm = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
        ux, uy, uz = dx * norm, dy * norm, dz * norm
        dx, dy, dz = ux, uy, uz
        for _ in range(_EXACT_AFTER):
            ax, ay, az = _aberration(m, pose, (dx, dy, dz))
            along = ux * ax + uy * ay + uz * az
            scale = along + math.sqrt(1.0 - (ax * ax + ay * ay + az * az) + along * along)
            dx, dy, dz = scale * ux - ax, scale * uy - ay, scale * uz - az
    direction[0], direction[1], direction[2] = dx, dy, dz


@njit(cache=True, inline="always", fastmath={"contract"}, error_model="numpy")
def _detector(m: Packed, across: float, start: float) -> tuple[float, float]:
    """The sample whose detector looks at a tangent across, and its tangent along."""
    sample, along = start, 0.0
    for _ in range(_LOOK_ITERATIONS):
        piece, u = piece_at(m.look_breaks, sample)
        value, slope = horner_with_slope(m.look, piece, 1, u)
        step = (across - value) / slope
        along, along_slope = horner_with_slope(m.look, piece, 0, u)
        along += step * along_slope
        step *= (m.look_breaks[piece + 1] - m.look_breaks[piece]) / 2.0
        sample += step
        if abs(step) < _LOOK_TOLERANCE_PX:
            break
    return sample, along


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def line_slope(m: Packed, line: float, ground: Array) -> float:
    """Change per line of the tangent along the track of a ground point (3,) in ECEF."""
    pose, direction = np.empty((5, 3)), np.empty(3)
    with_vertical = np.empty(7)
    with_vertical[:3] = ground
    with_vertical[6], with_vertical[3], with_vertical[4], with_vertical[5], _ = height_and_vertical(
        ground[0], ground[1], ground[2]
    )
    slope = 0.0
    for sign in (-1.0, 1.0):
        _pose(m, line + 0.5 * sign, pose)
        _towards(m, pose, with_vertical, direction)
        body = pose[2:].T @ direction
        slope += sign * body[0] / body[2]
    return slope


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def project(m: Packed, lon_lat_h: Array) -> Array:
    """Line and sample (n, 2) of ground points (n, 3)."""
    out = np.full((len(lon_lat_h), 2), np.nan)
    pose, direction = np.empty((5, 3)), np.empty(3)
    ground = np.empty(7)
    lowest = (m.lines - 1.0) / 2.0 - VALIDITY * m.lines / 2.0
    highest = (m.lines - 1.0) / 2.0 + VALIDITY * m.lines / 2.0
    g = m.guess
    middle = (m.samples - 1.0) / 2.0
    for i in range(len(lon_lat_h)):
        _ground_point(lon_lat_h[i], ground)
        x = (ground[0] - m.guess_frame[0, 0]) * m.guess_frame[1, 0]
        y = (ground[1] - m.guess_frame[0, 1]) * m.guess_frame[1, 1]
        z = (ground[2] - m.guess_frame[0, 2]) * m.guess_frame[1, 2]
        line = (
            g[0]
            + x * (g[1] + x * g[4] + y * g[5] + z * g[6])
            + y * (g[2] + y * g[7] + z * g[8])
            + z * (g[3] + z * g[9])
        )
        if not np.isfinite(line):
            continue
        line = min(max(line, lowest), highest)
        sample = middle
        last, last_misfit, slope = line, 0.0, m.line_slope
        for iteration in range(_PROJECT_ITERATIONS):
            _pose(m, line, pose)
            _towards(m, pose, ground, direction)
            bx = pose[2, 0] * direction[0] + pose[3, 0] * direction[1] + pose[4, 0] * direction[2]
            by = pose[2, 1] * direction[0] + pose[3, 1] * direction[1] + pose[4, 1] * direction[2]
            bz = pose[2, 2] * direction[0] + pose[3, 2] * direction[1] + pose[4, 2] * direction[2]
            if not bz > 0.0:
                break
            sample, along = _detector(m, by / bz, sample)
            misfit = bx / bz - along
            if iteration > 0:
                slope = (misfit - last_misfit) / (line - last)
            step = -misfit / slope
            if not np.isfinite(step):
                break
            last, last_misfit = line, misfit
            line = min(max(line + step, lowest), highest)
            if abs(step) < _PROJECT_TOLERANCE_PX:
                if _inside(sample, m.samples):
                    out[i, 0] = line
                    out[i, 1] = sample
                break
    return out


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def project_derivative(m: Packed, lon_lat_h: Array, image: Array) -> Array:
    """Derivative (n, 2, 3) of `project` by metres east, north, up, at its results (n, 2)."""
    out = np.full((len(lon_lat_h), 2, 3), np.nan)
    pose, direction = np.empty((5, 3)), np.empty(3)
    ground = np.empty(7)
    by_ground = np.empty((2, 3))
    by_image = np.empty((2, 2))
    enu = np.empty((3, 3))
    for i in range(len(lon_lat_h)):
        if np.isnan(image[i, 0]):
            continue
        _ground_point(lon_lat_h[i], ground)
        lon = math.radians(lon_lat_h[i, 0])
        enu[:, 0] = np.array([-math.sin(lon), math.cos(lon), 0.0])
        enu[:, 2] = ground[3:6]
        enu[:, 1] = np.cross(enu[:, 2], enu[:, 0])
        by_image[:] = 0.0
        for sign in (-1.0, 1.0):
            _pose(m, image[i, 0] + 0.5 * sign, pose)
            _towards(m, pose, ground, direction)
            body = pose[2:].T @ direction
            by_image[0, 0] += sign * body[0] / body[2]
            by_image[1, 0] += sign * body[1] / body[2]
        piece, u = piece_at(m.look_breaks, image[i, 1])
        per_px = 2.0 / (m.look_breaks[piece + 1] - m.look_breaks[piece])
        for k in range(2):
            by_image[k, 1] = -horner_with_slope(m.look, piece, k, u)[1] * per_px
        _pose(m, image[i, 0], pose)
        body = pose[2:].T @ (ground[:3] - pose[0])
        for k in range(2):
            by_ground[k] = (pose[2:, k] - pose[2:, 2] * body[k] / body[2]) / body[2]
        out[i] = -np.linalg.solve(by_image, by_ground @ enu)
    return out
