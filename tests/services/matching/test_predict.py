"""Points are chosen all over the image, and of each the views that look most like the scene."""

import numpy as np
import pytest

from services.matching.predict import choose_views, inside, spread_over_image
from services.types import Acquisition, ControlPoints, Views

SHAPE = (1000, 2000)


def point_with_views(
    gsd_m: list[float], incidence_deg: list[float], azimuth_deg: list[float]
) -> ControlPoints:
    """One point, with a point of one view before it."""
    m = len(gsd_m)
    return ControlPoints(
        id=np.arange(2),
        lon_lat_h=np.zeros((2, 3)),
        covariance_m2=np.zeros((2, 3, 3)),
        saliency=np.ones(2),
        health=np.ones(2),
        views=Views(
            start=np.array([0, 1, 1 + m]),
            gsd_m=np.array([gsd_m[0], *gsd_m]),
            image=np.zeros(1 + m, dtype=np.int64),
            incidence_deg=np.array([0.0, *incidence_deg]),
            azimuth_deg=np.array([0.0, *azimuth_deg]),
            health=np.ones(1 + m),
            images=(Acquisition("a"),),
        ),
        chip_file=np.zeros(2, dtype=np.int64),
        chip_row=np.array([0, 1]),
        chip_files=("chips",),
    )


def test_an_image_ends_half_a_pixel_beyond_the_centres_of_its_pixels() -> None:
    at = np.array([[-0.5, -0.5], [999.5, 1999.5], [-0.6, 0.0], [0.0, 1999.6], [np.nan, 3.0]])
    np.testing.assert_array_equal(inside(at, SHAPE), [True, True, False, False, False])
    np.testing.assert_array_equal(inside(at, SHAPE, 1.0), [True, True, True, True, False])


@pytest.mark.parametrize("count", [8, 40, 200])
def test_points_are_chosen_all_over_the_image_though_most_lie_in_a_corner(count: int) -> None:
    rng = np.random.default_rng(0)
    crowd, others = rng.uniform(0, [100, 200], (5000, 2)), rng.uniform([0, 0], SHAPE, (1000, 2))
    at = np.concatenate([crowd, others])
    rows = spread_over_image(at, rng.uniform(0.0, 1.0, 6000), SHAPE, count)
    assert len(rows) == len(set(rows)) == count
    side = np.sqrt(SHAPE[0] * SHAPE[1] / (count / 2.0))
    cells, populated = (set(map(tuple, (a // side).astype(int))) for a in (at[rows], at))
    assert len(cells) >= 0.9 * min(len(populated), count)


def test_the_best_of_a_cell_comes_first() -> None:
    at = np.array([[5.0, 5.0], [6.0, 6.0], [7.0, 7.0], [900.0, 1900.0]])
    rows = spread_over_image(at, np.array([0.2, 0.9, 0.5, 0.1]), SHAPE, 2)
    np.testing.assert_array_equal(rows, [1, 3])
    np.testing.assert_array_equal(
        spread_over_image(at, np.array([0.2, 0.9, 0.5, 0.1]), SHAPE, 9), [1, 2, 0, 3]
    )


def test_views_most_like_the_scene_are_chosen_at_the_sampling_asked() -> None:
    points = point_with_views([1.0, 1.0, 1.0, 4.0], [20.0, 20.0, 5.0, 20.0], [180.0, 350.0, 90.0, 10.0])
    np.testing.assert_array_equal(choose_views(points, 1, 1.0, 20.0, 10.0, 2), [1, 2])
    np.testing.assert_array_equal(choose_views(points, 1, 4.0, 20.0, 10.0, 2), [3])
    assert len(choose_views(points, 1, 2.0, 20.0, 10.0, 2)) == 0


def test_azimuth_does_not_matter_to_vertical_views() -> None:
    points = point_with_views([1.0, 1.0], [0.0, 8.0], [0.0, 200.0])
    assert choose_views(points, 1, 1.0, 1.0, 200.0, 1)[0] == 0


def test_views_are_chosen_though_no_direction_is_known() -> None:
    points = point_with_views([1.0, 1.0], [np.nan, 8.0], [np.nan, 200.0])
    np.testing.assert_array_equal(choose_views(points, 1, 1.0, 8.0, 200.0, 2), [1, 0])
    assert len(choose_views(points, 1, 1.0, np.nan, np.nan, 2)) == 2
