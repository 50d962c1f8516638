"""The part of an image that points support: nearly all where they agree everywhere, and no more."""

import numpy as np
import pytest
import shapely

from amers.services.quality.held_area import HeldArea, TriedPoints, held_area
from amers.services.types import Array

SHAPE = (1000, 2000)
NOBODY = np.empty((0, 2))
CHIP_PX = 40.0


def all_over(n: int, seed: int = 0) -> Array:
    """Points at random places of the image."""
    return np.random.default_rng(seed).uniform(0.0, 1.0, (n, 2)) * SHAPE


def tried(agreeing: Array, *, missed: Array = NOBODY, elsewhere: Array = NOBODY) -> TriedPoints:
    """Points that agree with the scene, that were not found, and that agree on another place."""
    groups = (agreeing, missed, elsewhere)
    of_group = np.repeat([0, 1, 2], [len(one) for one in groups])
    nothing = np.zeros(len(of_group), dtype=bool)
    return TriedPoints(np.concatenate(groups), of_group == 0, of_group == 2, nothing)


def held(
    agreeing: Array, parts: Array | None = None, *, missed: Array = NOBODY, elsewhere: Array = NOBODY
) -> HeldArea:
    return held_area(tried(agreeing, missed=missed, elsewhere=elsewhere), SHAPE, CHIP_PX, parts)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8, 1.0])
@pytest.mark.parametrize("n", [60, 200, 1000])
def test_points_all_over_an_image_hold_nearly_all_of_it(n: int, share: float) -> None:
    """Whatever share agrees: places are lost where all nearest are missed by chance."""
    percent = []
    for seed in range(10):
        points, agrees = all_over(n, seed), np.random.default_rng(seed).random(n) < share
        percent.append(held(points[agrees], missed=points[~agrees]).percent)
    least = 93.0 if n * share > 100 else 70.0 if n * share > 25 else 50.0
    assert least < np.mean(percent) <= 100.0


def test_more_points_never_hold_less() -> None:
    """Where points are dense, the place beside them is held as well as where they are few."""
    middle = 0.2 * np.array(SHAPE) + 0.6 * all_over(1000)
    few, many = held(middle[:60]), held(middle)
    assert (many.cells | ~few.cells).all()
    assert many.percent > 75.0


def test_a_point_in_the_middle_of_every_fifth_holds_the_whole_image() -> None:
    """What 15 % of a side means."""
    square = 1000
    axis = (np.arange(5) + 0.5) * square / 5 - 0.5
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    assert held_area(tried(points), (square, square), 0.0).percent == 100.0
    assert held_area(tried(points[:-1]), (square, square), 0.0).percent < 100.0


@pytest.mark.parametrize(("share", "most"), [(0.5, 0.8), (0.9, 0.5)])
def test_lines_in_which_no_point_agrees_are_not_held(share: float, most: float) -> None:
    """An eighth of the image behind lost lines: its points were looked for, and missed."""
    points = all_over(300)
    agrees = (points[:, 0] < 875.0) & (np.random.default_rng(5).random(300) < share)
    area = held(points[agrees], missed=points[~agrees])
    behind = held(points[agrees]).places[:, 0] > 900.0
    assert (area.places[:, 0] > 900.0).sum() < most * behind.sum(), "of what is in reach"
    assert area.percent > 80.0


def test_a_part_that_agrees_elsewhere_is_not_held_and_the_rest_is() -> None:
    points = all_over(400)
    pasted = (np.abs(points - [500.0, 600.0]) < 175.0).all(axis=1)
    agrees = ~pasted & (np.random.default_rng(6).random(400) < 0.7)
    missed = ~pasted & ~agrees
    area = held(points[agrees], missed=points[missed], elsewhere=points[pasted])
    inside = (np.abs(area.places - [500.0, 600.0]) < 150.0).all(axis=1)
    assert inside.sum() < 0.02 * len(area.places)
    assert area.percent > 85.0


