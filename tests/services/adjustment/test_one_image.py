"""One image alone on a few control points: a block of the smallest kind."""

import numpy as np
import pytest

from amers.services.adjustment.block_problem import BlockOptions
from amers.services.adjustment.bundle import adjust_block
from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.parameters import image_parameters
from amers.services.types import Frame, Observations
from tests.services.simulated import ring_of_geometries

OFF_PX = np.array([3.0, 2.0])
PRIOR_PX, PICK_PX, SLOPE_PX = 5.0, 0.5, 0.1


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("shape", [(500, 500), (4000, 4000)])
def test_one_image_follows_one_control_point_and_more(shape, count):
    geometry = ring_of_geometries(1, shape=shape)[0]
    image = image_parameters(
        "alone", geometry.rpc, geometry.plan.shape, shift_px=PRIOR_PX, slope_px=SLOPE_PX
    )
    places = np.random.default_rng(0).uniform(0.1, 0.9, (count, 2)) * geometry.plan.shape
    rows = np.arange(count)
    control = ControlGround(
        point=rows,
        lon_lat_h=geometry.rpc.locate(places, np.full(count, 100.0)),
        covariance_m2=np.tile(1e-4 * np.eye(3), (count, 1, 1)),
        source=np.zeros(count, dtype=np.int64),
        frames=(Frame.from_sigmas(1e-3, 1e-3),),
        names=tuple(map(str, rows)),
        by_hand=np.ones(count, dtype=np.bool_),
    )
    marks = Observations(rows, np.zeros(count, dtype=np.int64), places + OFF_PX, np.full(count, PICK_PX))
    adjusted = adjust_block([image], marks, control=control, options=BlockOptions(min_points=0))
    moved = adjusted.models[0].project(control.lon_lat_h) - places
    share = PRIOR_PX**2 / (PRIOR_PX**2 + PICK_PX**2 / count)
    assert moved.mean(axis=0) == pytest.approx(share * OFF_PX, abs=0.05)
    variance = adjusted.accuracy.variance()
    assert np.isfinite(variance).all()
    assert (variance >= 0.0).all()
    # Nothing shows a drift of the image: it stays as small as stated.
    assert np.abs(adjusted.values[0][[1, 2, 4, 5]]).max() < SLOPE_PX
    assert (np.sqrt(variance[[1, 2, 4, 5]]) < 5.0 * SLOPE_PX).all()
