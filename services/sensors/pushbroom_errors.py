"""Errors of a rigorous model in attitude, orbit and focal length, and the corrected model."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from amers.services.geodesy import ecef_from_east_north_up
from amers.services.sensors.attitude import TURNS
from amers.services.sensors.piecewise import PiecewisePolynomial
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.types import Array

TERMS = (
    "roll",
    "pitch",
    "yaw",
    "roll drift",
    "pitch drift",
    "yaw drift",
    "along track",
    "across track",
    "radial",
    "along-track drift",
    "across-track drift",
    "radial drift",
    "focal length",
    "anisotropy",
)
"""Names of the terms of a correction, in their order."""


@dataclass(frozen=True)
class PushbroomErrors:
    """The terms by which a rigorous model may be off.

    * Attitude, radians: turns about the axes of the line of sight of the central detector, x forwards, y
      to the right, z along it. A drift is the turn at the last line, and minus that at the first.
    * Orbit, metres: displacements along the track, across it to the right, and upwards, where the
      satellite is at the central line; drifts in the same way.
    * Focal length, relative: both tangents of a detector, less those of the central one, are longer by
      it. Anisotropy, relative: the tangent across alone.

    Attributes:
        model: as delivered.
    """

    model: PushbroomModel

    @cached_property
    def _central_look(self) -> Array:
        """Tangents (2,) along and across of the central detector."""
        return self.model.look(np.array([(self.model.image_shape[1] - 1.0) / 2.0]))[0]

    @cached_property
    def view_axes(self) -> Array:
        """Axes (3, 3) of the central line of sight as columns, in the body frame."""
        z = np.append(self._central_look, 1.0) / np.linalg.norm(np.append(self._central_look, 1.0))
        y = np.cross(z, [1.0, 0.0, 0.0])
        y /= np.linalg.norm(y)
        return np.column_stack([np.cross(y, z), y, z])

    @cached_property
    def _times(self) -> tuple[float, float]:
        """Middle and half of the time from the first line to the last, seconds."""
        last = self.model.image_shape[0] - 1.0
        first_s, last_s = self.model.line_time(np.array([0.0, last]))[:, 0].tolist()
        return (first_s + last_s) / 2.0, (last_s - first_s) / 2.0

    @cached_property
    def _orbit_axes(self) -> Array:
        """Along the track, across to the right, upwards, as columns (3, 3), ECEF, at the middle."""
        middle = np.array([self._times[0]])
        up = self.model.orbit(middle)[0]
        up /= np.linalg.norm(up)
        right = np.cross(self.model.orbit.derivative(middle)[0], up)
        right /= np.linalg.norm(right)
        return np.column_stack([np.cross(up, right), right, up])

    def corrected(self, terms: Array) -> PushbroomModel:
        """The model with terms (14,), exact: products and sums of its polynomials."""
        turn, move, scale = terms[:6].reshape(2, 3), terms[6:12].reshape(2, 3), terms[12:]
        stretch = _stretch(scale)
        look = self.model.look.coefficients * stretch[:, None]
        look[:, :, -1] += self._central_look * (1.0 - stretch)
        return self.model.with_parts(
            orbit=_moved(self.model.orbit, move @ self._orbit_axes.T, self._times),
            attitude=_turned(self.model.attitude, turn @ self.view_axes.T, self._times),
            look=replace(self.model.look, coefficients=look),
        )

    def projected(self, terms: Array, lon_lat_h: Array) -> tuple[Array, Array, Array]:
        """Where the model with terms (14,) shows ground points (n, 3).

        A turn changes the tangents under which the ground is seen, a displacement of the satellite is
        one of the ground the other way, and a focal length changes the tangents of detectors.

        Returns:
            Positions (n, 2), derivatives (n, 2, 3) by metres east, north, up and (n, 2, 14) by terms,
            which are within 0.1 % where turns are below a milliradian.
        """
        model = self.corrected(terms)
        image, by_ground, by_tangents = model.project_with_derivatives(lon_lat_h)
        middle, half = self._times
        since = ((model.line_time(image[:, 0])[:, 0] - middle) / half)[:, None, None]
        along, across = (look := model.look(image[:, 1])).T
        turned = np.empty((len(image), 2, 3))
        turned[:, 0] = np.column_stack([along * across, -1.0 - along**2, across])
        turned[:, 1] = np.column_stack([1.0 + across**2, -along * across, -along])
        by_turn = by_tangents @ turned @ self.view_axes
        to_ecef = ecef_from_east_north_up(lon_lat_h)
        by_move = -by_ground @ to_ecef.transpose(0, 2, 1) @ self._orbit_axes
        off_centre = (look - self._central_look) / _stretch(terms[12:])
        longer = np.stack([off_centre, off_centre * [0.0, 1.0]], axis=2)
        by_scale = -by_tangents @ longer
        by_terms = [by_turn, since * by_turn, by_move, since * by_move, by_scale]
        return image, by_ground, np.concatenate(by_terms, axis=2)


def _stretch(scale: Array) -> Array:
    """Factors (2,) of the tangents along and across, of focal length and anisotropy (2,)."""
    return np.array([1.0 + scale[0], 1.0 + scale[0] + scale[1]])


def _since(function: PiecewisePolynomial, times: tuple[float, float]) -> tuple[Array, Array]:
    """The normalised time in every piece (p, 1, 1): at its middle, and its change to the upper break."""
    middle, half = times
    at = ((function.breaks - middle) / half)[:, None, None]
    return (at[1:] + at[:-1]) / 2.0, (at[1:] - at[:-1]) / 2.0


def _moved(orbit: PiecewisePolynomial, move: Array, times: tuple[float, float]) -> PiecewisePolynomial:
    """An orbit displaced by (2, 3): a constant, and a displacement that grows with time."""
    middle, half = _since(orbit, times)
    coefficients = _padded(orbit.coefficients, 1)
    coefficients[:, :, -1:] += move[0][:, None] + middle * move[1][:, None]
    coefficients[:, :, -2:-1] += half * move[1][:, None]
    return replace(orbit, coefficients=coefficients)


def _turned(
    attitude: PiecewisePolynomial, turn: Array, times: tuple[float, float]
) -> PiecewisePolynomial:
    """Quaternions multiplied from the right by (turn / 2, 1): a constant (3,), and one that grows."""
    middle, half = _since(attitude, times)
    constant, growing = (np.einsum("k,kab->ab", part / 2.0, TURNS) for part in turn)
    coefficients = _padded(attitude.coefficients, attitude.coefficients.shape[2])
    # Highest power first: the product with the time moves every coefficient to the next power.
    product = growing @ coefficients
    once = np.concatenate([product[:, :, 1:], np.zeros_like(product[:, :, :1])], axis=2)
    return replace(
        attitude,
        coefficients=coefficients + constant @ coefficients + middle * product + half * once,
    )


def _padded(coefficients: Array, degree: int) -> Array:
    """Coefficients of at least a degree, a new array."""
    missing = max(0, degree + 1 - coefficients.shape[2])
    return np.pad(coefficients, ((0, 0), (0, 0), (missing, 0)))