def test_what_a_chip_shows_is_held_by_it() -> None:
    area = held_area(tried(np.array([[500.0, 1000.0]])), SHAPE, 800.0)
    corners = np.array([[110.0, 610.0], [890.0, 610.0], [110.0, 1390.0], [890.0, 1390.0]])
    assert area.holds(corners).all()
    assert not area.holds(np.array([[500.0, 100.0]])).any()


@pytest.mark.parametrize(("behind", "holds"), [(2, False), (3, True)])
def test_points_of_one_part_hold_nothing_of_another(behind: int, holds: bool) -> None:
    """Lines were lost at line 900: what lies behind them is held by three points of its own, or not."""
    points = all_over(300)
    points = np.concatenate([points[points[:, 0] < 899.0], np.array([[950.0, 500.0]] * behind)])
    parts = np.array([[0.0, 899.0, 0.0, 1999.0], [900.0, 999.0, 0.0, 1999.0]])
    area = held(points, parts=parts)
    assert not area.holds(np.array([[930.0, 1500.0]])).any()
    assert area.holds(np.array([[950.0, 510.0]])).all() == holds
    assert held(points).holds(np.array([[905.0, 1500.0]])).all(), "without the break"


def test_the_outline_surrounds_the_places_that_are_held_with_their_holes() -> None:
    points = all_over(300)
    hole = np.hypot(*(points - [500.0, 1000.0]).T) < 300.0
    area = held(points[~hole])
    polygons = area.outline
    assert polygons.area == pytest.approx(area.percent / 100.0 * SHAPE[0] * SHAPE[1])
    assert not shapely.contains_xy(polygons, 1000.0, 500.0)
    places = all_over(500, seed=1)
    inside = shapely.contains_xy(polygons, places[:, 1], places[:, 0])
    np.testing.assert_array_equal(inside, area.holds(places))
    assert not area.holds(np.array([[-5.0, 50.0], [50.0, 2003.0]])).any()


def test_places_beyond_the_area_move_to_its_nearest() -> None:
    points = all_over(300)
    area = held(points[points[:, 1] < 1000.0])
    corner, inside = np.array([[0.0, 1999.0]]), points[:1] * [1.0, 0.2]
    moved = area.nearest(corner)
    assert area.holds(moved).all()
    assert np.hypot(*(moved - corner).T) == pytest.approx(np.hypot(*(area.places - corner).T).min())
    np.testing.assert_array_equal(area.nearest(inside), inside)


def test_an_image_without_points_is_not_held() -> None:
    area = held(NOBODY)
    assert area.percent == 0.0
    assert area.polygons == ()
    np.testing.assert_array_equal(area.nearest(np.array([[3.0, 4.0]])), [[3.0, 4.0]])


def test_what_has_no_pixels_is_no_part_of_the_image() -> None:
    """An image that was turned north up: points were looked for in its empty corners."""
    points = all_over(800)
    empty = points.sum(axis=1) < 1000.0
    agreeing = points[~empty]
    looked_for = TriedPoints(points, ~empty, np.zeros(800, dtype=bool), empty)
    area = held_area(looked_for, SHAPE, CHIP_PX)
    assert area.percent > 95.0
    assert 0.75 < area.of_image.mean() < 0.97
    assert held(agreeing).percent < area.percent


def test_places_that_are_far_less_known_than_half_of_the_others_are_not_held() -> None:
    area = held(all_over(300))
    ce90_px = np.where(area.places[:, 0] < 100.0, 3.1, 1.0)
    known = area.where_known(ce90_px)
    assert known.places[:, 0].min() > 100.0
    assert known.places[:, 0].max() == area.places[:, 0].max()
    np.testing.assert_array_equal(area.where_known(np.minimum(ce90_px, 2.9)).cells, area.cells)
    unknown = area.where_known(np.full(len(ce90_px), np.nan))
    np.testing.assert_array_equal(unknown.cells, area.cells)
    assert held(NOBODY).where_known(np.zeros(0)).percent == 0.0
