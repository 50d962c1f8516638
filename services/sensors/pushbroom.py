"""The rigorous model of a line scanner: line times, orbit, attitude and look directions of detectors."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from amers.services.errors import FormatError
from amers.services.sensors import pushbroom_kernels as kernels
from amers.services.sensors.light_path import (
    EARTH_ROTATION_RAD_S,
    GEOMETRIC,
    SPEED_OF_LIGHT_M_S,
    LightPath,
)
from amers.services.sensors.piecewise import PiecewisePolynomial, tabulate
from amers.services.sensors.rpc import VALIDITY, cubic_terms
from amers.services.types import Array

TERRAIN_M = (-500.0, 9000.0)
"""Heights of all ground on the Earth, above the ellipsoid: rigorous models hold everywhere."""

MAX_SIZE = 10_000_000
"""Largest number of lines or samples of an image."""

_CHECK_NODES = 5
_CHECK_TOLERANCE_PX = 1e-4
_GUESS_NODES = (13, 7, 4)
_GUESS_NEEDED = 40
"""Lines, samples and heights of the grid on which the first guess of a line is fitted."""


@dataclass(frozen=True)
class PushbroomModel:
    """One row of detectors that scans the ground, line by line.

    In the body frame x points forwards, y to the right and z to the ground. The detector of a sample
    looks along `(tan_along, tan_across, 1)`. The model ends half an image beyond the first and the last
    line and sample.

    Attributes:
        image_shape: lines and samples.
        line_time: seconds at the centre of a line, of the line.
        orbit: ECEF position in metres, of the seconds.
        attitude: ecef_from_body as quaternion x, y, z, w, of the seconds; it is normalised when used.
        look: `tan_along` and `tan_across`, of the sample; `tan_across` is monotonic.
        height_range_m: lowest and highest ground the model is meant for, metres above the ellipsoid.
        light_path: the effects on the light that the other parts do not contain.
    """

    image_shape: tuple[int, int]
    line_time: PiecewisePolynomial
    orbit: PiecewisePolynomial
    attitude: PiecewisePolynomial
    look: PiecewisePolynomial
    height_range_m: tuple[float, float]
    light_path: LightPath = GEOMETRIC

    def project(self, lon_lat_h: Array) -> Array:
        """Image position of ground points, by secant steps on the line, within 1e-6 px.

        Args:
            lon_lat_h: (n, 3) degrees, degrees, metres.

        Returns:
            (n, 2) line, sample in pixels; NaN more than half an image beyond the border.
        """
        return kernels.project(*self._packed, np.ascontiguousarray(lon_lat_h, dtype=np.float64))

    def project_derivative(self, lon_lat_h: Array) -> Array:
        """Derivative of `project`, from the implicit equations of the projection.

        Returns:
            (n, 2, 3) pixels per metre east, north, up; NaN where `project` is.
        """
        return self.project_with_derivatives(lon_lat_h)[1]

    def project_with_derivatives(self, lon_lat_h: Array) -> tuple[Array, Array, Array]:
        """Image positions of ground points with their derivatives.

        Returns:
            (n, 2) as `project`, (n, 2, 3) as `project_derivative`, and (n, 2, 2) pixels by the tangents
            along and across the track under which the ground is seen in the body frame.
        """
        ground = np.ascontiguousarray(lon_lat_h, dtype=np.float64)
        image = kernels.project(*self._packed, ground)
        return image, *kernels.project_derivative(*self._packed, ground, image)

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        """Ground position of image points at given heights, by Newton steps along the line of sight.

        Args:
            line_sample: (n, 2) pixels.
            height_m: (n,) metres above the ellipsoid.

        Returns:
            (n, 3) lon, lat, height; NaN where the line of sight misses that height, or more than half
            an image beyond the border.
        """
        return kernels.locate(
            *self._packed,
            np.ascontiguousarray(line_sample, dtype=np.float64),
            np.ascontiguousarray(height_m, dtype=np.float64),
        )

    def line_of_sight(self, line_sample: Array) -> tuple[Array, Array]:
        """The lines of sight, straight; refraction is that at the middle of `height_range_m`.

        Returns:
            Origin (n, 3) ECEF metres, on the orbit without refraction, and unit direction (n, 3)
            downwards; NaN more than half an image beyond the border.
        """
        image = np.ascontiguousarray(line_sample, dtype=np.float64)
        return kernels.line_of_sight(*self._packed, image, sum(self.height_range_m) / 2.0)

    def with_parts(
        self, orbit: PiecewisePolynomial, attitude: PiecewisePolynomial, look: PiecewisePolynomial
    ) -> "PushbroomModel":
        """The model with other parts, which differ little: its first guess of lines stays."""
        near = replace(self, orbit=orbit, attitude=attitude, look=look)
        object.__setattr__(near, "_first_guess", self._first_guess)
        return near

    def cropped(self, origin: tuple[float, float], shape: tuple[int, int]) -> "PushbroomModel":
        """The model of a part of the image.

        Args:
            origin: line and sample of the first pixel of the part.
            shape: its lines and samples.
        """
        parts = zip((self.line_time, self.look), origin, strict=True)
        line_time, look = (replace(part, breaks=part.breaks - first) for part, first in parts)
        return replace(self, image_shape=shape, line_time=line_time, look=look)

    @cached_property
    def _first_guess(self) -> "_FirstGuess":
        """Where `project` begins."""
        return _first_guess(*self._tabulated(), self.height_range_m)

    @cached_property
    def _packed(self) -> tuple[kernels.Packed, Array]:
        """The model as the kernels read it: numbers, and a table of its polynomials."""
        packed, table = self._tabulated()
        guess = self._first_guess
        packed = packed._replace(
            ground_radius=guess.ground_radius,
            guess=len(table),
            guess_centre=guess.centre,
            guess_per_m=guess.per_m,
            line_slope=guess.line_slope,
        )
        return packed, np.concatenate([table, guess.coefficients])

    def _tabulated(self) -> tuple[kernels.Packed, Array]:
        """The model without its first guess of lines."""
        path = self.light_path
        lines, samples = (float(size) for size in self.image_shape)
        functions = [self.line_time, self.orbit, self.attitude, self.look]
        table, (line_time, orbit, attitude, look) = tabulate(functions)
        packed = kernels.Packed(
            lines=lines,
            samples=samples,
            line_time=line_time,
            orbit=orbit,
            attitude=attitude,
            look=look,
            per_light_speed=1.0 / SPEED_OF_LIGHT_M_S if path.velocity_aberration else 0.0,
            turn_per_m=EARTH_ROTATION_RAD_S / SPEED_OF_LIGHT_M_S if path.light_time else 0.0,
            refraction=1.0 if path.refraction else 0.0,
            ground_radius=0.0,
            guess=0,
            guess_centre=(0.0, 0.0, 0.0),
            guess_per_m=(0.0, 0.0, 0.0),
            line_slope=1.0,
        )
        return packed, table


def used_times(line_time: PiecewisePolynomial, lines: int) -> tuple[float, float]:
    """The first and the last time at which the model of an image of some lines is used, seconds."""
    first, last = sorted(line_time(np.array([-0.5 * lines - 1.0, 1.5 * lines]))[:, 0].tolist())
    return first, last


def check_pushbroom(model: PushbroomModel, source: str) -> PushbroomModel:
    """The model itself, after a check that it is usable.

    It must locate a grid of image positions at the lowest and the highest height, and project them back.

    Args:
        model: as read.
        source: name of its file, for messages.

    Raises:
        FormatError: the model is not usable; the message has the number of positions that fail.
    """
    axis = np.linspace(0.0, 1.0, _CHECK_NODES)
    lines, samples, heights = (nodes.ravel() for nodes in np.meshgrid(axis, axis, model.height_range_m))
    image = np.column_stack([lines, samples]) * (np.array(model.image_shape) - 1.0)
    with np.errstate(all="ignore"):
        ground = model.locate(image, heights)
        misfit_px = np.abs(model.project(ground) - image).max(axis=1)
    located = np.isfinite(ground).all(axis=1)
    failed = ~(misfit_px < _CHECK_TOLERANCE_PX)
    if failed.any():
        raise FormatError(
            f"{source}: the sensor model is not usable: of {len(image)} positions over the image, "
            f"{int((~located).sum())} do not meet the ground and "
            f"{int((failed & located).sum())} are not projected back within {_CHECK_TOLERANCE_PX:g} px"
        )
    return model


class _FirstGuess(NamedTuple):
    """Numbers of `kernels.Packed` that a model gets from itself, and the cubic polynomial (20,)."""

    ground_radius: float
    line_slope: float
    centre: tuple[float, float, float]
    per_m: tuple[float, float, float]
    coefficients: Array


def _first_guess(
    packed: kernels.Packed, table: Array, height_range_m: tuple[float, float]
) -> _FirstGuess:
    """The radius of the ground of a model, and a first guess of lines, for `project`."""
    centre = np.array([[(packed.lines - 1.0) / 2.0, (packed.samples - 1.0) / 2.0]])
    low, high = height_range_m
    below = kernels.locate_ecef(packed, table, centre, np.array([(low + high) / 2.0]))[0]
    radius = float(np.linalg.norm(below))
    slope = kernels.line_slope(packed, table, float(centre[0, 0]), below)
    packed = packed._replace(ground_radius=radius)
    reach = 0.5 * VALIDITY * np.array([packed.lines, packed.samples])
    u, v, h = (axis.ravel() for axis in np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in _GUESS_NODES)))
    image = centre + np.column_stack([u, v]) * reach
    ecef = kernels.locate_ecef(packed, table, image, (low + high) / 2.0 + h * (high - low) / 2.0)
    valid = np.isfinite(ecef[:, 0])
    if valid.sum() < _GUESS_NEEDED:
        constant = np.concatenate([centre[0, :1], np.zeros(19)])
        return _FirstGuess(radius, slope, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), constant)
    ecef, image = ecef[valid], image[valid]
    middle, per_m = ecef.mean(axis=0), 1.0 / np.maximum(ecef.std(axis=0), 1.0)
    terms = cubic_terms((ecef - middle) * per_m)
    guess: Array = np.linalg.lstsq(terms, image[:, 0], rcond=1e-10)[0].astype(np.float64)
    return _FirstGuess(radius, slope, tuple(middle.tolist()), tuple(per_m.tolist()), guess)
