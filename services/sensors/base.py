"""The interface of all sensor models."""

from typing import Protocol

from amers.services.types import Array


class SensorModel(Protocol):
    """The relation between image positions and ground positions of one image.

    Models are immutable: a corrected model is a new object. Rows that cannot be computed are NaN.
    """

    @property
    def height_range_m(self) -> tuple[float, float]:
        """Lowest and highest ground the model is meant for, metres above the ellipsoid."""
        ...

    def project(self, lon_lat_h: Array) -> Array:
        """Image position of ground points: (n, 3) to (n, 2)."""
        ...

    def project_derivative(self, lon_lat_h: Array) -> Array:
        """Derivative of `project`: (n, 2, 3), pixels per metre east, north, up."""
        ...

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        """Ground position of image points at given heights: (n, 2) and (n,) to (n, 3)."""
        ...

    def line_of_sight(self, line_sample: Array) -> tuple[Array, Array]:
        """Origin (n, 3) and unit direction (n, 3) in ECEF, from the sensor towards the ground."""
        ...
