"""Pixels laid regularly on a map: from longitude and latitude to lines and samples, and back."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from pyproj import CRS, Transformer

from services.geodesy import metres_per_degree_at
from services.types import Array, BoolArray

_DIFFERENCE_M = 50.0
"""Half the distance of the differences that make a derivative: what they neglect is its square over that
of the Earth's radius, 1e-10."""


@dataclass(frozen=True)
class MapGrid:
    """Pixels laid regularly on a map.

    Attributes:
        crs: reference system of the map, WKT or a code of an authority; only its horizontal part counts.
        origin_xy: (2,) map position of the centre of the first pixel, eastings or longitude first.
        step_xy: (2, 2) map units from one pixel to the next; rows x and y, columns along lines and
            along samples.
        shape: lines and samples.
    """

    crs: str
    origin_xy: Array
    step_xy: Array
    shape: tuple[int, int]

    @property
    def is_geographic(self) -> bool:
        """Whether the map is longitude and latitude."""
        return _horizontal(self.crs).is_geographic

    @property
    def first_axis_is_north(self) -> bool:
        """Whether the reference system itself names northings or latitudes first; grids never do."""
        return _horizontal(self.crs).axis_info[0].direction.lower() == "north"

    @property
    def gsd_m(self) -> float:
        """Distance of the pixels at the centre: side of the square as large as one of them, metres."""
        centre = (np.array([self.shape], dtype=np.float64) - 1.0) / 2.0
        lon_lat_h = np.column_stack([self.lon_lat(centre), [0.0]])
        return float(abs(np.linalg.det(self.derivative(lon_lat_h)[0])) ** -0.5)

    def xy(self, line_sample: Array) -> Array:
        """Map positions (n, 2) of pixel positions (n, 2)."""
        return np.asarray(self.origin_xy + line_sample @ self.step_xy.T)

    def line_sample_of_xy(self, xy: Array) -> Array:
        """Pixel positions (n, 2) of map positions (n, 2); longitudes the short way round the grid."""
        away = xy - self.origin_xy
        if self.is_geographic:
            middle = float((np.array(self.shape) - 1.0) / 2.0 @ self.step_xy[0])
            away[:, 0] = middle + (away[:, 0] - middle + 180.0) % 360.0 - 180.0
        return np.asarray(away @ np.linalg.inv(self.step_xy).T)

    def line_sample(self, lon_lat: Array) -> Array:
        """Pixel positions (n, 2) of longitudes and latitudes (n, 2); NaN where the map has no place."""
        return self.line_sample_of_xy(xy_of_lon_lat(self.crs, lon_lat))

    def lon_lat(self, line_sample: Array) -> Array:
        """Longitudes and latitudes (n, 2) of pixel positions (n, 2), -180 to 180."""
        return lon_lat_of_xy(self.crs, self.xy(line_sample))

    def derivative(self, lon_lat_h: Array) -> Array:
        """Derivative (n, 2, 2) of `line_sample`: pixels per metre east and north at a height."""
        degrees = _DIFFERENCE_M / metres_per_degree_at(np.asarray(lon_lat_h, dtype=np.float64))
        steps = np.zeros((len(lon_lat_h), 4, 2))
        steps[:, 0, 0], steps[:, 1, 0] = degrees[:, 0], -degrees[:, 0]
        steps[:, 2, 1], steps[:, 3, 1] = degrees[:, 1], -degrees[:, 1]
        around = self.line_sample((lon_lat_h[:, None, :2] + steps).reshape(-1, 2)).reshape(-1, 2, 2, 2)
        per_metre = (around[:, :, 0] - around[:, :, 1]) / (2.0 * _DIFFERENCE_M)
        return np.asarray(per_metre.transpose(0, 2, 1))

    def contains(self, line_sample: Array) -> BoolArray:
        """Whether pixel positions (n, 2) lie on a pixel."""
        return np.asarray(
            ((line_sample >= -0.5) & (line_sample <= np.array(self.shape) - 0.5)).all(axis=1)
        )


def xy_of_lon_lat(crs: str, lon_lat: Array) -> Array:
    """Map positions (n, 2) of WGS 84 longitudes and latitudes (n, 2); NaN where the map has none."""
    return _moved(_to_map(crs), lon_lat)


def lon_lat_of_xy(crs: str, xy: Array) -> Array:
    """WGS 84 longitudes (-180 to 180) and latitudes (n, 2) of map positions (n, 2); NaN for none."""
    lon_lat = _moved(_from_map(crs), xy)
    lon_lat[:, 0] -= 360.0 * np.floor((lon_lat[:, 0] + 180.0) / 360.0)
    return lon_lat


def utm_of(lon: float, lat: float) -> str:
    """The UTM zone of a place, WGS 84, as an EPSG code; near the poles it is still one of them."""
    zone = int((lon + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32600 if lat >= 0.0 else 32700) + zone}"


def _moved(transformer: Transformer, points: Array) -> Array:
    x, y = transformer.transform(points[:, 0], points[:, 1])
    moved = np.column_stack([x, y])
    moved[~np.isfinite(moved).all(axis=1)] = np.nan
    return moved


@cache
def _horizontal(crs: str) -> CRS:
    """The horizontal part of a reference system that may have a vertical one too."""
    whole = CRS.from_user_input(crs)
    return whole.sub_crs_list[0] if whole.is_compound else whole.to_2d()


@cache
def _to_map(crs: str) -> Transformer:
    return Transformer.from_crs("EPSG:4326", _horizontal(crs), always_xy=True)


@cache
def _from_map(crs: str) -> Transformer:
    return Transformer.from_crs(_horizontal(crs), "EPSG:4326", always_xy=True)
