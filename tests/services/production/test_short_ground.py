"""The squares of a block that should have a point each, and have none."""

import numpy as np
import pytest

from amers.services.geodesy import move_metres
from amers.services.production.new_points import ShortGround
from amers.services.types import Array

SPACING_M = 100.0
CORNER = np.array([15.0, 50.0, 0.0])


def outline(east_m: float, north_m: float) -> Array:
    """Of a rectangle, longitude and latitude."""
    corners = np.array([[0.0, 0.0], [east_m, 0.0], [east_m, north_m], [0.0, north_m]])
    enu = np.column_stack([corners, np.zeros(4)])
    return move_metres(np.tile(CORNER, (4, 1)), enu)[:, :2]


@pytest.mark.parametrize(
    ("east_m", "north_m", "columns", "rows"),
    [(340.0, 240.0, 3, 2), (360.0, 240.0, 4, 2), (340.0, 260.0, 3, 3), (60.0, 60.0, 1, 1)],
)
def test_squares_count_whose_centres_the_outline_holds_also_at_its_far_sides(
    east_m: float, north_m: float, columns: int, rows: int
) -> None:
    ground = ShortGround(outline(east_m, north_m), SPACING_M, np.empty((0, 2), dtype=np.int64))
    centres = ground.centres()
    squares = ground.squares(np.column_stack([centres, np.zeros(len(centres))]))
    expected = {(i, j) for i in range(columns) for j in range(rows)}
    assert set(map(tuple, squares.tolist())) == expected
    assert len(centres) == len(expected)


def test_squares_with_a_point_are_not_short() -> None:
    taken = np.array([[0, 1], [2, 0]])
    ground = ShortGround(outline(340.0, 240.0), SPACING_M, taken)
    centres = ground.centres()
    squares = ground.squares(np.column_stack([centres, np.zeros(len(centres))]))
    assert set(map(tuple, squares.tolist())) == {(0, 0), (1, 0), (1, 1), (2, 1)}
