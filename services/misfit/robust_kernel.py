"""Compiled robust solution, which cross-validation computes some twenty times per scene."""

import numpy as np
from numba import njit

from amers.services.misfit.robust import CAUCHY_TUNING, MAD_TO_STD, ROUNDING
from amers.services.types import Array, BoolArray

_STEPS = 20
_STEADY_PX = 1e-4


@njit(cache=True, error_model="numpy")
def reweighted_solution(
    design: Array, misfit: Array, sigma: Array, prior: Array, estimated: BoolArray
) -> Array:
    """Parameters (2, k) by iterative re-weighting with Cauchy weights from the median shift on.

    Args:
        design: (n, k) derivative of each coordinate by its parameters; the first is the shift.
        misfit: (2, n) pixels.
        sigma: (2, n) pixels.
        prior: (2, k) a priori weights of the parameters.
        estimated: (2, k) parameters that are not zero.
    """
    count, size = design.shape
    parameters = np.zeros((2, size))
    normalised = np.empty((2, count))
    for c in range(2):
        parameters[c, 0] = np.median(misfit[c])
    for _ in range(_STEPS):
        for c in range(2):
            normalised[c] = np.abs((misfit[c] - design @ parameters[c]) / sigma[c])
        std = max(MAD_TO_STD * np.median(normalised), 1e-9)
        robust = 1.0 / (1.0 + (np.maximum(normalised[0], normalised[1]) / (std * CAUCHY_TUNING)) ** 2)
        change = 0.0
        for c in range(2):
            used = design * estimated[c]
            weighted = used.T * (robust / sigma[c] ** 2)
            normal = weighted @ used
            normal += np.diag(prior[c] + ROUNDING * np.trace(normal))
            updated = np.linalg.solve(normal, weighted @ misfit[c])
            change = max(change, np.abs(updated - parameters[c]).max())
            parameters[c] = updated
        if change < _STEADY_PX:
            break
    return parameters
