"""Scenes that show few points: what is tried then, and what is said of the result."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.conventions import CHIP_SIZE
from amers.services.registration.coarse import search_coarsely
from amers.services.registration.on_points import register_scene
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.point_selection import points_to_try
from amers.services.types import Array, ControlPoints
from tests.services.registration.small_ground import (
    SIDE_PX,
    point_context,
    points_at,
    predicted,
    scene,
)
from tests.services.simulated import MemoryChips, views_of_points

OFF_M = np.array([60.0, -42.0])
SIGMA_M = 25.0
FINE_M, COARSE_M = 2.0, 8.0


def around_the_middle(step_px: float) -> Array:
    """Nine pixels of the ground, in three rows."""
    axis = SIDE_PX / 2.0 + step_px * np.arange(-1.0, 2.0)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)


def with_coarse_chips(row_col: Array) -> tuple[ControlPoints, MemoryChips]:
    """Points with a fine and a coarse chip each."""
    (points, fine), (_, coarse) = (points_at(row_col, gsd_m) for gsd_m in (FINE_M, COARSE_M))
    n = len(points)
    chips = np.stack([one.read("chips", 0, n) for one in (fine, coarse)], axis=1)
    views = views_of_points(n, [FINE_M, COARSE_M])
    return replace(points, views=views, chip_row=2 * points.chip_row), MemoryChips(
        chips.reshape(-1, CHIP_SIZE, CHIP_SIZE)
    )


def test_where_coarse_chips_overlap_too_much_to_be_believed_smaller_ones_are_searched() -> None:
    """Chips of 808 m in a scene of 1,400 m: all agree, and are hardly more than two."""
    of, (points, chips) = scene(OFF_M, SIGMA_M, 700, 700), with_coarse_chips(around_the_middle(110.0))
    context = point_context(of, points, chips, FINE_M, enough=1)
    prediction = search_coarsely(context, predicted(of, points))
    refused, accepted = context.stages
    assert (refused.chip_gsd_m, accepted.chip_gsd_m) == (COARSE_M, FINE_M)
    assert refused.inliers == accepted.inliers == 9
    moved_px = prediction.model.project(points.lon_lat_h) - of.model.project(points.lon_lat_h)
    np.testing.assert_allclose(moved_px, np.tile([21.0, 30.0], (9, 1)), atol=0.3)


def test_points_at_the_border_are_tried_where_few_others_exist() -> None:
    """And come after all those that the scene shows for sure."""
    of = scene(np.zeros(2), 1.0, 400, 400)
    inside, border = around_the_middle(70.0), around_the_middle(199.0)[[0, 1, 2, 3, 5, 6, 7, 8]]
    beyond = around_the_middle(400.0)[[0, 2, 6, 8]]
    points, _ = points_at(np.concatenate([beyond, border, inside]))
    tried = points_to_try(of, points, predicted(of, points), 12)
    assert len(tried) == 12
    assert set(range(12, 21)) < set(tried.tolist())
    np.testing.assert_array_equal(points_to_try(of, points, predicted(of, points), 5) >= 12, True)


@pytest.mark.parametrize("count", [6, 7, 9])
def test_as_few_points_as_a_registration_takes_are_repeated_without_some(count: int) -> None:
    of = scene(np.array([3.0, -2.0]), 5.0, 520, 520)
    quality = register_scene(of, *points_at(around_the_middle(120.0)[:count])).qualification
    assert RegistrationOptions().qualification.usable_active_points == 6
    assert quality.point_counts.active == count
    assert quality.verdict == "usable"
    assert quality.stability.draws == 10
    assert quality.cell_stability.left_out == count
