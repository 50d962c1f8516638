"""The selection of points covers the image and its range of heights."""

import numpy as np
import pytest

from amers.services.matching.predict import in_image, spread_over_image

SHAPE = (1000, 2000)


def test_an_image_extends_half_a_pixel_beyond_its_outermost_pixel_centres() -> None:
    at = np.array([[-0.5, -0.5], [999.5, 1999.5], [-0.6, 0.0], [0.0, 1999.6], [np.nan, 3.0]])
    np.testing.assert_array_equal(in_image(at, SHAPE, 0.0), [True, True, False, False, False])
    np.testing.assert_array_equal(in_image(at, SHAPE, 1.0), [True, True, True, True, False])


@pytest.mark.parametrize("count", [8, 40, 200])
def test_selected_points_cover_the_image_even_where_most_points_lie_in_a_corner(count: int) -> None:
    rng = np.random.default_rng(0)
    crowd, others = rng.uniform(0, [100, 200], (5000, 2)), rng.uniform([0, 0], SHAPE, (1000, 2))
    at = np.concatenate([crowd, others])
    rows = spread_over_image(at, np.zeros(6000), rng.uniform(0.0, 1.0, 6000), SHAPE, count)
    assert len(rows) == len(set(rows)) == count
    side = np.sqrt(SHAPE[0] * SHAPE[1] / (count / 2.0))
    cells, populated = (set(map(tuple, (a // side).astype(int))) for a in (at[rows], at))
    assert len(cells) >= 0.9 * min(len(populated), count)


def test_the_best_point_of_a_cell_is_selected_first() -> None:
    at = np.array([[5.0, 5.0], [6.0, 6.0], [7.0, 7.0], [900.0, 1900.0]])
    rows = spread_over_image(at, np.zeros(4), np.array([0.2, 0.9, 0.5, 0.1]), SHAPE, 2)
    np.testing.assert_array_equal(rows, [1, 3])
    np.testing.assert_array_equal(
        spread_over_image(at, np.zeros(4), np.array([0.2, 0.9, 0.5, 0.1]), SHAPE, 9), [1, 2, 0, 3]
    )


def test_the_second_point_of_a_cell_lies_at_another_height() -> None:
    at = np.array(
        [[5.0, 5.0], [6.0, 6.0], [7.0, 7.0], [900.0, 1900.0], [910.0, 1900.0], [920.0, 1900.0]]
    )
    height_m = np.array([10.0, 10.0, 900.0, 10.0, 10.0, 800.0])
    preference = np.array([0.9, 0.8, 0.1, 0.9, 0.8, 0.1])
    rows = spread_over_image(at, height_m, preference, SHAPE, 4)
    np.testing.assert_array_equal(np.sort(rows), [0, 2, 3, 5])
