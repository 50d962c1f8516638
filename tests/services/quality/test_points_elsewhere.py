"""Points that agree on another displacement: lost lines are told from ground that moved."""

import numpy as np
import pytest

from amers.services.quality.criteria import Criterion
from amers.services.quality.lack_of_fit import (
    Elsewhere,
    are_contiguous,
    chance_of_contiguous,
    elsewhere_criterion,
)


def judged(line: np.ndarray, others: np.ndarray, displacement_px: tuple[float, float]) -> str:
    """What a scene cannot be whose points of these lines lie elsewhere."""
    elsewhere = Elsewhere(np.arange(len(line)), np.array(displacement_px), 10.0, 1e-5)
    rng = np.random.default_rng(3)
    sample = np.concatenate([rng.uniform(350.0, 650.0, len(line)), rng.uniform(0.0, 999.0, len(others))])
    line_sample = np.column_stack([np.concatenate([line, others]), sample])
    active = np.arange(len(line_sample)) >= len(line)
    criterion = elsewhere_criterion(elsewhere, line_sample, active, (2000, 1000))
    assert not criterion.met
    return criterion.needed_for


@pytest.fixture
def others() -> np.ndarray:
    return np.linspace(270.0, 1990.0, 40)


@pytest.mark.parametrize("along", [19.3, -19.3])
def test_one_far_point_does_not_hide_lost_lines(others: np.ndarray, along: float) -> None:
    line = np.array([1748.0, 84.0, 146.0, 236.0])
    assert judged(line, others, (along, 0.6)) == "usable"


@pytest.mark.parametrize("far", [[1748.0, 1900.0], [12.0, 1900.0], [12.0, 30.0]])
def test_two_far_points_are_no_chance_beside_lost_lines(far: list[float]) -> None:
    line = np.array([384.0, 446.0, 536.0, 560.0, *far])
    others = np.concatenate([np.linspace(32.0, 370.0, 20), np.linspace(570.0, 1890.0, 40)])
    assert judged(line, others, (19.3, 0.6)) == "good"
    assert judged(line[:-1], others, (19.3, 0.6)) == "usable"


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


@pytest.mark.parametrize(("n", "m"), [(3, 6), (4, 12), (5, 12), (8, 12), (14, 6), (21, 5)])
def test_points_drawn_at_random_are_seldom_of_whole_lines(n: int, m: int) -> None:
    rng = np.random.default_rng([5, n, m])
    draws, seen = 20_000, 0
    for _ in range(draws):
        line = rng.permutation(n + m).astype(float)
        seen += are_contiguous(line[:n], line[n:])
    stated = chance_of_contiguous(np.arange(float(n)), np.arange(float(m)))
    assert seen / draws <= stated + 3.0 * np.sqrt(stated / draws)
    assert seen / draws >= stated / 4.0


def of_detectors(elsewhere: np.ndarray, seed: int) -> Criterion:
    """The criterion on points of some detectors of eight that lie elsewhere, of points all over."""
    line_sample = np.random.default_rng(seed).uniform(0.0, 999.0, (120, 2))
    beside = np.isin(line_sample[:, 1] // 125, elsewhere)
    group = Elsewhere(np.flatnonzero(beside), np.array([4.0, -6.0]), 5.0, 1e-9)
    return elsewhere_criterion(group, line_sample, ~beside, (1000, 1000))


@pytest.mark.parametrize("seed", range(5))
def test_a_detector_out_of_place_makes_a_scene_unusable_and_is_named(seed: int) -> None:
    criterion = of_detectors(np.array([3]), seed)
    assert (criterion.met, criterion.needed_for) == (False, "usable")
    assert "a detector is out of place" in criterion.note


@pytest.mark.parametrize("seed", range(5))
def test_detectors_that_alternate_leave_no_place_that_is_the_scenes(seed: int) -> None:
    criterion = of_detectors(np.array([1, 4, 6]), seed)
    assert (criterion.met, criterion.needed_for) == (False, "usable")
    assert "detectors alternate" in criterion.note


def test_detectors_that_alternate_are_told_by_few_of_their_points() -> None:
    """Points of the middle of the image: those at its sides lie beside the points elsewhere."""
    line_sample = np.random.default_rng(3).uniform(0.0, 999.0, (160, 2))
    beside = np.isin(line_sample[:, 1] // 100, [2, 5, 6]) & (np.arange(160) % 4 != 0)
    group = Elsewhere(np.flatnonzero(beside), np.array([4.0, -6.0]), 5.0, 1e-9)
    active = ~np.isin(line_sample[:, 1] // 100, [2, 5, 6])
    hull = (line_sample[:, 1] > 200.0) & (line_sample[:, 1] < 700.0) & active
    assert 0.2 < hull.sum() / active.sum() < 0.3
    criterion = elsewhere_criterion(group, line_sample, active, (1000, 1000))
    assert (criterion.met, criterion.needed_for) == (False, "usable")
    assert "detectors alternate" in criterion.note


@pytest.mark.parametrize(("few", "others", "needed_for"), [(3, 12, "good"), (12, 60, "usable")])
def test_few_points_of_some_samples_are_of_them_by_chance(
    few: int, others: int, needed_for: str
) -> None:
    """Of 15 points three are neighbours in one of ten cases, of 72 twelve never."""
    line = np.concatenate([np.linspace(200.0, 1800.0, few), np.linspace(0.0, 1999.0, others)])
    beside = np.linspace(0.0, 999.0, others)
    beside = np.where(beside < 500.0, 0.9 * beside, 1000.0 - 0.9 * (1000.0 - beside))
    sample = np.concatenate([np.linspace(470.0, 530.0, few), beside])
    order = np.random.default_rng(4).permutation(others)
    line[few:] = line[few:][order]
    line_sample = np.column_stack([line, sample])
    elsewhere = Elsewhere(np.arange(few), np.array([2.0, 9.0]), 10.0, 1e-5)
    criterion = elsewhere_criterion(elsewhere, line_sample, np.arange(few + others) >= few, (2000, 1000))
    assert criterion.needed_for == needed_for
    assert ("a detector is out of place" in criterion.note) == (needed_for == "usable")


def test_a_round_area_that_moved_is_neither() -> None:
    rng = np.random.default_rng(9)
    for _ in range(50):
        line_sample = rng.uniform(0.0, 999.0, (120, 2))
        centre = rng.uniform(200.0, 800.0, 2)
        moved = np.hypot(*(line_sample - centre).T) < 180.0
        if moved.sum() >= 4:
            group = Elsewhere(np.flatnonzero(moved), np.array([4.0, -6.0]), 5.0, 1e-9)
            criterion = elsewhere_criterion(group, line_sample, ~moved, (1000, 1000))
            assert criterion.needed_for == "good", criterion.note


@pytest.mark.parametrize("few", [3, 5])
def test_a_few_points_that_a_pattern_displaces_alike_do_not_break_an_image(few: int) -> None:
    """Fields and vineyards repeat themselves: points all over the image may agree on the next row."""
    for seed in range(20):
        line_sample = np.random.default_rng([few, seed]).uniform(0.0, 999.0, (120, 2))
        group = Elsewhere(np.arange(few), np.array([4.0, -6.0]), 5.0, 1e-9)
        criterion = elsewhere_criterion(group, line_sample, np.arange(120) >= few, (1000, 1000))
        assert criterion.needed_for == "good", criterion.note
