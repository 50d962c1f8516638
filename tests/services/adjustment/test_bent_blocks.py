"""Heights of blocks whose images drift and bend err as much, relative to the frame, as is stated."""

from functools import cache

import numpy as np
import pytest

from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.parameters import image_parameters
from amers.services.geodesy import move_metres
from amers.services.simulation.archive import PASS_SIGMA_M, SMALL, archive_views
from amers.services.simulation.view import plan_geometry
from amers.services.simulation.world import World, make_world
from amers.services.types import Array, Observations

ARCHIVES = 24
NOISE_PX, SLOPE = 0.1, 1e-4
BORDER_PX = 40.0
honest = (0.7, 1.5)
"""Mean square of errors over their sigmas."""


@cache
def world() -> World:
    return make_world(
        np.random.default_rng(5), SMALL.world_m, 8.0, SMALL.relief_m, region_m=SMALL.region_m
    )


def true_points(rng: np.random.Generator, count: int) -> Array:
    half_m = SMALL.area_m / 2.0
    east_north = rng.uniform(-half_m, half_m, (count, 2))
    centre = np.append(world().centre_lon_lat, 0.0)
    ground = move_metres(np.tile(centre, (count, 1)), np.column_stack([east_north, np.zeros(count)]))
    ground[:, 2] = world().height_m(ground[:, :2])
    return ground


def bent_block(seed: int) -> tuple[BlockAdjustment, Array]:
    """A block of eight images of three passes, with drifts and jitter; its true points."""
    rng, plans = np.random.default_rng(seed), archive_views(SMALL, seed)
    views = [
        plan_geometry(world(), one.plan, np.random.default_rng(one.seed), one.error_m, one.drift_px)
        for one in plans
    ]
    ground = true_points(rng, 400)
    seen = np.stack([view.true_model.project(ground) for view in views], axis=1)
    shown = ((seen > BORDER_PX) & (seen < SMALL.lines - BORDER_PX)).all(axis=2)
    kept = shown.sum(axis=1) >= 3
    point, image = np.nonzero(shown[kept])
    line_sample = seen[kept][shown[kept]] + rng.normal(0.0, NOISE_PX, (len(point), 2))
    measures = Observations(point, image, line_sample, np.full(len(point), NOISE_PX))
    images = [
        image_parameters(
            view.plan.image_id,
            view.delivered,
            view.plan.shape,
            shift_px=PASS_SIGMA_M / view.plan.gsd_m,
            slope_px=SLOPE * SMALL.lines / 2.0,
        )
        for view in views
    ]
    orbits = np.array([one.orbit for one in plans])
    passes = [orbits == orbit for orbit in np.unique(orbits)]
    return adjust_block(images, measures, passes=passes), ground[kept]


@pytest.mark.monte_carlo
@pytest.mark.thorough
def test_heights_of_bent_blocks_err_as_stated() -> None:
    """A bend of a block is one draw for all of its points: many blocks are needed."""
    squares, bends_m = [], []
    for seed in range(ARCHIVES):
        block, ground = bent_block(seed)
        found = np.isfinite(block.lon_lat_h[:, 0])
        error_m = (block.lon_lat_h - ground)[found, 2]
        error_m -= error_m.mean()
        squares.append(float(np.mean(error_m**2 / block.point_covariance_m2[found, 2, 2])))
        bends_m.append(float(np.sqrt(block.point_shared_m2[found, 2, 2].mean())))
    assert honest[0] < np.mean(squares) < honest[1]
    assert np.mean(bends_m) > 0.3
