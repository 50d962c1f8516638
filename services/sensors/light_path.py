"""The path of light from the ground to a satellite: aberration, travel time and refraction."""

import math
from dataclasses import dataclass

from numba import njit

from amers.services.geodesy import WGS84_A, WGS84_B

SPEED_OF_LIGHT_M_S = 299792458.0
EARTH_ROTATION_RAD_S = 7.292115e-5

ZENITH_PATH_EXCESS_M = 2.33
"""Integral of the refractivity of the standard atmosphere at 0.6 micrometres, from sea level upwards."""

_LAPSE_PER_M = 2.25577e-5
_PRESSURE_EXPONENT = 5.25588
_TINY_M = 1e-3


@dataclass(frozen=True)
class LightPath:
    """Which effects a model applies; a product whose attitude or look angles contain one leaves it out.

    Attributes:
        velocity_aberration: the apparent direction of the ground leans towards the velocity of the
            satellite in an inertial frame.
        light_time: the Earth turns while light travels to the satellite.
        refraction: the ray bends towards the vertical in the standard atmosphere.
    """

    velocity_aberration: bool = False
    light_time: bool = False
    refraction: bool = False


GEOMETRIC = LightPath()
"""Light in vacuum, at once: the path of simulated images."""


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def zenith_path_excess_m(height_m: float) -> float:
    """Refraction lifts the ground by this, in metres, over the squared cosine of the zenith angle.

    It is the excess path of light from the zenith, which falls with the pressure. Refraction displaces a
    ray by `Z tan(z) / cos(z)^2` towards the point below the satellite; a straight ray at the zenith
    angle `z` has that displacement at the height `Z / cos(z)^2` above the ground.

    Source: the integral of Snell's law over flat layers; Noerdlinger (1999), "Atmospheric refraction
    effects in Earth remote sensing".
    """
    relative_pressure = max(1.0 - _LAPSE_PER_M * height_m, 0.0) ** _PRESSURE_EXPONENT
    return ZENITH_PATH_EXCESS_M * relative_pressure


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def height_and_vertical(x: float, y: float, z: float) -> tuple[float, float, float, float, float]:
    """Height above the ellipsoid, the upward unit vector (x, y, z) and tan(latitude) of one ECEF point.

    Source: Bowring (1976) without angles, two iterations.
    """
    p = max(math.sqrt(x * x + y * y), _TINY_M)
    tan_u = z * WGS84_A / (p * WGS84_B)
    tan_lat = 0.0
    for _ in range(2):
        cos_u = 1.0 / math.sqrt(1.0 + tan_u * tan_u)
        sin_u = tan_u * cos_u
        tan_lat = (z + _EP2_B * sin_u * sin_u * sin_u) / (p - _E2_A * cos_u * cos_u * cos_u)
        tan_u = WGS84_B / WGS84_A * tan_lat
    cos_lat = 1.0 / math.sqrt(1.0 + tan_lat * tan_lat)
    sin_lat = tan_lat * cos_lat
    radius = WGS84_A * math.sqrt(1.0 - _E2 * sin_lat * sin_lat)
    return p * cos_lat + z * sin_lat - radius, x / p * cos_lat, y / p * cos_lat, sin_lat, tan_lat


_E2 = 1.0 - (WGS84_B / WGS84_A) ** 2
_E2_A = _E2 * WGS84_A
_EP2_B = _E2 / (1.0 - _E2) * WGS84_B
