"""The sensor model of an ortho-image: a map grid without parallax, for planimetric control only."""

from dataclasses import dataclass, replace

import numpy as np

from services.geodesy import ecef_from_lon_lat_h
from services.map_grid import MapGrid
from services.sensors.correction import ImageCorrection
from services.types import Array

LAND_M = (-430.0, 8850.0)
"""Lowest and highest land of the Earth, metres."""


@dataclass(frozen=True)
class OrthoModel:
    """The model of an image rectified onto a map: each pixel shows the ground vertically below it.

    The image position does not depend on the height; `locate` returns the height given. Errors of the
    producer's terrain model are in the image, not in this model.

    Attributes:
        grid: the map grid of the pixels.
        height_range_m: lowest and highest ground, metres above the ellipsoid; only the lines of sight
            depend on it, by their origin.
    """

    grid: MapGrid
    height_range_m: tuple[float, float] = LAND_M

    def project(self, lon_lat_h: Array) -> Array:
        """Image position of ground points: (n, 3) to (n, 2); NaN outside the domain of the map."""
        return self.grid.line_sample(lon_lat_h[:, :2])

    def project_derivative(self, lon_lat_h: Array) -> Array:
        """Derivative of `project`: (n, 2, 3), pixels per metre east, north, up; zero for up."""
        planimetric = self.grid.derivative(lon_lat_h)
        return np.concatenate([planimetric, np.zeros((len(lon_lat_h), 2, 1))], axis=2)

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        """Ground position of image points at given heights: (n, 2) and (n,) to (n, 3)."""
        return np.column_stack([self.grid.lon_lat(line_sample), height_m])

    def line_of_sight(self, line_sample: Array) -> tuple[Array, Array]:
        """Vertical lines: origin (n, 3) at the upper height, direction (n, 3) downwards, in ECEF."""
        top = self.locate(line_sample, np.full(len(line_sample), self.height_range_m[1]))
        lon, lat = np.radians(top[:, 0]), np.radians(top[:, 1])
        up = np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        return ecef_from_lon_lat_h(top), -up


def fold_into_ortho(model: OrthoModel, correction: ImageCorrection) -> OrthoModel:
    """The model whose map grid includes a correction exactly, as both are affine."""
    inverse = np.linalg.inv(correction.jacobian)
    first = correction.invert(np.zeros((1, 2)))
    grid = replace(model.grid, origin_xy=model.grid.xy(first)[0], step_xy=model.grid.step_xy @ inverse)
    return replace(model, grid=grid)
