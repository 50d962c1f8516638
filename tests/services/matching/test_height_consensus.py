"""Displacements that grow with height: told from ground that moved and from chance."""

import numpy as np
import pytest

from amers.services.matching.height_consensus import height_consensus, view_consensus

TOLERANCE_PX = 1.0
REACH_PX = np.full(100, 50.0)


def heights(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(0.0, 30.0, 100)


def test_the_model_of_another_view_is_seen_with_its_slope() -> None:
    rng = np.random.default_rng(3)
    height_m = heights(rng)
    slope = np.array([0.3, -0.1])
    displacement = height_m[:, None] * slope + rng.normal(0.0, 0.2, (100, 2))
    wild = rng.random(100) < 0.3
    displacement[wild] = rng.uniform(-50.0, 50.0, (int(wild.sum()), 2))
    seen = height_consensus(displacement, height_m, TOLERANCE_PX, REACH_PX)
    assert seen.false_alarms < 1e-6
    assert seen.displacement == pytest.approx(slope, abs=0.01)
    assert not seen.inliers[wild & (np.abs(height_m) > 10.0)].any()


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_random_displacements_have_no_slope(share: float) -> None:
    rng = np.random.default_rng(4)
    alarms = 0
    for _ in range(200):
        height_m = heights(rng)
        displacement = rng.normal(0.0, 0.2, (100, 2))
        wild = rng.random(100) < share
        displacement[wild] = rng.uniform(-50.0, 50.0, (int(wild.sum()), 2))
        alarms += height_consensus(displacement, height_m, TOLERANCE_PX, REACH_PX).false_alarms < 1e-3
    assert alarms == 0


def test_a_hill_that_moved_is_not_the_model_of_another_view() -> None:
    rng = np.random.default_rng(5)
    height_m = np.where(np.arange(100) < 40, 60.0, 0.0) + rng.normal(0.0, 3.0, 100)
    moved = np.arange(100) < 20
    displacement = rng.normal(0.0, 0.2, (100, 2)) + np.where(moved[:, None], [8.0, 3.0], 0.0)
    seen = height_consensus(displacement, height_m, TOLERANCE_PX, REACH_PX)
    assert seen.false_alarms > 1e-3


def test_points_that_were_not_found_take_no_part() -> None:
    nothing = np.full((100, 2), np.nan)
    seen = height_consensus(nothing, np.zeros(100), TOLERANCE_PX, REACH_PX)
    assert not seen.inliers.any()
    assert seen.false_alarms == 1.0


def test_another_view_is_seen_where_nothing_is_known_of_the_displacement() -> None:
    rng = np.random.default_rng(6)
    position = rng.uniform(0.0, 1000.0, (30, 2))
    height_m = rng.normal(0.0, 30.0, 30)
    affine = position @ rng.normal(0.0, 0.01, (2, 2)) + [4.0, -7.0]
    displacement = affine + height_m[:, None] * [0.2, 0.1] + rng.normal(0.0, 0.3, (30, 2))
    wild = np.arange(30) < 8
    displacement[wild] = rng.uniform(-40.0, 40.0, (8, 2))
    agrees, false_alarms = view_consensus(position, displacement, height_m, TOLERANCE_PX, 40.0)
    assert false_alarms < 1e-6
    assert agrees[~wild].mean() > 0.9


def share_of_the_window(tolerance: float, search: float) -> float:
    """How many random displacements of a square window lie within a tolerance of one of them."""
    drawn = np.random.default_rng(7).uniform(-search, search, (400_000, 2))
    return float((np.hypot(*drawn.T) <= tolerance).mean())


def test_the_chance_of_a_view_is_that_of_displacements_drawn_in_the_windows() -> None:
    """Three points that agree: one gives the slope, the two others agree with it by chance."""
    height_m = np.array([30.0, 40.0, 50.0])
    displacement = height_m[:, None] * [0.1, 0.05]
    seen = height_consensus(displacement, height_m, TOLERANCE_PX, np.full(3, 10.0))
    chance = share_of_the_window(TOLERANCE_PX, 10.0)
    assert seen.false_alarms == pytest.approx(3.0 * chance**2, rel=0.1)


def test_the_chance_of_another_view_leaves_out_the_points_that_determine_it() -> None:
    """Six points of six: fifteen quadruples, of which two further points agree by chance."""
    rng = np.random.default_rng(9)
    position, height_m = rng.uniform(0.0, 1000.0, (6, 2)), rng.normal(0.0, 30.0, 6)
    displacement = position * 0.002 + height_m[:, None] * [0.02, 0.01]
    agrees, false_alarms = view_consensus(position, displacement, height_m, TOLERANCE_PX, 10.0)
    assert agrees.all()
    chance = share_of_the_window(TOLERANCE_PX, 10.0)
    assert false_alarms == pytest.approx((6 - 4) * 15 * chance**2, rel=0.1)


def test_random_displacements_are_no_other_view() -> None:
    rng = np.random.default_rng(8)
    alarms = 0
    for n in (6, 12, 30, 60) * 10:
        position, height_m = rng.uniform(0.0, 1000.0, (n, 2)), rng.normal(0.0, 30.0, n)
        displacement = rng.uniform(-40.0, 40.0, (n, 2))
        alarms += view_consensus(position, displacement, height_m, 3.0, 40.0)[1] < 1e-3
    assert alarms == 0


def test_points_in_one_plane_tell_no_slope_however_far_they_lie() -> None:
    """Heights on the plane through the others are zero to the last digit, as at sea level."""
    rng = np.random.default_rng(8)
    displacement = rng.uniform(-50.0, 50.0, (100, 2))
    for height_m in (np.zeros(100), np.where(np.arange(100) < 99, 0.0, 20.0)):
        seen = height_consensus(displacement, height_m, TOLERANCE_PX, REACH_PX)
        assert not seen.inliers.any() or seen.false_alarms > 1e-3
