"""90 % regions hold 90 % of the truth: a few cells of `python -m benchmarks.coverage`."""

import pytest

from benchmarks.coverage import LOWEST, Case, measure

pytestmark = [pytest.mark.monte_carlo, pytest.mark.thorough]

TRIALS = 40


@pytest.mark.parametrize(
    "case",
    [
        Case(6, "spread", "independent", "sigmas / 4"),
        Case(20, "spread", "independent", "normal"),
        Case(60, "two clusters", "independent", "heavy tails"),
        Case(300, "line", "independent", "heavy tails"),
        Case(60, "spread", "correlated", "normal"),
        Case(300, "spread", "correlated", "heavy tails"),
        Case(300, "spread", "correlated", "normal"),
        Case(300, "corner", "correlated", "normal"),
        Case(20, "line", "two blocks", "normal"),
        Case(300, "spread", "two blocks", "normal"),
        Case(300, "two clusters", "two blocks", "sigmas / 4"),
    ],
    ids=lambda case: f"{case.count} {case.layout}, {case.shared}, {case.law}",
)
def test_a_region_of_90_percent_holds_the_truth(case: Case) -> None:
    coverage = measure(case, TRIALS, seed=1)
    assert coverage.held >= LOWEST
    assert coverage.refused == 0


def test_more_points_do_not_promise_more_than_they_know() -> None:
    """Points that share errors: fifteen times as many are no more than twice as precise."""
    few = measure(Case(20, "spread", "correlated", "normal"), TRIALS, seed=2)
    many = measure(Case(300, "spread", "correlated", "normal"), TRIALS, seed=2)
    assert many.worst_ce90_px > few.worst_ce90_px / 2.0


def test_independent_points_keep_their_precision() -> None:
    """CE90 of the worst corner in pixels, as it was before errors in common were considered."""
    coverage = measure(Case(300, "spread", "independent", "normal"), TRIALS, seed=3)
    assert coverage.worst_ce90_px < 1.15 * 0.11
