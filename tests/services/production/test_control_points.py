"""A block placed by an older one: by how much it moves, what it declares, and blunders by name."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from services.adjustment.intersection import intersect
from services.errors import NotEnoughPoints
from services.geodesy import east_north_up, move_metres
from services.imagery.scene import Scene
from services.production.control import Control
from services.production.control_points import ControlBlock
from services.production.from_images import Production, produce_points
from services.simulation.view import SimulatedView, simulate_block
from services.types import Array, ControlPoints, Frame, Observations
from tests.services.simulated import GSD_M, OPTIONS, SHAPE, MemoryChips, world
from tests.services.ties import difference_m

pytestmark = pytest.mark.long

SIGMA_M = 5.0
FRAME = Frame.from_sigmas(0.4, 0.6)
OWN_SIGMA_M = 0.15


def views(seed: int, error_m: float) -> tuple[SimulatedView, ...]:
    rng = np.random.default_rng(seed)
    return tuple(
        simulate_block(
            world(),
            rng,
            n_views=3,
            shape=SHAPE,
            gsd_m=GSD_M,
            error_m=error_m,
            largest_incidence_deg=20.0,
        )
    )


@cache
def new_views() -> tuple[SimulatedView, ...]:
    return views(seed=12, error_m=SIGMA_M)


def scenes() -> list[Scene]:
    return [view.as_scene(SIGMA_M) for view in new_views()]


@cache
def older() -> ControlBlock:
    """A block of another date, made with the true models; its frame is off as it declares."""
    exact = [
        replace(view.as_scene(0.1), model=view.geometry.true_model)  # type: ignore[arg-type]
        for view in views(seed=11, error_m=0.0)
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
def placed() -> Production:
    return produce_points(scenes(), OPTIONS, control=Control((older(),)))


def frame_error_m(made: Production) -> Array:
    """Mean error (3,) on the Earth of the points: the true ground of what the images show there."""
    n, count = len(made.points), len(made.adjustment.models)
    seen = np.stack([model.project(made.points.lon_lat_h) for model in made.adjustment.models], axis=1)
    observations = Observations(
        np.repeat(np.arange(n), count),
        np.tile(np.arange(count), n),
        seen.reshape(-1, 2),
        np.full(n * count, 0.1),
    )
    truth = intersect([view.geometry.true_model for view in new_views()], observations, n)
    return difference_m(made.points.lon_lat_h, truth.lon_lat_h).mean(axis=0)


def test_control_places_the_block_as_precisely_as_it_declares() -> None:
    alone = produce_points(scenes(), OPTIONS)
    error_m, frame_m2 = frame_error_m(placed()), placed().points.frames[0].covariance_m2
    # Chi-squared of three coordinates: 11.3 in one of a hundred.
    assert error_m @ np.linalg.solve(frame_m2, error_m) < 11.3
    assert np.sqrt(np.diagonal(frame_m2)).max() < 1.0
    assert np.sqrt(np.diagonal(alone.points.frames[0].covariance_m2)).min() > 2.0
    assert np.linalg.norm(error_m) < np.linalg.norm(frame_error_m(alone))


def test_the_control_is_reported_point_by_point() -> None:
    made = placed()
    assert len(made.control) > 10
    assert made.adjustment.control_active.mean() > 0.9
    assert all(name.startswith("older:") for name in made.control.names)


def test_points_of_the_control_are_not_points_of_the_new_block() -> None:
    made = placed()
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
    made = produce_points(scenes(), OPTIONS, control=Control((spoiled,)))
    left_out = {
        name
        for name, used in zip(made.control.names, made.adjustment.control_active, strict=True)
        if not used
    }
    found = {f"older:{block.points.id[row]}" for row in wrong} & set(made.control.names)
    assert found, "none of the wrong points was found in the images"
    assert found <= left_out
    error_m, frame_m2 = frame_error_m(made), made.points.frames[0].covariance_m2
    assert error_m @ np.linalg.solve(frame_m2, error_m) < 11.3


def test_control_of_another_place_is_refused_with_its_name() -> None:
    block = older()
    elsewhere = replace(block.points, lon_lat_h=block.points.lon_lat_h + [0.0, 0.5, 0.0])
    with pytest.raises(NotEnoughPoints, match="control points of older"):
        produce_points(scenes(), OPTIONS, control=Control((replace(block, points=elsewhere),)))


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
    made = produce_points(scenes(), OPTIONS, control=both)
    assert {name.partition(":")[0] for name in made.control.names} == {"a", "b"}
    assert set(made.control.source.tolist()) == {0, 1}
    assert np.sqrt(np.diagonal(made.points.frames[0].covariance_m2)).max() < 1.0
