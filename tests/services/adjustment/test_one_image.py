"""One image alone on a few control points: a block of the smallest kind, refused without a frame."""

import numpy as np
import pytest

from amers.services.adjustment.block_problem import BlockOptions
from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.parameters import image_parameters
from amers.services.errors import UndeterminedCorrection
from amers.services.simulation.view import ViewGeometry
from amers.services.types import Array, Frame, Observations
from tests.services.adjustment.grounds import ground_of
from tests.services.simulated import ring_of_geometries

OFF_PX = np.array([3.0, 2.0])
PRIOR_PX, PICK_PX, SLOPE_PX = 5.0, 0.5, 0.1


def alone(
    geometry: ViewGeometry, places: Array, *, own_m: float, frame_m: float, by_hand: bool
) -> BlockAdjustment:
    """The image whose model is off, on ground that is known at places (n, 2)."""
    count = len(places)
    image = image_parameters(
        "alone", geometry.rpc, geometry.plan.shape, shift_px=PRIOR_PX, slope_px=SLOPE_PX
    )
    known, frame = (
        geometry.rpc.locate(places, np.full(count, 100.0)),
        Frame.from_sigmas(frame_m, frame_m),
    )
    control = ground_of(np.arange(count), known, own_m**2 * np.eye(3), frame, by_hand=by_hand)
    nothing = np.zeros(count, dtype=np.int64)
    marks = Observations(np.arange(count), nothing, places + OFF_PX, np.full(count, PICK_PX))
    return adjust_block([image], marks, control=control, options=BlockOptions(min_points=0))


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("shape", [(500, 500), (4000, 4000)])
def test_one_image_follows_one_control_point_and_more(shape: tuple[int, int], count: int) -> None:
    geometry = ring_of_geometries(1, shape=shape)[0]
    places = np.random.default_rng(0).uniform(0.1, 0.9, (count, 2)) * geometry.plan.shape
    adjusted = alone(geometry, places, own_m=0.01, frame_m=1e-3, by_hand=True)
    ground = geometry.rpc.locate(places, np.full(count, 100.0))
    moved = adjusted.models[0].project(ground) - places
    share = PRIOR_PX**2 / (PRIOR_PX**2 + PICK_PX**2 / count)
    assert moved.mean(axis=0) == pytest.approx(share * OFF_PX, abs=0.05)
    variance = adjusted.accuracy.variance()
    assert np.isfinite(variance).all()
    assert (variance >= 0.0).all()
    # Nothing shows a drift of the image: it stays as small as stated.
    assert np.abs(adjusted.values[0][[1, 2, 4, 5]]).max() < SLOPE_PX
    assert (np.sqrt(variance[[1, 2, 4, 5]]) < 5.0 * SLOPE_PX).all()


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("by_hand", [False, True])
def test_control_whose_frame_is_unknown_leaves_one_image_undetermined(count: int, by_hand: bool) -> None:
    geometry = ring_of_geometries(3)[0]
    places = np.array([[300.0, 400.0], [100.0, 700.0], [600.0, 200.0]])[:count]
    with pytest.raises(UndeterminedCorrection, match=f"1 images and {count} control points leave"):
        alone(geometry, places, own_m=0.1, frame_m=np.nan, by_hand=by_hand)
    (model,) = alone(geometry, places, own_m=0.1, frame_m=0.1, by_hand=by_hand).models
    ground = geometry.rpc.locate(places, np.full(count, 100.0))
    assert np.abs(model.project(ground) - places - OFF_PX).max() < 0.1
