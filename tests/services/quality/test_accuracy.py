"""Quantiles, their intervals and normalised errors against known laws and tables."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amers.services.quality.accuracy import accuracy, normalised_error, sample_quantile, statistics
from amers.services.quality.normal_law import CIRCULAR_CE90, normal_ce90

a_ten_thousandth = 1e-4


@pytest.mark.long
def test_the_interval_holds_the_true_quantile_as_often_as_stated():
    rng = np.random.default_rng(5)
    trials, n, truth = 2000, 60, -np.log(0.1)
    inside = 0
    for _ in range(trials):
        quantile = sample_quantile(rng.exponential(size=n))
        inside += quantile.lower <= truth <= quantile.upper
    three_standard_errors = 3.0 * np.sqrt(0.9 * 0.1 / trials)
    assert inside / trials > 0.9 - three_standard_errors


@pytest.mark.long
def test_the_estimate_is_above_the_truth_as_often_as_below():
    rng = np.random.default_rng(6)
    trials, truth = 4000, -np.log(0.1)
    above = np.mean([sample_quantile(rng.exponential(size=40)).value > truth for _ in range(trials)])
    assert above == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("values", [np.empty(0), np.array([np.nan, np.nan])])
def test_no_points_give_no_figure(values):
    quantile = sample_quantile(values)
    assert quantile.n == 0
    assert np.isnan([quantile.value, quantile.lower, quantile.upper]).all()
    assert quantile.note == "no points"


@pytest.mark.filterwarnings("error")
def test_one_value_has_a_mean_and_no_standard_deviation() -> None:
    """Nothing is divided by a freedom of nothing."""
    of_one = statistics(np.array([np.nan, 3.0]))
    assert (of_one.n, of_one.mean, of_one.rms) == (1, 3.0, 3.0)
    assert np.isnan(of_one.std)
    of_two = statistics(np.array([3.0, 5.0]))
    assert of_two.std == pytest.approx(np.sqrt(2.0))


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=200))
def test_a_quantile_lies_within_its_interval_and_its_sample(values):
    quantile = sample_quantile(np.array(values))
    rounding = 1e-9 * (1.0 + np.abs(values).max())
    assert min(values) - rounding <= quantile.value <= max(values) + rounding
    assert np.isnan(quantile.lower) or quantile.lower <= quantile.value + rounding
    assert np.isnan(quantile.upper) or quantile.value <= quantile.upper + rounding


def test_accuracy_separates_bias_from_spread_on_each_axis():
    error_m = np.array([[1.0, 2.0, -3.0], [3.0, 2.0, -5.0], [np.nan, 0.0, 0.0]])
    result = accuracy(error_m)
    assert result.n == 2
    assert result.bias_m == (2.0, 2.0, -4.0)
    assert result.std_m == pytest.approx((np.sqrt(2.0), 0.0, np.sqrt(2.0)))
    assert result.rmse_m == pytest.approx((np.sqrt(5.0), 2.0, np.sqrt(17.0)))
    assert result.le90_m is not None
    assert result.le90_m.value == pytest.approx(5.0)


def test_heights_that_groups_share_loosen_no_ce90_and_places_that_they_share_no_le90():
    rng, group = np.random.default_rng(4), np.repeat(np.arange(10), 40)
    own, shared = rng.normal(size=(400, 3)), 3.0 * rng.normal(size=(10, 3))[group]
    alone, of_places, of_heights = (
        accuracy(own + shared * columns, group) for columns in ([0, 0, 0], [1, 1, 0], [0, 0, 1])
    )
    assert of_places.le90_m == alone.le90_m
    assert of_heights.ce90_m == alone.ce90_m


def test_ce90_of_a_circular_sample_is_the_known_factor():
    error_m = np.random.default_rng(1).normal(0.0, 2.0, (200_000, 2))
    quantile = accuracy(error_m).ce90_m
    assert quantile.value == pytest.approx(2.0 * CIRCULAR_CE90, rel=0.005)


def test_an_honest_precision_has_normalised_errors_near_one():
    rng = np.random.default_rng(2)
    covariance = np.array([[0.5, 0.2], [0.2, 0.3]])
    error = rng.multivariate_normal(np.zeros(2), covariance, 500)
    honest = normalised_error(error, np.broadcast_to(covariance, (500, 2, 2)))
    flattering = normalised_error(error, np.broadcast_to(covariance / 4.0, (500, 2, 2)))
    modest = normalised_error(error, np.broadcast_to(covariance * 2.0, (500, 2, 2)))
    assert honest.lower < honest.mean_square < honest.upper
    assert flattering.mean_square == pytest.approx(4.0 * honest.mean_square)
    assert flattering.mean_square > flattering.upper
    assert modest.mean_square < modest.lower


@pytest.mark.parametrize(
    ("rows", "columns", "lower", "upper"),
    [(1, 1, 0.000982, 5.024), (5, 2, 3.247, 20.483), (10, 3, 16.791, 46.979), (50, 1, 32.357, 71.420)],
)
def test_an_honest_mean_square_lies_within_tabulated_chi_squares(rows, columns, lower, upper):
    """Quantiles 0.025 and 0.975 of chi-square, as printed in tables."""
    stated = normalised_error(np.ones((rows, columns)), np.tile(np.eye(columns), (rows, 1, 1)))
    freedom = rows * columns
    assert stated.lower * freedom == pytest.approx(lower, rel=5e-4)
    assert stated.upper * freedom == pytest.approx(upper, rel=5e-4)
    assert (stated.n, stated.mean_square) == (rows, 1.0)


def test_normalised_errors_leave_out_missing_values():
    error = np.array([[1.0, 1.0], [np.nan, 1.0], [1.0, 1.0]])
    covariance = np.stack([np.eye(2), np.eye(2), np.full((2, 2), np.nan)])
    result = normalised_error(error, covariance)
    assert (result.n, result.mean_square) == (1, 1.0)
    assert np.isnan(normalised_error(error[1:2], covariance[1:2]).mean_square)


def test_predicted_ce90_of_an_unknown_covariance_is_unknown():
    result = normal_ce90(np.stack([np.full((2, 2), np.nan), np.zeros((2, 2))]))
    assert np.isnan(result[0])
    assert result[1] == 0.0
