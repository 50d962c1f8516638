"""Known ground for blocks that are simulated."""

import numpy as np

from amers.services.adjustment.control_ground import ControlGround
from amers.services.types import Array, Frame, IntArray


def ground_of(
    point: IntArray,
    lon_lat_h: Array,
    covariance_m2: Array,
    *frames: Frame,
    name: str = "P",
    by_hand: bool = False,
) -> ControlGround:
    """Known points of some sources in turn, named by their places in the list.

    Args:
        point: (c,) in the block.
        lon_lat_h: (c, 3) where they are known to be.
        covariance_m2: (3, 3) of their own errors, or (c, 3, 3).
        frames: of the sources.
        name: what the names begin with.
        by_hand: whether people marked them.
    """
    count = len(point)
    return ControlGround(
        point=point.astype(np.int64),
        lon_lat_h=lon_lat_h,
        covariance_m2=np.broadcast_to(covariance_m2, (count, 3, 3)).copy(),
        source=np.arange(count, dtype=np.int64) % len(frames),
        frames=frames,
        names=tuple(f"{name}{number + 1}" for number in range(count)),
        by_hand=np.full(count, by_hand),
    )
