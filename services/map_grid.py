"""Map grids: conversion between longitude, latitude and the lines and samples of regular pixels."""

from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from amers.services.datums import from_wgs84, horizontal, to_wgs84
from amers.services.errors import InputError
from amers.services.geodesy import longitudes_near, metres_per_degree_at
from amers.services.types import Array, BoolArray

AUTHORITIES = ("EPSG", "ESRI", "IGNF", "OGC")
NEARLY_TRUE = 0.01
"""Largest scale error of a map whose lengths are taken as those of the ground: a step of 0.5 m is then
0.5 units of the map. Grids of surveys stay far below (UTM: 0.001); the map of the web exceeds it from 8
degrees of latitude on."""
_BESIDE_SEAM_DEG = 179.99
"""Longitude up to which the scale of a map is taken: most maps of the world end at 180 degrees."""
_DIFFERENCE_M = 50.0
"""Half the length of the central differences of a derivative. Their relative error is the square of this
length over the radius of the Earth, 1e-10."""


@dataclass(frozen=True)
class MapGrid:
    """A regular grid of pixels on a map.

    Attributes:
        crs: reference system of the map, WKT or a code; only its horizontal part is used.
        origin_xy: (2,) map position of the centre of the first pixel, easting or longitude first.
        step_xy: (2, 2) map units per pixel; rows x and y, columns along lines and along samples.
        shape: lines and samples.
    """

    crs: str
    origin_xy: Array
    step_xy: Array
    shape: tuple[int, int]

    @property
    def is_geographic(self) -> bool:
        """Whether the map coordinates are longitude and latitude."""
        return horizontal(self.crs).is_geographic

    @property
    def first_axis_is_north(self) -> bool:
        """Whether the reference system has northing or latitude first; `xy` never has."""
        return horizontal(self.crs).axis_info[0].direction.lower() == "north"

    @property
    def gsd_m(self) -> float:
        """Ground sampling distance in metres: side of the square as large as the central pixel."""
        centre = (np.array([self.shape], dtype=np.float64) - 1.0) / 2.0
        lon_lat_h = np.column_stack([self.lon_lat(centre), [0.0]])
        return float(abs(np.linalg.det(self.derivative(lon_lat_h)[0])) ** -0.5)

    def xy(self, line_sample: Array) -> Array:
        """Map positions (n, 2) of pixel positions (n, 2)."""
        return np.asarray(self.origin_xy + line_sample @ self.step_xy.T)

    def line_sample_of_xy(self, xy: Array) -> Array:
        """Pixel positions (n, 2) of map positions (n, 2); longitudes are taken near the grid."""
        offset = xy - self.origin_xy
        if self.is_geographic:
            middle = float((np.array(self.shape) - 1.0) / 2.0 @ self.step_xy[0])
            offset[:, 0] = longitudes_near(offset[:, 0], middle)
        return np.asarray(offset @ np.linalg.inv(self.step_xy).T)

    def line_sample(self, lon_lat: Array) -> Array:
        """Pixel positions (n, 2) of longitudes and latitudes (n, 2); NaN outside the map's domain."""
        return self.line_sample_of_xy(xy_of_lon_lat(self.crs, lon_lat))

    def lon_lat(self, line_sample: Array) -> Array:
        """Longitudes and latitudes (n, 2) of pixel positions (n, 2), -180 to 180."""
        return lon_lat_of_xy(self.crs, self.xy(line_sample))

    def derivative(self, lon_lat_h: Array) -> Array:
        """Derivative (n, 2, 2) of `line_sample`: pixels per metre east and north at points (n, 3)."""
        degrees = _DIFFERENCE_M / metres_per_degree_at(np.asarray(lon_lat_h, dtype=np.float64))
        steps = np.zeros((len(lon_lat_h), 4, 2))
        steps[:, 0, 0], steps[:, 1, 0] = degrees[:, 0], -degrees[:, 0]
        steps[:, 2, 1], steps[:, 3, 1] = degrees[:, 1], -degrees[:, 1]
        around = self.line_sample((lon_lat_h[:, None, :2] + steps).reshape(-1, 2)).reshape(-1, 2, 2, 2)
        per_metre = (around[:, :, 0] - around[:, :, 1]) / (2.0 * _DIFFERENCE_M)
        return np.asarray(per_metre.transpose(0, 2, 1))

    def contains(self, line_sample: Array) -> BoolArray:
        """Whether pixel positions (n, 2) lie on a pixel of the grid."""
        return np.asarray(
            ((line_sample >= -0.5) & (line_sample <= np.array(self.shape) - 0.5)).all(axis=1)
        )


