"""Attitudes of a satellite over time, as piecewise polynomials of quaternions x, y, z, w."""

import numpy as np

from services.sensors.piecewise import PiecewisePolynomial, lagrange
from services.types import Array


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
