"""The order of a correction is the simplest that predicts measures which were held out."""

import numpy as np
import pytest

from amers.services.misfit.affine_fit import ORDERS, AffineFit
from amers.services.misfit.order_selection import choose_order
from amers.services.misfit.scene_adjustment import AdjustmentOptions

SIGMA_PX = 0.5
COUNT = 60


def share_of_shifts(drift_px: float, min_gain: float) -> float:
    """Share of 40 scenes, of points with noise and a drift along the lines, that get a shift alone."""
    shifts = []
    for seed in range(40):
        rng = np.random.default_rng([41, seed])
        t = rng.uniform(-1.0, 1.0, (COUNT, 2))
        misfit = SIGMA_PX * rng.normal(size=(COUNT, 2))
        misfit[:, 0] += drift_px * t[:, 0]
        variance = np.full((COUNT, 2), SIGMA_PX**2)
        fit = AffineFit(t, misfit, variance, np.zeros((COUNT, 0)), np.zeros((2, 0)))
        order, _ = choose_order(fit, np.ones(COUNT, dtype=np.bool_), ORDERS, min_gain, 5)
        shifts.append(order == "shift")
    return float(np.mean(shifts))


def test_a_scene_without_drift_gets_a_shift_unless_any_gain_is_enough() -> None:
    assert share_of_shifts(0.0, AdjustmentOptions().min_gain) > 0.9
    assert share_of_shifts(0.0, 0.0) < 0.85


@pytest.mark.parametrize(("drift_px", "min_gain"), [(1.0, 0.03), (1.0, 0.15)])
def test_a_drift_is_chosen_that_is_larger_than_the_noise(drift_px: float, min_gain: float) -> None:
    assert share_of_shifts(drift_px, min_gain) < 0.1


def test_a_drift_that_gains_less_than_was_asked_is_left() -> None:
    """A drift of half of the noise makes the distances a twentieth larger."""
    assert share_of_shifts(0.5, 0.15) > 0.9
    assert share_of_shifts(0.5, 0.01) < 0.4
