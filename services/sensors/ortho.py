"""The sensor model of an ortho-image: a map grid, with parallax from errors of its terrain."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from amers.services.geodesy import ecef_from_lon_lat_h, move_metres
from amers.services.map_grid import MapGrid
from amers.services.sensors.correction import ImageCorrection
from amers.services.types import Array

LAND_M = (-430.0, 8850.0)
"""Lowest and highest land of the Earth, metres."""


_ITERATIONS = 3
"""Steps of `OrthoModel.project`; each leaves the slope of the terrain times the tangent, a tenth."""


@dataclass(frozen=True)
class ReliefDisplacement:
    """Where an ortho-image shows what lies above or below the terrain with which it was made.

    An error of that terrain displaces the image away from the satellite, by the tangent of the incidence
    angle. Over a wide swath the tangent changes along the lines and the samples.

    Attributes:
        terrain_m: heights (n,) of the terrain at longitudes and latitudes (n, 2), above the ellipsoid.
        per_metre: (2, 3) displacement east and north of what lies a metre above the terrain: at the
            middle of the image, and its change from there to the last line and to the last sample.
    """

    terrain_m: Callable[[Array], Array]
    per_metre: Array


@dataclass(frozen=True)
class OrthoModel:
    """The model of an image rectified onto a map: each pixel shows the ground vertically below it.

    Without a relief displacement the image position does not depend on the height, and `locate` returns
    the height given: errors of the producer's terrain model are in the image, not in this model.

    Attributes:
        grid: the map grid of the pixels.
        height_range_m: lowest and highest ground, metres above the ellipsoid; only the lines of sight
            depend on it, by their origin.
        displacement: of what lies off the terrain; None where it is not known.
    """

    grid: MapGrid
    height_range_m: tuple[float, float] = LAND_M
    displacement: ReliefDisplacement | None = None

    def project(self, lon_lat_h: Array) -> Array:
        """Image position of ground points: (n, 3) to (n, 2); NaN outside the map and the terrain."""
        position = self.grid.line_sample(lon_lat_h[:, :2])
        if self.displacement is None:
            return position
        moved = lon_lat_h
        for _ in range(_ITERATIONS):
            off_m = lon_lat_h[:, 2] - self.displacement.terrain_m(moved[:, :2])
            moved = move_metres(lon_lat_h, _horizontal(self._per_metre(position) * off_m[:, None]))
        return self.grid.line_sample(moved[:, :2])

    def project_derivative(self, lon_lat_h: Array) -> Array:
        """Derivative of `project`: (n, 2, 3), pixels per metre east, north, up.

        The slope of the terrain, times the tangent of the incidence angle, is left out.
        """
        planimetric = self.grid.derivative(lon_lat_h)
        up = np.zeros((len(lon_lat_h), 2, 1))
        if self.displacement is not None:
            per_metre = self._per_metre(self.grid.line_sample(lon_lat_h[:, :2]))
            up = planimetric @ per_metre[:, :, None]
        return np.concatenate([planimetric, up], axis=2)

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        """Ground position of image points at given heights: (n, 2) and (n,) to (n, 3)."""
        ground = np.column_stack([self.grid.lon_lat(line_sample), height_m])
        if self.displacement is None:
            return ground
        off_m = height_m - self.displacement.terrain_m(ground[:, :2])
        return move_metres(ground, _horizontal(-self._per_metre(line_sample) * off_m[:, None]))

    def line_of_sight(self, line_sample: Array) -> tuple[Array, Array]:
        """Lines: origin (n, 3) at the upper height, direction (n, 3) downwards, in ECEF."""
        top = self.locate(line_sample, np.full(len(line_sample), self.height_range_m[1]))
        if self.displacement is not None:
            bottom = self.locate(line_sample, np.full(len(line_sample), self.height_range_m[0]))
            origin = ecef_from_lon_lat_h(top)
            along = ecef_from_lon_lat_h(bottom) - origin
            return origin, along / np.linalg.norm(along, axis=1)[:, None]
        lon, lat = np.radians(top[:, 0]), np.radians(top[:, 1])
        up = np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        return ecef_from_lon_lat_h(top), -up

    def _per_metre(self, line_sample: Array) -> Array:
        """Displacement (n, 2) east, north of what lies a metre above the terrain."""
        assert self.displacement is not None
        half = np.array(self.grid.shape) / 2.0
        t = (line_sample - half + 0.5) / half
        return np.asarray(
            np.column_stack([np.ones(len(t)), t]) @ self.displacement.per_metre.T, dtype=np.float64
        )


def _horizontal(step_m: Array) -> Array:
    return np.column_stack([step_m, np.zeros(len(step_m))])


def fold_into_ortho(model: OrthoModel, correction: ImageCorrection) -> OrthoModel:
    """The model whose map grid includes a correction exactly, as both are affine."""
    inverse = np.linalg.inv(correction.jacobian)
    first = correction.invert(np.zeros((1, 2)))
    grid = replace(model.grid, origin_xy=model.grid.xy(first)[0], step_xy=model.grid.step_xy @ inverse)
    return replace(model, grid=grid)
