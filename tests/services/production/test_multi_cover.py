"""Covers against the optimum that HiGHS proves, and a bound that no cover falls below."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

from amers.services.production.multi_cover import (
    CoverProblem,
    bound_of,
    greedy_cover,
    lower_bound,
    without_excess,
)


def random_problem(seed, side=12, images=90, views=3):
    """Rectangles of cells on a square, some cells hidden in each."""
    rng = np.random.default_rng(seed)
    covers = np.zeros((images, side, side), dtype=bool)
    for one in covers:
        row, column = rng.integers(-2, side - 1, 2)
        one[max(row, 0) : row + 5, max(column, 0) : column + 4] = True
    covers &= rng.random(covers.shape) > rng.uniform(0.0, 0.5, (images, 1, 1))
    matrix = covers.reshape(images, -1)
    image, cell = np.nonzero(matrix)
    return matrix, CoverProblem(
        start=np.searchsorted(image, np.arange(images + 1)).astype(np.int64),
        cell=cell.astype(np.int32),
        need=np.minimum(matrix.sum(axis=0), views).astype(np.int16),
        classes=np.zeros((images, 1), dtype=np.uint8),
        preference=np.ones(images),
    )


def optimum(matrix, problem):
    """The smallest number of images, proved by branch and bound."""
    needs = LinearConstraint(matrix.T.astype(float), lb=problem.need)
    found = milp(np.ones(len(matrix)), constraints=needs, bounds=Bounds(0, 1), integrality=1)
    assert found.success
    return round(found.fun)


def solve(problem):
    """A cover as the selection makes it, and its bound."""
    first = greedy_cover(problem, np.ones(len(problem.need)), 0.0)
    bound = lower_bound(problem, int(first.sum()), 3000)
    cover = greedy_cover(problem, bound.price + 0.1 * bound.price.mean(), 0.0)
    return without_excess(problem, cover, np.arange(len(cover))), bound


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.long
def test_a_cover_is_near_the_optimum_and_the_bound_below_it(seed):
    matrix, problem = random_problem(seed)
    cover, bound = solve(problem)
    best = optimum(matrix, problem)
    assert (matrix[cover].sum(axis=0) >= problem.need).all()
    assert bound.images <= best + 1e-6
    assert best <= cover.sum() <= 1.15 * best


@pytest.mark.parametrize("seed", range(6))
def test_the_bound_reaches_the_linear_relaxation_within_two_percent(seed):
    matrix, problem = random_problem(seed)
    _, bound = solve(problem)
    relaxed = linprog(
        np.ones(len(matrix)), A_ub=-matrix.T.astype(float), b_ub=-problem.need, bounds=(0, 1)
    )
    assert 0.98 * relaxed.fun <= bound.images <= relaxed.fun + 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_any_prices_give_a_valid_bound(seed):
    matrix, problem = random_problem(seed)
    best = optimum(matrix, problem)
    rng = np.random.default_rng(seed)
    for scale in (0.001, 0.03, 0.3, 10.0):
        assert bound_of(problem, scale * rng.random(len(problem.need))) <= best + 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_where_every_image_is_needed_the_bound_is_their_number(seed):
    # Prices may then grow without end, and the bound is the difference of two large numbers.
    matrix, problem = random_problem(seed, images=8)
    every = replace(problem, need=matrix.sum(axis=0).astype(np.int16))
    assert bound_of(every, np.full(len(every.need), 1e14)) <= 8.0
    _, bound = solve(every)
    assert 7.99 <= bound.images <= 8.0


@pytest.mark.parametrize("seed", range(4))
def test_no_image_of_a_cover_can_be_left_out(seed):
    matrix, problem = random_problem(seed, images=200)
    cover, _ = solve(problem)
    for image in np.flatnonzero(cover):
        left = cover.copy()
        left[image] = False
        assert (matrix[left].sum(axis=0) < problem.need).any()


def test_unnecessary_images_are_taken_out_in_the_order_asked():
    _, problem = random_problem(3)
    every = np.ones(len(problem.preference), dtype=bool)
    first = without_excess(problem, every, np.arange(90))
    last = without_excess(problem, every, np.arange(90)[::-1])
    assert not first[0]
    assert not last[-1]
    assert (problem.covers(first) >= problem.need).all()


def test_the_lazy_gains_choose_as_all_gains_do():
    """Against a plain loop that computes every gain before every choice."""
    for seed in range(5):
        matrix, problem = random_problem(seed)
        rng = np.random.default_rng(seed)
        classes = (1 << rng.integers(0, 4, (len(matrix), 2))).astype(np.uint8)
        problem = replace(problem, classes=classes, preference=rng.uniform(0.8, 1.0, len(matrix)))
        weight = rng.uniform(0.5, 1.5, len(problem.need))
        chosen = np.zeros(len(matrix), dtype=bool)
        seen = np.zeros((matrix.shape[1], 2), dtype=np.uint8)
        while True:
            missing = problem.need > matrix[chosen].sum(axis=0)
            new = ((classes[:, None, :] & ~seen[None]) != 0).sum(axis=2)
            gain = problem.preference * (matrix * (missing * weight * (1.0 + 0.2 * new))).sum(axis=1)
            gain[chosen] = 0.0
            if gain.max() <= 0.0:
                break
            best = int(gain.argmax())
            chosen[best] = True
            seen[matrix[best]] |= classes[best]
        assert (greedy_cover(problem, weight, 0.2) == chosen).all()


def test_a_new_class_decides_between_images_that_cover_the_same():
    everything = np.arange(4, dtype=np.int32)
    problem = CoverProblem(
        start=np.arange(0, 13, 4),
        cell=np.tile(everything, 3),
        need=np.full(4, 2, dtype=np.int16),
        classes=np.array([[1], [1], [2]], dtype=np.uint8),
        preference=np.array([1.0, 0.99, 0.98]),
    )
    assert greedy_cover(problem, np.ones(4), 0.0).tolist() == [True, True, False]
    assert greedy_cover(problem, np.ones(4), 0.1).tolist() == [True, False, True]


def test_an_image_without_cells_and_a_cell_without_images_are_no_obstacle():
    problem = CoverProblem(
        start=np.array([0, 0, 1]),
        cell=np.zeros(1, dtype=np.int32),
        need=np.array([1, 0], dtype=np.int16),
        classes=np.zeros((2, 1), dtype=np.uint8),
        preference=np.ones(2),
    )
    cover, bound = solve(problem)
    assert cover.tolist() == [False, True]
    assert bound.images == pytest.approx(1.0)
