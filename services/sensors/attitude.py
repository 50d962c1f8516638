"""Attitudes of a satellite over time: quaternions x, y, z, w and angles as piecewise polynomials."""

import numpy as np
from scipy.spatial.transform import Rotation

from amers.services.sensors.piecewise import PiecewisePolynomial, from_function, lagrange
from amers.services.types import Array

_DEGREE = 7
_QUADRATIC = 2
_LEAST_SHARE = 1e-9
"""Of the whole time, between two breaks."""

TURNS = np.array(
    [
        [[0, 0, 0, 1], [0, 0, 1, 0], [0, -1, 0, 0], [-1, 0, 0, 0]],
        [[0, 0, -1, 0], [0, 0, 0, 1], [1, 0, 0, 0], [0, -1, 0, 0]],
        [[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]],
    ],
    dtype=np.float64,
)
"""(3, 4, 4): the product of a quaternion x, y, z, w with the unit i, j or k on its right."""


def without_sign_changes(quaternions: Array) -> Array:
    """Unit quaternions (n, 4) of the same rotations, each with the sign nearer to the one before."""
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    turned = np.where((unit[1:] * unit[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    return np.asarray(unit * np.cumprod(np.concatenate([[1.0], turned]))[:, None])


def interpolated_attitude(times: Array, quaternions: Array) -> PiecewisePolynomial:
    """The interpolation of quaternions by Lagrange polynomials over eight samples.

    Args:
        times: (m,) seconds, increasing, at least eight.
        quaternions: (m, 4) x, y, z, w of any length and sign.
    """
    return lagrange(times, without_sign_changes(quaternions))


def integrated_rates(times: Array, rates: Array, start: tuple[float, Array]) -> PiecewisePolynomial:
    """The angles whose rates are straight lines between samples, from known angles at one time.

    Args:
        times: (m,) seconds, increasing, at least two.
        rates: (m, values) radians per second.
        start: a time and the angles (values,) then, in radians; before the first sample and after the
            last one the rate stays.
    """
    steps = np.diff(times)[:, None]
    angles = np.concatenate(
        [np.zeros((1, rates.shape[1])), np.cumsum((rates[1:] + rates[:-1]) / 2.0 * steps, axis=0)]
    )

    def at(t: Array) -> Array:
        first = np.clip(np.searchsorted(times, t) - 1, 0, len(times) - 2)
        since = (t - times[first])[:, None]
        slope = (rates[first + 1] - rates[first]) / steps[first]
        return np.asarray(angles[first] + since * (rates[first] + since * slope / 2.0))

    known_s, known = start
    nearest = np.clip(known_s, times[0], times[-1])
    edge = rates[0] if known_s < times[0] else rates[-1]
    offset = known + edge * (nearest - known_s) - at(np.array([nearest]))[0]
    return from_function(times, lambda t: at(t) + offset, _QUADRATIC)


def orbital_attitude(
    orbit: PiecewisePolynomial, velocity: PiecewisePolynomial, angles: PiecewisePolynomial
) -> PiecewisePolynomial:
    """The quaternions ecef_from_body of a satellite whose angles are relative to its orbit.

    Without angles z points to the centre of the Earth, y to the right of the velocity, x forwards. A
    positive pitch, then roll, then yaw turn about y, x, z in the negative sense.

    Source: SPOT Satellite Geometry Handbook (S-NT-73-12-SI, 2002).

    Args:
        orbit: ECEF position in metres, of the seconds.
        velocity: as the product states it, of the seconds.
        angles: yaw, pitch, roll in radians, of the seconds; its breaks are those of the result.
    """

    def quaternions(t: Array) -> Array:
        order = np.argsort(t)
        position, ahead, turn = orbit(t[order]), velocity(t[order]), angles(t[order])
        down = -position / np.linalg.norm(position, axis=1, keepdims=True)
        right = np.cross(down, ahead)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        axes = np.stack([np.cross(right, down), right, down], axis=-1)
        turned = Rotation.from_euler("YXZ", -turn[:, [1, 2, 0]])
        unsorted = np.empty((len(t), 4))
        unsorted[order] = without_sign_changes((Rotation.from_matrix(axes) * turned).as_quat())
        return unsorted

    return from_function(angles.breaks, quaternions, _DEGREE)


def turned_over_time(
    attitude: PiecewisePolynomial, times: Array, turns: Array, used: tuple[float, float]
) -> PiecewisePolynomial:
    """Quaternions multiplied from the right by (turn / 2, 1), exactly.

    Args:
        attitude: ecef_from_body as quaternions x, y, z, w, of the seconds.
        times: (m,) seconds, increasing.
        turns: (m, 3) radians about the axes of the body then, small; straight lines between the times,
            constant before the first and after the last.
        used: first and last time at which the result is used.
    """

    def turned(t: Array) -> Array:
        quaternions = attitude(t)
        at = np.column_stack([np.interp(t, times, turns[:, k]) for k in range(3)])
        return np.asarray(quaternions + np.einsum("nk,kab,nb->na", at / 2.0, TURNS, quaternions))

    inside = times[(times > used[0]) & (times < used[1])]
    breaks = np.unique(np.concatenate([attitude.breaks, inside, used]))
    apart = np.diff(breaks, prepend=-np.inf) > _LEAST_SHARE * (breaks[-1] - breaks[0])
    return from_function(breaks[apart], turned, attitude.coefficients.shape[2])
