"""Figures of the normal law and of samples against printed tables, from both sides."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amers.services.adjustment.intersected_marks import IntersectedMarks
from amers.services.matching.systematic_error import _student_factor
from amers.services.quality.accuracy import sample_quantile, statistics
from amers.services.quality.normal_law import CIRCULAR_CE90, LINEAR_LE90, normal_ce90, overall_ce90

CHI2_90_OF_2 = 4.605
"""Of 2 degrees of freedom, as all tables of the chi-square distribution have it."""


@pytest.mark.parametrize(
    ("ratio", "radius"),
    [(0.0, 1.64485), (0.2, 1.65731), (0.4, 1.69918), (0.5, 1.73708), (0.7, 1.86253), (1.0, 2.14597)],
)
def test_the_radius_of_90_percent_is_that_of_the_table(ratio: float, radius: float) -> None:
    """H. L. Harter, Circular error probabilities, J. American Statistical Association 55, 1960."""
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    law = 9.0 * turn @ np.diag([1.0, ratio**2]) @ turn.T
    assert normal_ce90(law[None])[0] == pytest.approx(3.0 * radius, abs=1e-3)
    assert overall_ce90(np.stack([law, law])) == pytest.approx(3.0 * radius, abs=1e-3)


def test_the_constants_are_those_of_the_tables() -> None:
    assert pytest.approx(1.6449, abs=5e-5) == LINEAR_LE90
    assert pytest.approx(CHI2_90_OF_2, abs=5e-4) == CIRCULAR_CE90**2


@pytest.mark.parametrize(
    ("freedom", "f_90"),
    [(1, 49.50), (2, 9.00), (3, 5.46), (4, 4.32), (10, 2.92), (30, 2.49), (120, 2.35)],
)
def test_a_region_of_an_estimated_variance_grows_as_the_table_of_f_says(
    freedom: int, f_90: float
) -> None:
    """F(2, freedom) over its limit, which is half of chi-square; three digits are printed."""
    assert _student_factor(freedom) == pytest.approx(f_90 / (CHI2_90_OF_2 / 2.0), rel=2e-3)


@pytest.mark.parametrize(
    ("freedom", "chi2", "tail"),
    [(1, 3.841, 0.05), (1, 0.00393, 0.05), (5, 11.070, 0.05), (5, 1.145, 0.05), (30, 50.892, 0.01)],
)
def test_the_chance_of_a_scale_counts_both_tails(freedom: int, chi2: float, tail: float) -> None:
    found: Any = SimpleNamespace(freedom=freedom, scale=(chi2 / freedom) ** 0.5)
    assert IntersectedMarks.scale_chance.fget(found) == pytest.approx(2.0 * tail, rel=2e-3)  # type: ignore[attr-defined]


def test_without_redundancy_a_scale_has_no_chance() -> None:
    found: Any = SimpleNamespace(freedom=0, scale=1.0)
    assert np.isnan(IntersectedMarks.scale_chance.fget(found))  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("count", "lower", "upper"), [(28, 22.0, None), (29, 23.0, 29.0), (100, 85.0, 96.0)]
)
def test_order_statistics_bound_a_quantile_as_the_binomial_table_says(
    count: int, lower: float, upper: float | None
) -> None:
    """For 100 values of 90 %: P(X <= 84) is 0.040 and P(X <= 85) 0.073; P(X >= 95) 0.058, 96 0.024."""
    found = sample_quantile(np.random.default_rng(1).permutation(count) + 1.0)
    assert found.lower == pytest.approx(lower)
    assert np.isnan(found.upper) if upper is None else found.upper == pytest.approx(upper)
    assert (f"{count} points; 30 are needed" in found.note) == (count < 30)
    assert ("do not bound" in found.note) == (upper is None)


def test_the_standard_deviation_of_a_sample_divides_by_one_less_and_its_rms_does_not() -> None:
    """2, 4, 4, 4, 5, 5, 7, 9: mean 5, sum of squared deviations 32, sum of squares 232."""
    found = statistics(np.array([2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0, np.nan]))
    assert (found.n, found.mean) == (8, 5.0)
    assert found.std == pytest.approx((32.0 / 7.0) ** 0.5)
    assert found.rms == pytest.approx((232.0 / 8.0) ** 0.5)
