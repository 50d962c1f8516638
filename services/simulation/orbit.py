"""Simulated orbits: a pushbroom satellite that views a target from a given direction."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from amers.services.errors import InputError
from amers.services.geodesy import (
    WGS84_A,
    ecef_from_east_north_up,
    ecef_from_lon_lat_h,
    lon_lat_h_from_ecef,
)
from amers.services.sensors.attitude import interpolated_attitude
from amers.services.sensors.light_path import EARTH_ROTATION_RAD_S
from amers.services.sensors.piecewise import lagrange, polynomial
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.rpc import VALIDITY
from amers.services.types import Array

EARTH_GM_M3_S2 = 3.986004418e14
INCLINATION_DEG = 98.2
"""Inclination of a sun-synchronous orbit at 700 km."""

ORBIT_HEIGHT_M = 700e3
"""Height of the orbit above the equatorial radius."""

JITTER_HZ = 1.5
_STEP_S = 0.05
_MARGIN_STEPS = 6


def pushbroom_over(
    target_lon_lat_h: Array,
    shape: tuple[int, int],
    gsd_m: float,
    direction_deg: tuple[float, float],
    height_range_m: tuple[float, float],
    *,
    jitter_px: float = 0.0,
    rng: np.random.Generator | None = None,
) -> PushbroomModel:
    """A pushbroom model on a circular, descending orbit whose central pixel views a target.

    The line of sight follows the ground at the speed of the satellite's track, and the row of detectors
    stays perpendicular to it, so that pixels are square at the target.

    Args:
        target_lon_lat_h: (3,) ground point at the centre of the image.
        shape: lines and samples.
        gsd_m: ground sampling distance at the target, along and across the track.
        direction_deg: incidence and azimuth, the direction from the target to the satellite.
        height_range_m: height range of the model.
        jitter_px: amplitude of an oscillation of the line of sight about each axis, at 1.5 Hz.
        rng: source of the phases of that oscillation; without it they are zero.

    Raises:
        InputError: the target is not visible from that orbit with that incidence.
    """
    incidence_deg, azimuth_deg = direction_deg
    ground_axes = ecef_from_east_north_up(target_lon_lat_h)
    target = ecef_from_lon_lat_h(target_lon_lat_h[None, :])[0]
    satellite = _satellite(target, ground_axes, incidence_deg, azimuth_deg)
    track = _Track(satellite)
    heading = track.velocity(np.zeros(1))[0]
    heading = heading - (heading @ ground_axes[:, 2]) * ground_axes[:, 2]
    ground_speed = np.linalg.norm(heading) * np.linalg.norm(target) / np.linalg.norm(satellite)
    heading /= np.linalg.norm(heading)
    line_period_s = gsd_m / float(ground_speed)

    times = _times(VALIDITY * shape[0] / 2.0 * line_period_s)
    position = track.position(times)
    viewed = target + times[:, None] * ground_speed * heading
    viewed = _at_height(viewed, float(target_lon_lat_h[2]))
    attitude = _steering(position, viewed, heading)
    distance = float(np.linalg.norm(target - satellite))
    if jitter_px:
        attitude = attitude * _oscillation(times, jitter_px * gsd_m / distance, rng)
    across = np.cross(heading, ground_axes[:, 2])
    sight = (target - satellite) / distance
    across_per_px = gsd_m * float(np.linalg.norm(across - (across @ sight) * sight)) / distance
    return PushbroomModel(
        image_shape=shape,
        line_time=polynomial((shape[0] - 1.0) / 2.0, 1.0, np.array([[0.0, line_period_s]])),
        orbit=lagrange(times, position),
        attitude=interpolated_attitude(times, attitude.as_quat()),
        look=polynomial((shape[1] - 1.0) / 2.0, 1.0, np.array([[0.0, 0.0], [0.0, -across_per_px]])),
        height_range_m=height_range_m,
    )


def _times(half_s: float) -> Array:
    """Evenly spaced times (n,) around 0 that reach a little farther than half the time of an image."""
    step_s = max(_STEP_S, half_s / 400.0)
    steps = math.ceil(half_s / step_s) + _MARGIN_STEPS
    return step_s * np.arange(-steps, steps + 1, dtype=np.float64)


def _oscillation(times: Array, amplitude: float, rng: np.random.Generator | None) -> Rotation:
    """Rotations at times (n,) that oscillate about each axis, radians."""
    phase = rng.uniform(0.0, 2.0 * np.pi, 3) if rng else np.zeros(3)
    angles = np.sin(2.0 * np.pi * JITTER_HZ * times[:, None] + phase)
    return Rotation.from_rotvec(amplitude * angles)


def _satellite(target: Array, axes: Array, incidence_deg: float, azimuth_deg: float) -> Array:
    """Intersection (3,) of the line of sight from a target with the sphere of the orbit, ECEF."""
    incidence, azimuth = np.radians([incidence_deg, azimuth_deg])
    direction = axes @ np.array(
        [
            np.sin(incidence) * np.sin(azimuth),
            np.sin(incidence) * np.cos(azimuth),
            np.cos(incidence),
        ]
    )
    radius = WGS84_A + ORBIT_HEIGHT_M
    along = float(target @ direction)
    square = along * along + radius * radius - float(target @ target)
    if not 0.0 <= incidence_deg < 60.0 or square <= 0.0:
        raise InputError(
            f"incidence: {incidence_deg:g} degrees given, 0 to less than 60 degrees and visible from an "
            f"orbit at {ORBIT_HEIGHT_M / 1e3:g} km expected"
        )
    return np.asarray(target + (math.sqrt(square) - along) * direction)


class _Track:
    """A circular orbit that passes southwards through a position (3,) ECEF at time zero."""

    def __init__(self, satellite: Array) -> None:
        radius = float(np.linalg.norm(satellite))
        self._rate = math.sqrt(EARTH_GM_M3_S2 / radius**3)
        self._out = satellite
        lon_lat_h = lon_lat_h_from_ecef(satellite[None, :])[0]
        ratio = math.cos(math.radians(INCLINATION_DEG)) / math.cos(math.radians(lon_lat_h[1]))
        course = math.pi - math.asin(min(max(ratio, -1.0), 1.0))
        axes = ecef_from_east_north_up(lon_lat_h)
        ahead = axes @ np.array([math.sin(course), math.cos(course), 0.0])
        ahead -= (ahead @ satellite) * satellite / radius**2
        self._ahead = radius * ahead / np.linalg.norm(ahead)

    def position(self, times: Array) -> Array:
        """Positions (n, 3) in ECEF metres, of an inertial orbit above the rotating Earth."""
        angle = self._rate * times[:, None]
        inertial = np.cos(angle) * self._out + np.sin(angle) * self._ahead
        return Rotation.from_rotvec(np.outer(times, [0.0, 0.0, -EARTH_ROTATION_RAD_S])).apply(inertial)

    def velocity(self, times: Array) -> Array:
        """Velocities (n, 3) in ECEF, metres per second."""
        half_s = 0.01
        return np.asarray(
            (self.position(times + half_s) - self.position(times - half_s)) / (2.0 * half_s)
        )


def _at_height(ecef: Array, height_m: float) -> Array:
    """ECEF points (n, 3) moved vertically to one height."""
    lon_lat_h = lon_lat_h_from_ecef(ecef)
    lon_lat_h[:, 2] = height_m
    return ecef_from_lon_lat_h(lon_lat_h)


def _steering(position: Array, viewed: Array, heading: Array) -> Rotation:
    """Attitudes (n) that view ground points (n, 3), with the row of detectors across a heading (3,)."""
    down = viewed - position
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    up = viewed / np.linalg.norm(viewed, axis=1, keepdims=True)
    right = np.cross(heading[None, :], up)
    right -= (right * down).sum(axis=1, keepdims=True) * down
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([np.cross(right, down), right, down], axis=-1))
