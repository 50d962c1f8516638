"""Conversions between geodetic, Earth-centred and local cartesian coordinates on WGS 84; the sun.

The scalar functions are compiled for calls from other kernels; all other code uses the array functions.
"""

import math
from datetime import datetime

import numpy as np
from numba import njit

from amers.services.types import Array

WGS84_A = 6378137.0
WGS84_F = 1.0 / 298.257223563
WGS84_E2 = WGS84_F * (2.0 - WGS84_F)
WGS84_B = WGS84_A * (1.0 - WGS84_F)
_MARGIN_DEG = 1e-6
"""Margin of `box_around`, a tenth of a metre."""
_EP2 = WGS84_E2 / (1.0 - WGS84_E2)


@njit(cache=True)
def geodetic_to_ecef(lon_deg: float, lat_deg: float, h: float) -> tuple[float, float, float]:
    """ECEF position in metres of one geodetic position."""
    lon = math.radians(lon_deg)
    lat = math.radians(lat_deg)
    sin_lat = math.sin(lat)
    cos_lat = math.cos(lat)
    n = WGS84_A / math.sqrt(1.0 - WGS84_E2 * sin_lat * sin_lat)
    return (
        (n + h) * cos_lat * math.cos(lon),
        (n + h) * cos_lat * math.sin(lon),
        (n * (1.0 - WGS84_E2) + h) * sin_lat,
    )


