"""A block placed by an older one: by how much it moves, what it declares, and blunders by name."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.errors import NotEnoughPoints
from amers.services.geodesy import east_north_up, move_metres
from amers.services.production.control import Control
from amers.services.production.control_points import ControlBlock
from amers.services.production.image_production import Production, produce_points
from amers.services.types import Array, ControlPoints, Frame
from tests.services.production.simulated_control import frame_error_m, free, placed, views
from tests.services.simulated import OPTIONS, MemoryChips

pytestmark = pytest.mark.long

NEW = 12
"""Seed of the images that are made into a block."""
FRAME = Frame.from_sigmas(0.4, 0.6)
OWN_SIGMA_M = 0.15


@cache
def older() -> ControlBlock:
    """A block of another date, made with the true models; its frame is off as it declares."""
    exact = [
        replace(view.as_scene(0.1), model=view.geometry.true_model)  # type: ignore[arg-type]
        for view in views(11, 0.0)
    ]
    made = produce_points(exact, replace(OPTIONS, points=25))
    rng = np.random.default_rng(13)
    n = len(made.points)
    error_m = rng.normal(0.0, OWN_SIGMA_M, (n, 3)) + rng.multivariate_normal(
        np.zeros(3), FRAME.covariance_m2
    )
    points = replace(
        made.points,
        lon_lat_h=moved(made.points.lon_lat_h, error_m),
        covariance_m2=np.tile(np.eye(3) * OWN_SIGMA_M**2, (n, 1, 1)) + made.points.covariance_m2,
        frames=(FRAME,),
    )
    return ControlBlock("older", points, all_chips(made))


def all_chips(made: Production) -> MemoryChips:
    return MemoryChips(np.concatenate([made.chips(row) for row in range(len(made.points))]))


def moved(lon_lat_h: Array, by_m: Array) -> Array:
    return move_metres(lon_lat_h, by_m)


@cache
def by_older() -> Production:
    return placed(NEW, Control((older(),)))


@pytest.mark.thorough
def test_control_places_the_block_as_precisely_as_it_declares() -> None:
    alone, made = free(NEW), by_older()
    error_m, frame_m2 = frame_error_m(made, views(NEW)), made.points.frames[0].covariance_m2
    # Chi-squared of three coordinates: 11.3 in one of a hundred.
    assert error_m @ np.linalg.solve(frame_m2, error_m) < 11.3
    assert np.sqrt(np.diagonal(frame_m2)).max() < 1.0
    assert np.sqrt(np.diagonal(alone.points.frames[0].covariance_m2)).min() > 2.0
    assert np.linalg.norm(error_m) < np.linalg.norm(frame_error_m(alone, views(NEW)))


def test_the_control_is_reported_point_by_point() -> None:
    made = by_older()
    assert len(made.control) > 10
    assert made.adjustment.control_active.mean() > 0.9
    assert all(name.startswith("older:") for name in made.control.names)


def test_points_of_the_control_are_not_points_of_the_new_block() -> None:
    made = by_older()
    place = east_north_up(made.control.lon_lat_h, made.points.lon_lat_h[0])
    points = east_north_up(made.points.lon_lat_h, made.points.lon_lat_h[0])
    distance_m = np.linalg.norm(points[:, None] - place[None], axis=2)
    assert len(made.points) > 30
    assert distance_m.min() > 1e-3


def test_blunders_of_the_control_are_thrown_out_by_name() -> None:
    block = older()
    wrong = [int(row) for row in np.linspace(2, len(block.points) - 3, 3)]
    lon_lat_h = block.points.lon_lat_h.copy()
    lon_lat_h[wrong] = moved(
        lon_lat_h[wrong], np.array([[6.0, -3.0, 2.0], [0.0, 7.0, 0.0], [1.0, 0.0, 9.0]])
    )
    spoiled = replace(block, points=replace(block.points, lon_lat_h=lon_lat_h))
    made = placed(NEW, Control((spoiled,)))
    left_out = {
        name
        for name, used in zip(made.control.names, made.adjustment.control_active, strict=True)
        if not used
    }
    found = {f"older:{block.points.id[row]}" for row in wrong} & set(made.control.names)
    assert found, "none of the wrong points was found in the images"
    assert found <= left_out
    error_m, frame_m2 = frame_error_m(made, views(NEW)), made.points.frames[0].covariance_m2
    assert error_m @ np.linalg.solve(frame_m2, error_m) < 11.3


def test_control_of_another_place_is_refused_with_its_name() -> None:
    block = older()
    elsewhere = replace(block.points, lon_lat_h=block.points.lon_lat_h + [0.0, 0.5, 0.0])
    with pytest.raises(NotEnoughPoints, match="control points of older"):
        placed(NEW, Control((replace(block, points=elsewhere),)))


def test_two_blocks_of_control_keep_their_own_frames() -> None:
    block = older()
    half = len(block.points) // 2
    rows = np.arange(len(block.points))

    def part(name: str, own: Array, frame: Frame) -> ControlBlock:
        points: ControlPoints = replace(block.points.take(own), frames=(frame,))
        return ControlBlock(name, points, block.chips)

    both = Control(
        (part("a", rows[:half], FRAME), part("b", rows[half:], Frame.from_sigmas(20.0, 20.0)))
    )
    made = placed(NEW, both)
    assert {name.partition(":")[0] for name in made.control.names} == {"a", "b"}
    assert set(made.control.source.tolist()) == {0, 1}
    assert np.sqrt(np.diagonal(made.points.frames[0].covariance_m2)).max() < 1.0
