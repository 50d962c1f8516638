"""Which images of a block may come from one pass of a satellite, and so share their errors."""

from collections.abc import Sequence
from datetime import timedelta

import numpy as np

from services.types import Acquisition, BoolArray

_LONGEST_PASS = timedelta(minutes=20)
"""A satellite sees a place for less than this from horizon to horizon, and next after a whole orbit."""


def image_passes(acquisitions: Sequence[Acquisition]) -> list[BoolArray]:
    """Masks (n,) of the images that may come from one pass, for each group of two or more.

    Images of an unknown platform or time may come from the pass of any other.
    """
    n = len(acquisitions)
    group = np.arange(n)
    for i, one in enumerate(acquisitions):
        for j, other in enumerate(acquisitions[:i]):
            if _may_be_one_pass(one, other):
                group[group == group[i]] = group[j]
    masks = [group == number for number in np.unique(group)]
    return [mask for mask in masks if mask.sum() > 1]


def _may_be_one_pass(one: Acquisition, other: Acquisition) -> bool:
    if one.sensor and other.sensor and one.sensor != other.sensor:
        return False
    if one.acquired_at is None or other.acquired_at is None:
        return True
    return abs(one.acquired_at - other.acquired_at) <= _LONGEST_PASS
