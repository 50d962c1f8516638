"""Compiled computations of the pushbroom model; `amers.services.sensors.pushbroom` explains them."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from amers.services.geodesy import WGS84_A, WGS84_B, WGS84_E2
from amers.services.sensors.light_path import (
    EARTH_ROTATION_RAD_S,
    height_and_vertical,
    zenith_path_excess_m,
)
from amers.services.sensors.piecewise import (
    Pieces,
    half_width,
    horner,
    horner_with_slope,
    piece_at,
)
from amers.services.sensors.rpc import VALIDITY, cubic
from amers.services.types import Array

_PROJECT_TOLERANCE_PX = 1e-3
"""The last secant step; its own error is a thousand times smaller, or more."""
_MOVED_PX = 1e-5
"""A shorter step gives no slope, for rounding."""
_PROJECT_ITERATIONS = 30
_LOOK_TOLERANCE_PX = 1e-6
_LOOK_ITERATIONS = 10
_LOCATE_TOLERANCE_M = 1e-6
"""The last Newton step; its own error is a million times smaller."""
_LOCATE_ITERATIONS = 20
_LIGHT_ROUNDS = 2
"""Rounds in which the effects of light are computed from a direction that contains them."""


class Packed(NamedTuple):
    """The numbers of a pushbroom model; its polynomials are in a table, an array beside this tuple.

    Attributes:
        lines, samples: size of the image.
        line_time, orbit, attitude, look: the piecewise polynomials of the model.
        per_light_speed: s/m, 0 without velocity aberration.
        turn_per_m: rotation of the Earth while light travels a metre, radians; 0 without light time.
        refraction: 1, or 0 without refraction.
        ground_radius: distance of the ground at the image centre from the centre of the Earth, metres.
        guess: where the table has a cubic polynomial from ECEF to the line, as `rpc.cubic_terms`.
        guess_centre, guess_per_m: centre and scale of its variables, metres and 1/m.
        line_slope: change per line of the tangent along the track of the ground at the image centre.
    """

    lines: float
    samples: float
    line_time: Pieces
    orbit: Pieces
    attitude: Pieces
    look: Pieces
    per_light_speed: float
    turn_per_m: float
    refraction: float
    ground_radius: float
    guess: int
    guess_centre: tuple[float, float, float]
    guess_per_m: tuple[float, float, float]
    line_slope: float


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _pose(m: Packed, table: Array, line: float, pose: Array) -> None:
    """Write the pose (5, 3) at a line: position, velocity in ECEF, and the rotation ecef_from_body.

    The velocity is written only where aberration needs it.
    """
    piece, u = piece_at(table, m.line_time, line)
    time = horner(table, m.line_time, piece, 0, u)
    piece, u = piece_at(table, m.orbit, time)
    if m.per_light_speed > 0.0:
        per_s = 1.0 / half_width(table, m.orbit, piece)
        for k in range(3):
            pose[0, k], slope = horner_with_slope(table, m.orbit, piece, k, u)
            pose[1, k] = slope * per_s
    else:
        for k in range(3):
            pose[0, k] = horner(table, m.orbit, piece, k, u)
    piece, u = piece_at(table, m.attitude, time)
    x = horner(table, m.attitude, piece, 0, u)
    y = horner(table, m.attitude, piece, 1, u)
    z = horner(table, m.attitude, piece, 2, u)
    w = horner(table, m.attitude, piece, 3, u)
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


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _inside(position: float, size: float) -> bool:
    """Whether a line or sample is within the model, up to half an image beyond the border."""
    return abs(position - (size - 1.0) / 2.0) <= VALIDITY * size / 2.0


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _aberration(
    m: Packed, pose: Array, apparent: tuple[float, float, float]
) -> tuple[float, float, float]:
    """What to add to the apparent unit direction of light to get the direction to the ground.

    The first part takes the inertial velocity of the satellite away. The second moves the ground by
    the turn of the Earth while the light travels; `s` is the distance to a sphere through the ground.
    """
    ax, ay, az = 0.0, 0.0, 0.0
    ox, oy, oz = pose[0, 0], pose[0, 1], pose[0, 2]
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


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _ray(
    m: Packed, table: Array, line_sample: tuple[float, float], pose: Array, direction: Array
) -> None:
    """Write pose (5, 3) and unit direction (3,) in ECEF of the straight ray of an image position."""
    piece, u = piece_at(table, m.look, line_sample[1])
    along, across = horner(table, m.look, piece, 0, u), horner(table, m.look, piece, 1, u)
    _pose(m, table, line_sample[0], pose)
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
    excess_m = zenith_path_excess_m(height) if m.refraction > 0.0 else 0.0
    for _ in range(_LOCATE_ITERATIONS):
        x, y, z = o[0] + distance * d[0], o[1] + distance * d[1], o[2] + distance * d[2]
        h, ux, uy, uz, tan_lat = height_and_vertical(x, y, z)
        descent = -(d[0] * ux + d[1] * uy + d[2] * uz)
        if not descent > 0.0:
            return np.nan
        lift = excess_m / (descent * descent)
        step = (h - height - lift) / descent
        distance += step
        if abs(step) < _LOCATE_TOLERANCE_M:
            ground[0] = x + step * d[0] - lift * ux
            ground[1] = y + step * d[1] - lift * uy
            ground[2] = z + step * d[2] - lift * uz
            return tan_lat
    return np.nan


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def line_of_sight(m: Packed, table: Array, image: Array, height: float) -> tuple[Array, Array]:
    """Origins and unit directions (n, 3) of the rays of image positions (n, 2)."""
    origin = np.full((len(image), 3), np.nan)
    direction = np.full((len(image), 3), np.nan)
    pose, ground = np.empty((5, 3)), np.empty(3)
    for i in range(len(image)):
        if not (_inside(image[i, 0], m.lines) and _inside(image[i, 1], m.samples)):
            continue
        _ray(m, table, (image[i, 0], image[i, 1]), pose, direction[i])
        origin[i] = pose[0]
        if m.refraction > 0.0:
            tan_lat = _meet_height(m, origin[i], direction[i], height, ground)
            if np.isnan(tan_lat):
                origin[i] = np.nan
                direction[i] = np.nan
                continue
            _, ux, uy, uz, _ = height_and_vertical(ground[0], ground[1], ground[2])
            descent = -(direction[i, 0] * ux + direction[i, 1] * uy + direction[i, 2] * uz)
            lift = zenith_path_excess_m(height) / (descent * descent)
            origin[i, 0] -= lift * ux
            origin[i, 1] -= lift * uy
            origin[i, 2] -= lift * uz
    return origin, direction


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def locate_ecef(m: Packed, table: Array, image: Array, height: Array) -> Array:
    """Ground (n, 3) in ECEF of image positions (n, 2) at heights (n,)."""
    out = np.full((len(image), 3), np.nan)
    pose, direction = np.empty((5, 3)), np.empty(3)
    for i in range(len(image)):
        if _inside(image[i, 0], m.lines) and _inside(image[i, 1], m.samples):
            _ray(m, table, (image[i, 0], image[i, 1]), pose, direction)
            _meet_height(m, pose[0], direction, height[i], out[i])
    return out


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def locate(m: Packed, table: Array, image: Array, height: Array) -> Array:
    """Longitude, latitude, height (n, 3) of image positions (n, 2) at heights (n,)."""
    out = np.full((len(image), 3), np.nan)
    pose, direction, ground = np.empty((5, 3)), np.empty(3), np.empty(3)
    for i in range(len(image)):
        if not (_inside(image[i, 0], m.lines) and _inside(image[i, 1], m.samples)):
            continue
        _ray(m, table, (image[i, 0], image[i, 1]), pose, direction)
        tan_lat = _meet_height(m, pose[0], direction, height[i], ground)
        if not np.isnan(tan_lat):
            out[i, 0] = math.degrees(math.atan2(ground[1], ground[0]))
            out[i, 1] = math.degrees(math.atan(tan_lat))
            out[i, 2] = height[i]
    return out


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _ground_point(m: Packed, lon_lat_h: Array, ground: Array) -> None:
    """Write ECEF position, upward unit vector and excess path of refraction (7,) of a ground point."""
    lon, lat = math.radians(lon_lat_h[0]), math.radians(lon_lat_h[1])
    sin_lat, cos_lat, h = math.sin(lat), math.cos(lat), lon_lat_h[2]
    ground[3] = cos_lat * math.cos(lon)
    ground[4] = cos_lat * math.sin(lon)
    ground[5] = sin_lat
    ground[6] = zenith_path_excess_m(h) if m.refraction > 0.0 else 0.0
    n = WGS84_A / math.sqrt(1.0 - WGS84_E2 * sin_lat * sin_lat)
    ground[0] = (n + h) * ground[3]
    ground[1] = (n + h) * ground[4]
    ground[2] = (n * (1.0 - WGS84_E2) + h) * sin_lat


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _light_shift(m: Packed, pose: Array, ground: Array, shift: Array) -> None:
    """Write the vector (3,) in metres from a ground point to where it appears from a pose.

    `ground` is that of `_ground_point`. The shift varies so slowly along the orbit that `project`
    computes it in its first steps only.
    """
    ox, oy, oz = ground[0] - pose[0, 0], ground[1] - pose[0, 1], ground[2] - pose[0, 2]
    dx, dy, dz = ox, oy, oz
    if m.refraction > 0.0:
        lift = 0.0
        for _ in range(_LIGHT_ROUNDS):
            dx, dy, dz = ox + lift * ground[3], oy + lift * ground[4], oz + lift * ground[5]
            descent = -(dx * ground[3] + dy * ground[4] + dz * ground[5])
            lift = ground[6] * (dx * dx + dy * dy + dz * dz) / (descent * descent)
        dx, dy, dz = ox + lift * ground[3], oy + lift * ground[4], oz + lift * ground[5]
    if m.per_light_speed > 0.0 or m.turn_per_m > 0.0:
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        ux, uy, uz = dx / distance, dy / distance, dz / distance
        dx, dy, dz = ux, uy, uz
        for _ in range(_LIGHT_ROUNDS):
            ax, ay, az = _aberration(m, pose, (dx, dy, dz))
            along = ux * ax + uy * ay + uz * az
            scale = along + math.sqrt(1.0 - (ax * ax + ay * ay + az * az) + along * along)
            dx, dy, dz = scale * ux - ax, scale * uy - ay, scale * uz - az
        dx, dy, dz = distance * dx, distance * dy, distance * dz
    shift[0], shift[1], shift[2] = dx - ox, dy - oy, dz - oz


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _in_body(pose: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A direction in ECEF in the body frame of a pose."""
    return (
        pose[2, 0] * x + pose[3, 0] * y + pose[4, 0] * z,
        pose[2, 1] * x + pose[3, 1] * y + pose[4, 1] * z,
        pose[2, 2] * x + pose[3, 2] * y + pose[4, 2] * z,
    )


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _guess(m: Packed, table: Array, ground: Array) -> float:
    """The line of a ground point by the cubic polynomial of the model."""
    x = (ground[0] - m.guess_centre[0]) * m.guess_per_m[0]
    y = (ground[1] - m.guess_centre[1]) * m.guess_per_m[1]
    z = (ground[2] - m.guess_centre[2]) * m.guess_per_m[2]
    return cubic(table, m.guess, x, y, z)


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _detector(m: Packed, table: Array, across: float, start: float) -> tuple[float, float]:
    """The sample whose detector looks at a tangent across, and its tangent along."""
    sample, along = start, 0.0
    for _ in range(_LOOK_ITERATIONS):
        piece, u = piece_at(table, m.look, sample)
        value, slope = horner_with_slope(table, m.look, piece, 1, u)
        step = (across - value) / slope
        along, along_slope = horner_with_slope(table, m.look, piece, 0, u)
        along += step * along_slope
        step *= half_width(table, m.look, piece)
        sample += step
        if abs(step) < _LOOK_TOLERANCE_PX:
            break
    return sample, along


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def line_slope(m: Packed, table: Array, line: float, ground: Array) -> float:
    """Change per line of the tangent along the track of a ground point (3,) in ECEF, without light."""
    pose, shift = np.empty((5, 3)), np.zeros(3)
    slope = 0.0
    for sign in (-1.0, 1.0):
        _pose(m, table, line + 0.5 * sign, pose)
        slope += sign * _tangents(pose, ground, shift)[0]
    return slope


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _tangents(pose: Array, ground: Array, shift: Array) -> tuple[float, float]:
    """Tangents along and across of a ground point, moved by light, from a pose; NaN if behind it."""
    along, across, depth = _in_body(
        pose,
        ground[0] - pose[0, 0] + shift[0],
        ground[1] - pose[0, 1] + shift[1],
        ground[2] - pose[0, 2] + shift[2],
    )
    if not depth > 0.0:
        return np.nan, np.nan
    return along / depth, across / depth


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def _project_one(
    m: Packed, table: Array, ground: Array, pose: Array, shift: Array
) -> tuple[float, float]:
    """Line and sample of a ground point, NaN where the secant steps leave the model.

    The effects of light change so slowly along the orbit that the first steps compute them.
    """
    middle, reach = (m.lines - 1.0) / 2.0, VALIDITY * m.lines / 2.0
    line = min(max(_guess(m, table, ground), middle - reach), middle + reach)
    sample = (m.samples - 1.0) / 2.0
    last, last_sample, last_misfit, slope = line, sample, 0.0, m.line_slope
    for iteration in range(_PROJECT_ITERATIONS):
        _pose(m, table, line, pose)
        if iteration < _LIGHT_ROUNDS:
            _light_shift(m, pose, ground, shift)
        along, across = _tangents(pose, ground, shift)
        sample, own_along = _detector(m, table, across, sample)
        misfit = along - own_along
        moved = line - last
        if abs(moved) > _MOVED_PX:
            slope = (misfit - last_misfit) / moved
        step = -misfit / slope
        if not np.isfinite(step):
            break
        if iteration > 0 and abs(step) < _PROJECT_TOLERANCE_PX:
            if abs(moved) > _MOVED_PX:
                sample += step * (sample - last_sample) / moved
            return line + step, sample
        last, last_sample, last_misfit = line, sample, misfit
        line = min(max(line + step, middle - reach), middle + reach)
    return np.nan, np.nan


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def project(m: Packed, table: Array, lon_lat_h: Array) -> Array:
    """Line and sample (n, 2) of ground points (n, 3)."""
    out = np.full((len(lon_lat_h), 2), np.nan)
    ground, pose, shift = np.empty(7), np.empty((5, 3)), np.zeros(3)
    for i in range(len(lon_lat_h)):
        if math.isfinite(lon_lat_h[i, 0] + lon_lat_h[i, 1] + lon_lat_h[i, 2]):
            _ground_point(m, lon_lat_h[i], ground)
            line, sample = _project_one(m, table, ground, pose, shift)
            if _inside(line, m.lines) and _inside(sample, m.samples):
                out[i, 0] = line
                out[i, 1] = sample
    return out


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def project_derivative(m: Packed, table: Array, lon_lat_h: Array, image: Array) -> tuple[Array, Array]:
    """Derivatives of `project` at its results (n, 2): (n, 2, 3) by metres east, north, up, and (n, 2, 2)
    by the tangents along and across under which the ground is seen.

    The tangents along and across of a ground point equal those of its detector: their derivatives by the
    ground, by the line (a difference over one line) and by the sample give that of the position.
    """
    out, by_tangents = np.full((len(lon_lat_h), 2, 3), np.nan), np.full((len(lon_lat_h), 2, 2), np.nan)
    pose, ground, shift, axis = np.empty((5, 3)), np.empty(7), np.zeros(3), np.empty((3, 3))
    for i in range(len(lon_lat_h)):
        if np.isnan(image[i, 0]):
            continue
        _ground_point(m, lon_lat_h[i], ground)
        along_line, across_line = 0.0, 0.0
        for sign in (-1.0, 1.0):
            _pose(m, table, image[i, 0] + 0.5 * sign, pose)
            _light_shift(m, pose, ground, shift)
            along, across = _tangents(pose, ground, shift)
            along_line += sign * along
            across_line += sign * across
        piece, u = piece_at(table, m.look, image[i, 1])
        per_px = 1.0 / half_width(table, m.look, piece)
        along_sample = -horner_with_slope(table, m.look, piece, 0, u)[1] * per_px
        across_sample = -horner_with_slope(table, m.look, piece, 1, u)[1] * per_px
        inverse = -1.0 / (along_line * across_sample - along_sample * across_line)
        by_tangents[i, 0, 0], by_tangents[i, 0, 1] = inverse * across_sample, -inverse * along_sample
        by_tangents[i, 1, 0], by_tangents[i, 1, 1] = -inverse * across_line, inverse * along_line
        _pose(m, table, image[i, 0], pose)
        along, across, depth = _in_body(
            pose, ground[0] - pose[0, 0], ground[1] - pose[0, 1], ground[2] - pose[0, 2]
        )
        horizontal = math.sqrt(ground[3] * ground[3] + ground[4] * ground[4])
        axis[0, 0], axis[0, 1], axis[0, 2] = -ground[4] / horizontal, ground[3] / horizontal, 0.0
        axis[1, 0], axis[1, 1] = -ground[5] * axis[0, 1], ground[5] * axis[0, 0]
        axis[1, 2] = horizontal
        axis[2, 0], axis[2, 1], axis[2, 2] = ground[3], ground[4], ground[5]
        for k in range(3):
            x, y, z = _in_body(pose, axis[k, 0], axis[k, 1], axis[k, 2])
            by_along = (x - z * along / depth) / depth
            by_across = (y - z * across / depth) / depth
            for row in range(2):
                out[i, row, k] = by_tangents[i, row, 0] * by_along + by_tangents[i, row, 1] * by_across
    return out, by_tangents
