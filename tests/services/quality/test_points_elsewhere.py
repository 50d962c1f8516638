"""Points that agree on another displacement: lost lines are told from ground that moved."""

import numpy as np
import pytest

from amers.services.quality.points_elsewhere import (
    Elsewhere,
    agree_elsewhere,
    are_contiguous,
    chance_of_contiguous,
    elsewhere_words,
)

LINES_LOST, DETECTOR, MOVED = "lines of the image were lost", "a detector is out of place", "moved"


def words_of(line: np.ndarray, others: np.ndarray, displacement_px: tuple[float, float]) -> str:
    """What is said of a scene whose points of these lines lie elsewhere."""
    rng = np.random.default_rng(3)
    sample = np.concatenate([rng.uniform(350.0, 650.0, len(line)), rng.uniform(0.0, 999.0, len(others))])
    line_sample = np.column_stack([np.concatenate([line, others]), sample])
    group = Elsewhere(np.arange(len(line)), np.array(displacement_px), 10.0, 1e-5)
    return elsewhere_words(group, line_sample, np.arange(len(line_sample)) >= len(line))


@pytest.fixture
def others() -> np.ndarray:
    return np.linspace(270.0, 1990.0, 40)


@pytest.mark.parametrize("along", [19.3, -19.3])
def test_one_far_point_does_not_hide_lost_lines(others: np.ndarray, along: float) -> None:
    assert LINES_LOST in words_of(np.array([1748.0, 84.0, 146.0, 236.0]), others, (along, 0.6))


@pytest.mark.parametrize("far", [[1748.0, 1900.0], [12.0, 1900.0], [12.0, 30.0]])
def test_two_far_points_are_no_chance_beside_lost_lines(far: list[float]) -> None:
    line = np.array([384.0, 446.0, 536.0, 560.0, *far])
    others = np.concatenate([np.linspace(32.0, 370.0, 20), np.linspace(570.0, 1890.0, 40)])
    assert LINES_LOST not in words_of(line, others, (19.3, 0.6))
    assert LINES_LOST in words_of(line[:-1], others, (19.3, 0.6))


def test_ground_that_moved_across_the_lines_is_judged_by_all_its_points(others: np.ndarray) -> None:
    line = np.array([84.0, 146.0, 236.0, 1748.0])
    assert MOVED in words_of(line, others, (19.3, 11.0))


def test_ground_that_moved_along_the_lines_has_others_beside_it(others: np.ndarray) -> None:
    assert MOVED in words_of(np.array([600.0, 820.0, 1010.0, 1250.0]), others, (19.3, 0.0))


def test_three_points_are_too_few_to_leave_one_out(others: np.ndarray) -> None:
    assert MOVED in words_of(np.array([84.0, 146.0, 1748.0]), others, (19.3, 0.0))


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


@pytest.mark.parametrize("seed", range(5))
def test_a_detector_out_of_place_is_named(seed: int) -> None:
    line_sample = np.random.default_rng(seed).uniform(0.0, 999.0, (120, 2))
    beside = line_sample[:, 1] // 125 == 3
    group = Elsewhere(np.flatnonzero(beside), np.array([4.0, -6.0]), 5.0, 1e-9)
    assert DETECTOR in elsewhere_words(group, line_sample, ~beside)


@pytest.mark.parametrize(("few", "others", "named"), [(3, 12, False), (12, 60, True)])
def test_few_points_of_some_samples_are_of_them_by_chance(few: int, others: int, named: bool) -> None:
    """Of 15 points three are neighbours in one of ten cases, of 72 twelve never."""
    line = np.concatenate([np.linspace(200.0, 1800.0, few), np.linspace(0.0, 1999.0, others)])
    beside = np.linspace(0.0, 999.0, others)
    beside = np.where(beside < 500.0, 0.9 * beside, 1000.0 - 0.9 * (1000.0 - beside))
    sample = np.concatenate([np.linspace(470.0, 530.0, few), beside])
    order = np.random.default_rng(4).permutation(others)
    line[few:] = line[few:][order]
    group = Elsewhere(np.arange(few), np.array([2.0, 9.0]), 10.0, 1e-5)
    words = elsewhere_words(group, np.column_stack([line, sample]), np.arange(few + others) >= few)
    assert (DETECTOR in words) == named


def test_a_round_area_that_moved_is_neither() -> None:
    rng = np.random.default_rng(9)
    for _ in range(50):
        line_sample = rng.uniform(0.0, 999.0, (120, 2))
        centre = rng.uniform(200.0, 800.0, 2)
        moved = np.hypot(*(line_sample - centre).T) < 180.0
        if moved.sum() >= 4:
            group = Elsewhere(np.flatnonzero(moved), np.array([4.0, -6.0]), 5.0, 1e-9)
            assert MOVED in elsewhere_words(group, line_sample, ~moved)


def test_points_left_out_agree_elsewhere_where_a_neighbour_is_displaced_alike() -> None:
    """False matches lie anywhere in the window of the search."""
    rng = np.random.default_rng(11)
    expected = rng.uniform(0.0, 999.0, (400, 2))
    part = (expected < 350.0).all(axis=1)
    false = ~part & (rng.random(400) < 0.15)
    misfit_px = rng.normal(0.0, 0.2, (400, 2))
    misfit_px[part] += [5.0, 4.0]
    misfit_px[false] = rng.uniform(-9.0, 9.0, (false.sum(), 2))
    away = agree_elsewhere(expected, misfit_px, part | false, 1.1)
    assert away[part].mean() > 0.95
    assert away[false].mean() < 0.15
    assert not away[~part & ~false].any()


def test_points_that_lie_within_the_scatter_of_the_others_are_not_elsewhere() -> None:
    expected = np.random.default_rng(12).uniform(0.0, 999.0, (50, 2))
    near = np.full((50, 2), 0.5)
    assert not agree_elsewhere(expected, near, np.ones(50, dtype=bool), 1.0).any()
    assert agree_elsewhere(expected, 2.0 * near, np.ones(50, dtype=bool), 1.0).all()
    alone = np.arange(50) == 7
    assert not agree_elsewhere(expected, 9.0 * near, alone, 1.0).any()


def test_a_part_that_the_pixels_show_is_the_cause(others: np.ndarray) -> None:
    line_sample = np.column_stack([np.concatenate([others[:4], others]), np.linspace(0.0, 999.0, 44)])
    group = Elsewhere(np.arange(4), np.array([4.0, -6.0]), 5.0, 1e-9)
    words = elsewhere_words(group, line_sample, np.arange(44) >= 4, in_part=True)
    assert words.endswith("The pixels show a part of another image there")
