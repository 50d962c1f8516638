"""Points that agree on another displacement: lost lines are told from ground that moved."""

import numpy as np
import pytest

from services.quality.lack_of_fit import (
    Elsewhere,
    are_whole_lines,
    chance_of_whole_lines,
    elsewhere_criterion,
)


def judged(line: np.ndarray, others: np.ndarray, displacement_px: tuple[float, float]) -> str:
    """What a scene cannot be whose points of these lines lie elsewhere."""
    elsewhere = Elsewhere(np.arange(len(line)), np.array(displacement_px), 10.0, 1e-5)
    line_sample = np.column_stack(
        [np.concatenate([line, others]), np.full(len(line) + len(others), 5.0)]
    )
    active = np.arange(len(line_sample)) >= len(line)
    criterion = elsewhere_criterion(elsewhere, line_sample, active, (2000, 10))
    assert not criterion.met
    return criterion.needed_for


@pytest.fixture
def others() -> np.ndarray:
    return np.linspace(270.0, 1990.0, 40)


@pytest.mark.parametrize("along", [19.3, -19.3])
def test_one_far_point_does_not_hide_lost_lines(others: np.ndarray, along: float) -> None:
    line = np.array([1748.0, 84.0, 146.0, 236.0])
    assert judged(line, others, (along, 0.6)) == "usable"


def test_ground_that_moved_across_the_lines_is_judged_by_all_its_points(others: np.ndarray) -> None:
    line = np.array([84.0, 146.0, 236.0, 1748.0])
    assert judged(line, others, (19.3, 11.0)) == "good"


def test_ground_that_moved_along_the_lines_has_others_beside_it(others: np.ndarray) -> None:
    assert judged(np.array([600.0, 820.0, 1010.0, 1250.0]), others, (19.3, 0.0)) == "good"


def test_three_points_are_too_few_to_leave_one_out(others: np.ndarray) -> None:
    assert judged(np.array([84.0, 146.0, 1748.0]), others, (19.3, 0.0)) == "good"


@pytest.mark.parametrize(("side", "needed_for"), [(0.3, "good"), (0.7, "usable")])
def test_a_part_that_lies_elsewhere_counts_by_its_area_not_by_its_points(
    side: float, needed_for: str
) -> None:
    """Few points show a large part where it is woods, many a small one where it is a town."""
    rng = np.random.default_rng(7)
    place = rng.random((4000, 2))
    inside = (place < side).all(axis=1)
    few, many = place[inside][:8], place[~inside][:60]
    line_sample = 1000.0 * np.concatenate([few, many])
    elsewhere = Elsewhere(np.arange(8), np.array([9.0, 11.0]), 10.0, 1e-5)
    active = np.arange(len(line_sample)) >= 8
    criterion = elsewhere_criterion(elsewhere, line_sample, active, (1000, 1000))
    assert not criterion.met
    assert criterion.needed_for == needed_for


@pytest.mark.parametrize(("n", "m"), [(3, 6), (4, 12), (5, 12), (8, 12)])
def test_points_drawn_at_random_are_seldom_of_whole_lines(n: int, m: int) -> None:
    rng = np.random.default_rng([5, n, m])
    draws, seen = 20_000, 0
    for _ in range(draws):
        line = rng.permutation(n + m).astype(float)
        seen += are_whole_lines(line[:n], line[n:])
    stated = chance_of_whole_lines(np.arange(float(n)), np.arange(float(m)))
    assert seen / draws <= stated + 3.0 * np.sqrt(stated / draws)
    assert seen / draws >= stated / 4.0
