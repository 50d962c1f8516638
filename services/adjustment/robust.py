"""Robust weights and the deactivation of measures beyond tolerance."""

from collections.abc import Callable

import numpy as np

from services.types import Array, BoolArray

MAD_TO_STD = 1.4826
CAUCHY_TUNING = 2.385
"""95 % efficiency on normal errors (Holland and Welsch, 1977)."""


def cauchy_weights(normalised: Array) -> Array:
    """Weights (n,) of residuals that are given in units of their standard deviation (n,)."""
    return np.asarray(1.0 / (1.0 + (normalised / CAUCHY_TUNING) ** 2))


def deactivate(
    solve: Callable[[BoolArray], Array], active: BoolArray, tolerance: float, minimum: int
) -> BoolArray:
    """Turn measures off one after another until none is beyond tolerance.

    The worst leaves, the rest is solved again; a measure that turns out good later comes back.

    Args:
        solve: from the active measures to the magnitude (n,) of every measure's residual, in units of
            its own standard deviation.
        active: (n,) measures to begin with.
        tolerance: the magnitude beyond which a measure leaves.
        minimum: how many measures stay in any case.

    Returns:
        (n,) measures that are active at the end.
    """
    candidates, active = active, active.copy()
    while active.sum() > minimum:
        magnitude = np.where(active, solve(active), -np.inf)
        worst = int(np.argmax(magnitude))
        if magnitude[worst] <= tolerance:
            break
        active[worst] = False
    final = solve(active)
    return np.asarray(active | (candidates & (final <= tolerance)))
