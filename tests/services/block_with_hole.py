"""A block of the small simulated world with a hole in its middle, and later views of the same ground."""

from dataclasses import replace
from functools import cache

import numpy as np

from services.adjustment.intersection import intersect
from services.geodesy import box_around, east_north_up, move_metres
from services.production.control_points import ControlBlock
from services.production.from_images import Production, produce_points
from services.sensors.base import SensorModel
from services.simulation.view import SimulatedView, simulate_block
from services.types import Array, Frame, Observations
from tests.services.simulated import GSD_M, OPTIONS, SHAPE, MemoryChips, world

SIGMA_M = 5.0
"""Of the models of later views, as delivered."""
FRAME_ERROR_M = np.array([2.0, -1.5, 3.0])
OWN_SIGMA_M = 0.15
HOLE_M = 150.0
"""Half of the side of the hole."""
PER_KM2 = 200.0
"""Density that the block specifies."""


@cache
def simulated(seed: int, error_m: float) -> tuple[SimulatedView, ...]:
    return tuple(
        simulate_block(
            world(),
            np.random.default_rng(seed),
            n_views=3,
            shape=SHAPE,
            gsd_m=GSD_M,
            error_m=error_m,
            largest_incidence_deg=20.0,
        )
    )


@cache
def older() -> tuple[ControlBlock, ControlBlock, Array]:
    """A block that is off by its frame, whole and with a hole in its middle; and its outline.

    Where its points are is known but for the matching of its images, which its covariances declare.
    """
    exact = [
        replace(view.as_scene(0.1), model=view.geometry.true_model)  # type: ignore[arg-type]
        for view in simulated(seed=11, error_m=0.0)
    ]
    made = produce_points(exact, replace(OPTIONS, points=60))
    n = len(made.points)
    chips = MemoryChips(np.concatenate([made.chips(row) for row in range(n)]))
    error_m = FRAME_ERROR_M + np.random.default_rng(13).normal(0.0, OWN_SIGMA_M, (n, 3))
    shown = true_ground(made, [scene.model for scene in exact])
    points = replace(
        made.points,
        lon_lat_h=move_metres(shown, error_m),
        covariance_m2=np.eye(3) * OWN_SIGMA_M**2 + made.points.covariance_m2,
        frames=(Frame.from_sigmas(2.0, 3.0),),
    )
    outline = box_around(points.lon_lat_h)
    enu = east_north_up(points.lon_lat_h, np.array([*outline.mean(axis=0), 0.0]))
    outside = np.flatnonzero(np.abs(enu[:, :2]).max(axis=1) > HOLE_M)
    whole = ControlBlock("older", points, chips)
    return whole, replace(whole, points=points.take(outside)), outline


def true_ground(made: Production, models: list[SensorModel]) -> Array:
    """The ground (n, 3) that true models see where the adjusted ones have cut the chips."""
    n, count = len(made.points), len(models)
    seen = np.stack([model.project(made.points.lon_lat_h) for model in made.adjustment.models], axis=1)
    observations = Observations(
        np.repeat(np.arange(n), count),
        np.tile(np.arange(count), n),
        seen.reshape(-1, 2),
        np.full(n * count, 0.1),
    )
    return intersect(models, observations, n).lon_lat_h