@njit(cache=True)
def ecef_to_geodetic(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Geodetic position of one ECEF point.

    Source: Bowring (1976) with two iterations; error below 1 nm within 1,000 km of the ellipsoid.
    """
    p = math.hypot(x, y)
    tan_u = z * WGS84_A / (p * WGS84_B) if p > 0.0 else math.inf
    lat = 0.0
    for _ in range(3):
        u = math.atan(tan_u)
        lat = math.atan2(
            z + _EP2 * WGS84_B * math.sin(u) ** 3, p - WGS84_E2 * WGS84_A * math.cos(u) ** 3
        )
        tan_u = (1.0 - WGS84_F) * math.tan(lat)
    sin_lat = math.sin(lat)
    cos_lat = math.cos(lat)
    n = WGS84_A / math.sqrt(1.0 - WGS84_E2 * sin_lat * sin_lat)
    h = p * cos_lat + z * sin_lat - WGS84_A * WGS84_A / n
    return math.degrees(math.atan2(y, x)), math.degrees(lat), h


@njit(cache=True)
def metres_per_degree(lat_deg: float, h: float) -> tuple[float, float]:
    """Length in metres of one degree of longitude and of one degree of latitude, at a height."""
    sin_lat = math.sin(math.radians(lat_deg))
    w2 = 1.0 - WGS84_E2 * sin_lat * sin_lat
    n = WGS84_A / math.sqrt(w2)
    m = n * (1.0 - WGS84_E2) / w2
    rad = math.pi / 180.0
    return (n + h) * math.cos(math.radians(lat_deg)) * rad, (m + h) * rad


@njit(cache=True)
def metres_per_degree_at(lon_lat_h: Array) -> Array:
    """Length in metres of one degree of longitude and of latitude (n, 2) at positions (n, 3)."""
    out = np.empty((len(lon_lat_h), 2))
    for i in range(len(lon_lat_h)):
        out[i] = metres_per_degree(lon_lat_h[i, 1], lon_lat_h[i, 2])
    return out


@njit(cache=True)
def _to_ecef(lon_lat_h: Array) -> Array:
    out = np.empty((len(lon_lat_h), 3))
    for i in range(len(lon_lat_h)):
        out[i] = geodetic_to_ecef(lon_lat_h[i, 0], lon_lat_h[i, 1], lon_lat_h[i, 2])
    return out


@njit(cache=True)
def _to_geodetic(ecef: Array) -> Array:
    out = np.empty((len(ecef), 3))
    for i in range(len(ecef)):
        out[i] = ecef_to_geodetic(ecef[i, 0], ecef[i, 1], ecef[i, 2])
    return out


def longitudes_near(lon_deg: Array, near_deg: float) -> Array:
    """Longitudes (n,) plus full turns, so that they lie within 180 degrees of a given longitude."""
    return np.asarray(near_deg + (lon_deg - near_deg + 180.0) % 360.0 - 180.0)


def wrapped_degrees(difference_deg: Array) -> Array:
    """Differences of longitudes (n,) the short way round, -180 to 180 degrees."""
    return np.asarray((difference_deg + 180.0) % 360.0 - 180.0)


def continuous(lon_lat: Array) -> Array:
    """Positions (n, 2 or 3) with longitudes within 180 degrees of the first, hence without a jump."""
    out = np.array(lon_lat, dtype=np.float64)
    out[:, 0] = longitudes_near(out[:, 0], out[0, 0])
    return out


def box_around(lon_lat: Array) -> Array:
    """Outline (4, 2) of the bounding box of positions (n, 2 or 3), with a margin of a tenth of a metre.

    Counter-clockwise, not closed, longitudes continuous.
    """
    points = continuous(lon_lat)[:, :2]
    west, south = points.min(axis=0) - _MARGIN_DEG
    east, north = points.max(axis=0) + _MARGIN_DEG
    return np.array([[west, south], [east, south], [east, north], [west, north]])


def ecef_from_lon_lat_h(lon_lat_h: Array) -> Array:
    """ECEF positions (n, 3) in metres of geodetic positions (n, 3)."""
    return _to_ecef(np.ascontiguousarray(lon_lat_h, dtype=np.float64))


def lon_lat_h_from_ecef(ecef: Array) -> Array:
    """Geodetic positions (n, 3) of ECEF positions (n, 3) in metres."""
    return _to_geodetic(np.ascontiguousarray(ecef, dtype=np.float64))


def ecef_from_east_north_up(origin_lon_lat_h: Array) -> Array:
    """Rotations (..., 3, 3) whose columns are the east, north and up axes at origins (..., 3)."""
    lon, lat = np.radians(origin_lon_lat_h[..., 0]), np.radians(origin_lon_lat_h[..., 1])
    sin_lon, cos_lon, sin_lat, cos_lat = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    axes = np.array(
        [
            [-sin_lon, -sin_lat * cos_lon, cos_lat * cos_lon],
            [cos_lon, -sin_lat * sin_lon, cos_lat * sin_lon],
            [0.0 * lat, cos_lat, sin_lat],
        ]
    )
    return np.moveaxis(axes, (0, 1), (-2, -1))


def east_north_up(lon_lat_h: Array, origin_lon_lat_h: Array) -> Array:
    """Positions (n, 3) in metres in the east-north-up frame at an origin (3,)."""
    origin = ecef_from_lon_lat_h(origin_lon_lat_h[None, :])
    rotation = ecef_from_east_north_up(origin_lon_lat_h)
    return (ecef_from_lon_lat_h(lon_lat_h) - origin) @ rotation


def lon_lat_h_from_east_north_up(enu: Array, origin_lon_lat_h: Array) -> Array:
    """Geodetic positions (n, 3) of points (n, 3) in the east-north-up frame at an origin (3,)."""
    origin = ecef_from_lon_lat_h(origin_lon_lat_h[None, :])
    rotation = ecef_from_east_north_up(origin_lon_lat_h)
    return lon_lat_h_from_ecef(origin + enu @ rotation.T)


@njit(cache=True)
def move_metres(lon_lat_h: Array, enu: Array) -> Array:
    """Ground points (n, 3) moved by metres east, north and up (n, 3); exact for small moves."""
    out = np.empty_like(lon_lat_h)
    for i in range(len(lon_lat_h)):
        east, north = metres_per_degree(lon_lat_h[i, 1], lon_lat_h[i, 2])
        out[i, 0] = lon_lat_h[i, 0] + enu[i, 0] / east
        out[i, 1] = lon_lat_h[i, 1] + enu[i, 1] / north
        out[i, 2] = lon_lat_h[i, 2] + enu[i, 2]
    return out


def sun_direction(lon_lat: Array, when: datetime) -> tuple[float, float]:
    """Elevation and azimuth of the sun in degrees, accurate to about half a degree.

    Source: the low-precision formulas of the Astronomical Almanac.

    Args:
        lon_lat: (2,) degrees.
        when: time, UTC.
    """
    days = (when.replace(tzinfo=None) - datetime(2000, 1, 1, 12)).total_seconds() / 86400.0
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = np.radians(
        280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2.0 * anomaly)
    )
    obliquity = np.radians(23.439)
    ascension = np.arctan2(np.cos(obliquity) * np.sin(longitude), np.cos(longitude))
    declination = np.arcsin(np.sin(obliquity) * np.sin(longitude))
    sidereal = np.radians(280.46062 + 360.98564737 * days + lon_lat[0])
    hour, lat = sidereal - ascension, np.radians(lon_lat[1])
    up = np.sin(lat) * np.sin(declination) + np.cos(lat) * np.cos(declination) * np.cos(hour)
    east = -np.cos(declination) * np.sin(hour)
    north = np.cos(lat) * np.sin(declination) - np.sin(lat) * np.cos(declination) * np.cos(hour)
    return float(np.degrees(np.arcsin(up))), float(np.degrees(np.arctan2(east, north)) % 360.0)
