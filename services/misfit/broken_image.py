"""Images with missing or repeated lines at known breaks: displacement between their parts."""

from collections.abc import Sequence

import numpy as np

from amers.services.misfit.displacement_components import Component
from amers.services.sensors.correction import ImageCorrection
from amers.services.types import Array, BoolArray, IntArray

FEWEST_IN_PART = 3
"""Points that agree in a part of an image, below which nothing says where the part lies."""
_LOST_LINES = 50.0
"""A priori standard deviation of the lines that are missing, or repeated, at a break."""
_BREAK_PX = 1.0
"""Lines within which a break lies."""
_BESIDE_PX = 1.0
"""Lines from there at which the displacement is that of a side."""
MOST_BEYOND = 0.25
"""Share of a chip beyond a break, above which its match lies somewhere between both parts."""


def steps_at_breaks(breaks: IntArray, correction: ImageCorrection) -> tuple[Component, ...]:
    """A step of any size at each break: lines are displaced, samples are not.

    Args:
        breaks: (k,) first lines behind them, in the image.
        correction: affine, which says where the model expects these lines.
    """
    places = np.column_stack([breaks - 0.5, np.full(len(breaks), correction.centre[1])])
    return tuple(map(_step, correction.invert(places)[:, 0].tolist()))


def placed_steps(
    breaks: IntArray, steps: Sequence[Component], correction: ImageCorrection
) -> tuple[Component, ...]:
    """The steps, each in the middle between where both its sides expect their lines to end.

    Where lines are missing, the model has them between the sides; where lines are repeated, both sides
    have them.

    Args:
        breaks: (k,) first lines behind them, in the image.
        steps: (k) of the correction.
        correction: that follows them.
    """
    expected = np.array([one.at_px for one in steps])
    sides = []
    for away_px in (-_BESIDE_PX, _BREAK_PX + _BESIDE_PX):
        places = np.column_stack([expected + away_px, np.full(len(steps), correction.centre[1])])
        sides.append(breaks - 0.5 - (correction.apply(places) - places)[:, 0])
    return tuple(map(_step, np.mean(sides, axis=0).tolist()))


def _step(line: float) -> Component:
    return Component(
        "break", _BREAK_PX, line - _BREAK_PX / 2.0, variance_px2=np.array([_LOST_LINES**2, 0.0])
    )


def on_one_side(breaks: IntArray, line: Array, chip_side_px: float, most: float) -> BoolArray:
    """Which chips (n,) at lines show at most a share of themselves beyond a break."""
    apart = np.abs(line[:, None] - (breaks - 0.5)).min(axis=1, initial=np.inf)
    return np.asarray(apart >= (0.5 - most) * chip_side_px)


def held_parts(breaks: IntArray, line: Array, active: BoolArray) -> BoolArray:
    """Which parts (k + 1,) of an image between its breaks enough active points (n,) at lines hold."""
    counts = np.bincount(part_of_line(breaks, line[active]), minlength=len(breaks) + 1)
    return np.asarray(counts >= FEWEST_IN_PART)


def part_of_line(breaks: IntArray, line: Array) -> IntArray:
    """Number (n,) of the part of an image that lines lie in, from 0."""
    return np.searchsorted(breaks, line + 0.5, side="right")
