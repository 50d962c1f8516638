"""Robust weights against their definition, computed with other algebra."""

import numpy as np
import pytest
from scipy.optimize import brentq

from amers.services.misfit.robust import CAUCHY_TUNING, MAD_TO_STD, deactivate, likeliest_variance
from amers.services.misfit.robust_kernel import reweighted_solution
from amers.services.types import Array, BoolArray

a_millipixel = 1e-3
SHIFT_ONLY = np.array([[True, False], [True, False]])


def robust_shift(values: Array, sigma_px: Array) -> float:
    """The shift (1,) of measures (n,) by the compiled solution, both coordinates alike."""
    design = np.column_stack([np.ones(len(values)), np.zeros(len(values))])
    both = np.stack([values, values])
    parameters = reweighted_solution(
        design, both, np.stack([sigma_px, sigma_px]), np.array([[0.0, 1.0]] * 2), SHIFT_ONLY
    )
    assert parameters[0, 0] == pytest.approx(parameters[1, 0])
    return float(parameters[0, 0])


def root_of_the_influence(values: Array, sigma_px: Array) -> float:
    """Where the sum of the influences of Cauchy's law is zero, by bisection."""

    def influence(shift: float) -> float:
        normalised = (values - shift) / sigma_px
        reach = CAUCHY_TUNING * MAD_TO_STD * np.median(np.abs(normalised))
        return float((normalised / sigma_px / (1.0 + (normalised / reach) ** 2)).sum())

    middle = float(np.median(values))
    return float(brentq(influence, middle - 1.0, middle + 1.0))


@pytest.mark.parametrize("seed", range(8))
def test_the_robust_shift_is_where_the_influences_of_cauchy_s_law_cancel(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sigma_px = rng.uniform(0.1, 0.4, 60)
    values = 2.0 + sigma_px * rng.standard_normal(60)
    values[:18] += rng.uniform(0.5, 6.0, 18)
    expected = root_of_the_influence(values, sigma_px)
    assert robust_shift(values, sigma_px) == pytest.approx(expected, abs=a_millipixel)


def test_all_sigmas_scaled_leave_the_robust_shift_where_it_is() -> None:
    rng = np.random.default_rng(1)
    sigma_px = rng.uniform(0.1, 0.4, 50)
    values = sigma_px * rng.standard_cauchy(50)
    scaled = [robust_shift(values, factor * sigma_px) for factor in (0.1, 1.0, 7.0)]
    np.testing.assert_allclose(scaled, scaled[1], atol=1e-6)


@pytest.mark.monte_carlo
def test_of_normal_errors_the_robust_shift_loses_a_twentieth_of_the_efficiency() -> None:
    rng = np.random.default_rng(2)
    sigma_px = np.ones(400)
    draws = rng.standard_normal((1500, 400))
    robust = np.array([robust_shift(draw, sigma_px) for draw in draws])
    efficiency = draws.mean(axis=1).var() / robust.var()
    assert 0.93 < efficiency < 0.97


def test_a_wrong_coordinate_takes_the_weight_of_both() -> None:
    """A measure that is wrong across the line is not believed along it either."""
    rng = np.random.default_rng(3)
    misfit = 0.01 * rng.standard_normal((2, 40))
    misfit[0, :15], misfit[1, :15] = 0.03, 50.0
    prior = np.array([[0.0, 1.0]] * 2)

    def shift(shown: Array) -> Array:
        design = np.column_stack([np.ones(shown.shape[1]), np.zeros(shown.shape[1])])
        return reweighted_solution(design, shown, np.full(shown.shape, 0.01), prior, SHIFT_ONLY)[:, 0]

    right = np.ascontiguousarray(misfit[:, 15:])
    np.testing.assert_allclose(shift(misfit), shift(right), atol=2.0 * a_millipixel)


def test_a_priori_weights_pull_as_observations_of_zero_do() -> None:
    rng = np.random.default_rng(4)
    place = rng.uniform(-1.0, 1.0, 80)
    misfit = np.stack([1.0 + 0.5 * place, -2.0 + 0.3 * place]) + 0.1 * rng.standard_normal((2, 80))
    design = np.column_stack([np.ones(80), place])
    sigma, every = np.full((2, 80), 0.1), np.ones((2, 2), dtype=bool)
    prior = np.array([[0.0, 900.0], [0.0, 100.0]])
    found = reweighted_solution(design, misfit, sigma, prior, every)
    for row in range(2):
        residual = np.abs((misfit - found @ design.T) / sigma)
        std = MAD_TO_STD * np.median(residual)
        robust = 1.0 / (1.0 + (residual.max(axis=0) / (std * CAUCHY_TUNING)) ** 2)
        root = np.sqrt(robust) / sigma[row]
        stacked = np.vstack([design * root[:, None], np.diag(np.sqrt(prior[row]))])
        right = np.concatenate([misfit[row] * root, np.zeros(2)])
        expected = np.linalg.lstsq(stacked, right, rcond=None)[0]
        np.testing.assert_allclose(found[row], expected, atol=a_millipixel)


@pytest.mark.parametrize("share", [0.05, 0.15])
def test_points_much_better_than_declared_are_seen_to_be(share: float) -> None:
    rng = np.random.default_rng(5)
    own = np.repeat(rng.uniform(0.05, 0.4, 900)[:, None] ** 2, 2, axis=1)
    declared = np.full((900, 2), 1.0)
    residual = np.sqrt(own + share**2 * declared) * rng.standard_normal((900, 2))
    variance = likeliest_variance(residual, own, declared)
    assert share / 1.6 < np.sqrt((variance - own).mean()) < share * 1.6
    # The order of the measures and the names of the coordinates do not matter.
    order = rng.permutation(900)
    again = likeliest_variance(residual[order][:, ::-1], own[order], declared)
    np.testing.assert_allclose(again, variance[order], rtol=1e-12)


def test_points_as_good_as_declared_keep_their_variance() -> None:
    rng = np.random.default_rng(6)
    own, declared = np.full((200, 2), 0.04), np.full((200, 2), 0.25)
    for _ in range(50):
        residual = np.sqrt(own + declared) * rng.standard_normal((200, 2))
        np.testing.assert_array_equal(likeliest_variance(residual, own, declared), own + declared)


def test_measures_leave_one_after_another_and_come_back_within_tolerance() -> None:
    """The far one spoils the mean at first, so that a good one looks worse than it is."""
    values = np.array([0.0, 0.1, -0.1, 0.05, 3.9, 40.0])

    def distance_from_the_mean(active: BoolArray) -> Array:
        return np.abs(values - values[active].mean())

    everything = np.ones(6, dtype=bool)
    clean = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 8.0])
    spoilt = np.where(np.arange(6) == 1, 9.0, clean)
    left = deactivate(lambda active: spoilt if active[5] else clean, everything, 3.2, 2)
    assert left.tolist() == [True] * 5 + [False]
    strict = deactivate(distance_from_the_mean, everything, 1.0, 2)
    assert strict.tolist() == [True, True, True, True, False, False]
    not_a_candidate = np.arange(6) != 2
    assert not deactivate(distance_from_the_mean, not_a_candidate, 3.2, 2)[2]


@pytest.mark.parametrize("minimum", [2, 3, 5])
def test_as_many_measures_stay_as_are_needed(minimum: int) -> None:
    values = 10.0 ** np.arange(6)

    def distance_from_the_mean(active: BoolArray) -> Array:
        return np.abs(values - values[active].mean())

    assert deactivate(distance_from_the_mean, np.ones(6, dtype=bool), 1e-3, minimum).sum() == minimum
