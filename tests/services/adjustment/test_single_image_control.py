"""One image on one control point: adjusted where the frame is known, else refused in words."""

import numpy as np
import pytest

from amers.services.adjustment.block_problem import BlockOptions
from amers.services.adjustment.bundle import adjust_block
from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.parameters import image_parameters
from amers.services.errors import UndeterminedCorrection
from amers.services.types import Frame, Observations
from tests.services.simulated import ring_of_geometries

OFF_PX = 3.0
A_TENTH_OF_A_PIXEL = 0.1


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("frame_m", [0.1, np.nan])
def test_one_image_on_control_points(count: int, frame_m: float) -> None:
    geometry = ring_of_geometries(3)[0]
    at = np.array([[300.0, 400.0], [100.0, 700.0], [600.0, 200.0]])[:count]
    ground = geometry.rpc.locate(at, np.full(count, 100.0))
    image = image_parameters("a", geometry.rpc, geometry.plan.shape, shift_px=5.0, slope_px=1.0)
    rows = np.arange(count)
    zeros = np.zeros(count, dtype=np.int64)
    control = ControlGround(
        point=rows,
        lon_lat_h=ground,
        covariance_m2=np.tile(0.01 * np.eye(3), (count, 1, 1)),
        source=zeros,
        frames=(Frame.from_sigmas(frame_m, frame_m),),
        names=tuple(map(str, rows)),
    )
    marks = Observations(rows, zeros, at + OFF_PX, np.full(count, 0.5))
    options = BlockOptions(min_points=0)
    if np.isnan(frame_m):
        with pytest.raises(UndeterminedCorrection, match=f"1 images and {count} control points leave"):
            adjust_block([image], marks, control=control, options=options)
        return
    (model,) = adjust_block([image], marks, control=control, options=options).models
    assert np.abs(model.project(ground) - at - OFF_PX).max() < A_TENTH_OF_A_PIXEL
