"""Points that rays and a known height place, whatever some of the rays say."""

import numpy as np
import pytest

from amers.services.adjustment.normal_equations import Equations, RobustTerms, robust_points
from amers.services.types import Array

a_hundredth = 0.01


def rays_of_a_point(lean: Array, seen: Array) -> Equations:
    """Rays (n,) that lean along the rows: each shows one point at a row, all at column 0."""
    n = len(lean)
    by_ground = np.zeros((n, 2, 3))
    by_ground[:, 0, 0] = by_ground[:, 1, 1] = 1.0
    by_ground[:, 0, 2] = lean
    return Equations(
        point=np.zeros(n, dtype=np.int64),
        block=np.arange(n),
        residual=np.column_stack([seen, np.zeros(n)]),
        by_ground=by_ground,
        by_parameters=np.zeros((n, 2, 1)),
        weight=np.ones(n),
    )


@pytest.mark.parametrize("height_m", [10.0, -10.0, 0.0])
def test_a_known_height_decides_which_of_four_rays_are_wrong(height_m: float) -> None:
    """Two rays meet at the place and its height, the others with one of these at the height before."""
    lean = np.array([0.5, -0.5, -0.5, -0.5])
    right = 3.0 + lean * height_m
    wrong = np.array([0.0, 0.0, *(right[0] - right[2:] + [-0.8, 0.8] if height_m else (8.0, 12.0))])
    terms = RobustTerms(1.0, np.array([3.0]), np.array([1e4]), np.array([height_m]))
    step, weight = robust_points(rays_of_a_point(lean, right + wrong), 4, terms)
    assert step[0] == pytest.approx([3.0, 0.0, height_m], abs=1.0)
    assert weight[:2].min() > 0.7
    assert weight[2:].max() < 0.3


def test_a_height_that_nothing_tells_leaves_parallel_rays_without_a_place() -> None:
    lean = np.array([0.3, 0.3])
    rays = rays_of_a_point(lean, 3.0 + lean * 5.0)
    for known_weight, expected in ((0.0, [np.nan] * 3), (1.0, [3.0, 0.0, 5.0])):
        terms = RobustTerms(1.0, np.array([2.0]), np.array([known_weight]), np.array([5.0]))
        step, weight = robust_points(rays, 2, terms)
        np.testing.assert_allclose(step[0], expected, atol=a_hundredth)
        assert (weight > 0.0).all() == (known_weight > 0.0)
