"""Predicted accuracy of ground positions from a model and a terrain, vertex by vertex."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.quality.normal_law import normal_ce90
from amers.services.sensors.base import SensorModel
from amers.services.terrain import Terrain
from amers.services.types import Array


@dataclass(frozen=True)
class ErrorSources:
    """What makes the position of a vertex uncertain.

    Attributes:
        registration: of the model; None for a scene that is not registered.
        model_sigma_m: accuracy on the Earth of a model that is not registered, one standard deviation a
            coordinate; NaN when unknown.
        vertex_sigma_px: one standard deviation of each coordinate of a digitised vertex.
    """

    registration: CorrectionAccuracy | None
    model_sigma_m: float
    vertex_sigma_px: float


@dataclass(frozen=True)
class VertexAccuracy:
    """Predicted covariances of n vertices, east and north, m^2.

    Attributes:
        relative_m2: (n, 2, 2) relative to the control points; NaN when unknown, and where a line of
            sight grazes the ground.
        on_the_earth_m2: (n, 2, 2) with their frame; NaN likewise.
    """

    relative_m2: Array
    on_the_earth_m2: Array

    @property
    def relative_ce90_m(self) -> Array:
        """CE90 (n,) relative to the control points; NaN when unknown."""
        return normal_ce90(self.relative_m2)

    @property
    def on_the_earth_ce90_m(self) -> Array:
        """CE90 (n,) on the Earth; NaN when unknown."""
        return normal_ce90(self.on_the_earth_m2)


def predict_vertices(
    model: SensorModel, terrain: Terrain, line_sample: Array, lon_lat_h: Array, sources: ErrorSources
) -> VertexAccuracy:
    """The covariance of ground where lines of sight meet a terrain.

    With the derivative (A | a) of the model by the horizontal position and the height, and the slope g
    of the ground, an error of the image position and one of the terrain's height move the intersection
    by `(A + a g^T)^-1 (image error - a height error)`: on level ground, the height error times the
    tangent of the incidence.

    Args:
        model: of the image.
        terrain: the ground, with the sigma of its heights.
        line_sample: (n, 2) the vertices in the image.
        lon_lat_h: (n, 3) the same on the ground.
        sources: of the errors.
    """
    derivative = model.project_derivative(lon_lat_h)
    horizontal, vertical = derivative[:, :, :2], derivative[:, :, 2:]
    slope = np.nan_to_num(terrain.slope(lon_lat_h))
    to_image = horizontal + vertical * slope[:, None, :]
    own_px2 = sources.vertex_sigma_px**2 * np.eye(2)
    height_m2 = terrain.sigma_m(lon_lat_h) ** 2
    own_px2 = own_px2 + height_m2[:, None, None] * _outer(vertical)
    if sources.registration is None:
        relative_px2 = np.full_like(own_px2, np.nan)
        earth_px2 = own_px2 + sources.model_sigma_m**2 * _outer(horizontal)
    else:
        relative_px2 = own_px2 + sources.registration.relative_px2(line_sample)
        earth_px2 = relative_px2 + sources.registration.frame_px2(derivative)
    return VertexAccuracy(_on_ground(to_image, relative_px2), _on_ground(to_image, earth_px2))


def _outer(matrices: Array) -> Array:
    """Each matrix (n, i, j) times its transpose, (n, i, i)."""
    return np.asarray((matrices[:, :, None, :] * matrices[:, None, :, :]).sum(axis=3))


@njit(cache=True, error_model="numpy")
def _on_ground(to_image: Array, in_image: Array) -> Array:
    """Covariances on the ground of others in the image, with the maps (n, 2, 2) from ground to image.

    NaN where a map has no inverse: a line of sight grazes the ground.
    """
    out = np.empty_like(in_image)
    inverse = np.empty((2, 2))
    for n in range(len(to_image)):
        a, b, c, d = to_image[n, 0, 0], to_image[n, 0, 1], to_image[n, 1, 0], to_image[n, 1, 1]
        determinant = a * d - b * c
        inverse[0, 0], inverse[0, 1] = d / determinant, -b / determinant
        inverse[1, 0], inverse[1, 1] = -c / determinant, a / determinant
        for i in range(2):
            for j in range(2):
                value = 0.0
                for k in range(2):
                    for m in range(2):
                        value += inverse[i, k] * in_image[n, k, m] * inverse[j, m]
                out[n, i, j] = value if np.isfinite(value) else np.nan
    return out