def crs_of_code(code: str) -> CRS:
    """The reference system with a code such as "EPSG:32631", from the database of PROJ.

    Definitions, files and addresses, which PROJ would accept too, are refused.

    Raises:
        InputError: the text is no such code, or the database does not have it.
    """
    authority, _, number = code.partition(":")
    if authority in AUTHORITIES and number.isascii() and number.isalnum():
        try:
            return CRS.from_authority(authority, number)
        except CRSError:
            pass
    raise InputError(
        f"{code[:80]!r} is no known reference system; expected a code of {', '.join(AUTHORITIES)}, "
        "such as EPSG:32631"
    )


def check_map_code(code: str) -> None:
    """Refuse a code that is not one of the reference system of a map on the Earth.

    Raises:
        InputError: it is not known, has no map coordinates, or is not of the Earth.
    """
    crs_of_code(code)
    check_map(code)


def check_map(crs: str) -> None:
    """Refuse a reference system, WKT or a code, that no map on the Earth can have.

    Raises:
        InputError: it has no map coordinates, or is not of the Earth.
    """
    parsed = CRS.from_user_input(crs)
    parts = parsed.sub_crs_list if parsed.is_compound else [parsed]
    name = f"{crs:.80}: {parsed.name}"
    if not (parts[0].is_projected or parts[0].is_geographic):
        raise InputError(f"{name} has no map coordinates; a projected reference system expected")
    try:
        xy_of_lon_lat(crs, np.zeros((1, 2)))
    except ProjError as error:
        raise InputError(f"{name}: this reference system cannot be reached from WGS 84") from error


def xy_of_lon_lat(crs: str, lon_lat: Array) -> Array:
    """Map positions (n, 2) of WGS 84 longitudes and latitudes (n, 2); NaN outside the map's domain."""
    return _transformed(from_wgs84(crs), lon_lat)


def continuous_xy(crs: str, lon_lat: Array) -> Array:
    """Map positions (n, 2) of continuous longitudes and latitudes (n, 2), as `xy_of_lon_lat`.

    On a geographic map they are continuous, too: they may exceed a half turn.
    """
    xy, system = xy_of_lon_lat(crs, lon_lat), horizontal(crs)
    if system.is_geographic and len(xy):
        degree = np.radians(1.0) / float(system.axis_info[0].unit_conversion_factor)
        beyond = xy[:, 0] - xy[0, 0] - (lon_lat[:, 0] - lon_lat[0, 0]) * degree
        xy[:, 0] -= 360.0 * degree * np.round(beyond / (360.0 * degree))
    return xy


def lon_lat_of_xy(crs: str, xy: Array) -> Array:
    """WGS 84 longitudes (-180 to 180) and latitudes (n, 2) of map positions (n, 2); NaN outside."""
    lon_lat = _transformed(to_wgs84(crs), xy)
    lon_lat[:, 0] -= 360.0 * np.floor((lon_lat[:, 0] + 180.0) / 360.0)
    return lon_lat


def map_units_per_metre(crs: str, lon_lat: Array) -> Array:
    """Units of a map in one metre of the ground at a place: the only conversion of `gsd_m` to a map.

    Args:
        crs: reference system of the map, WKT or a code: its unit may be a metre, a foot or a degree.
        lon_lat: (2,) the place, whose longitude may exceed a half turn.

    Returns:
        (2,) along x and along y. On a projected map both are the same, the root of the ratio of areas;
        within `NEARLY_TRUE` they are those of its unit alone. NaN outside the map's domain.
    """
    grid = MapGrid(crs, np.zeros(2), np.array([[0.0, 1.0], [-1.0, 0.0]]), (1, 1))
    lon = float(np.clip((lon_lat[0] + 180.0) % 360.0 - 180.0, -_BESIDE_SEAM_DEG, _BESIDE_SEAM_DEG))
    line, sample = grid.derivative(np.array([[lon, lon_lat[1], 0.0]]))[0]
    of_ground = np.array([sample, -line])
    if grid.is_geographic:
        return np.asarray(1.0 / np.linalg.norm(np.linalg.inv(of_ground), axis=0))
    in_true_metre = 1.0 / float(horizontal(crs).axis_info[0].unit_conversion_factor)
    per_metre = float(abs(np.linalg.det(of_ground))) ** 0.5
    is_true = abs(per_metre / in_true_metre - 1.0) <= NEARLY_TRUE
    return np.full(2, in_true_metre if is_true else per_metre)


def utm_of(lon: float, lat: float) -> str:
    """EPSG code of the WGS 84 UTM zone of a position; also near the poles, where UTM is not defined."""
    zone = int((lon + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32600 if lat >= 0.0 else 32700) + zone}"


def _transformed(transformer: Transformer, points: Array) -> Array:
    x, y = transformer.transform(points[:, 0], points[:, 1])
    out = np.column_stack([x, y])
    out[~(np.isfinite(x) & np.isfinite(y))] = np.nan
    return out
