"""Seams between detectors outside the points: as many and as large as between the points.

Detectors that are out of place are seen by the points on both sides of their seams. Beyond the outermost
points nothing is seen, but an image that has several seams has more of them there. They are taken for a
Poisson process with the rate and the mean square that the points show, so that the variance of the
displacement grows with the distance from the points.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from amers.services.misfit.displacement_components import Component
from amers.services.types import Array

_FEWEST = 2
"""Seams that make a rate: a single one is that of an image put together from two."""


def unseen_seams(components: Sequence[Component], sample: Array, samples: int) -> tuple[Component, ...]:
    """Steps of the displacement between the outermost points and the borders of an image.

    Args:
        components: of the displacement that the points show.
        sample: (n,) of the points.
        samples: of the image.

    Returns:
        One component for each side; none where the points show fewer than two seams.
    """
    seams = sorted((one for one in components if one.is_seam), key=lambda one: one.at_px)
    # Steps whose gaps touch are one seam whose place is uncertain.
    distinct = sum(
        one.at_px > before.at_px + before.length_px for before, one in pairwise(seams)
    ) + bool(seams)
    first, last = float(sample.min()), float(sample.max())
    if distinct < _FEWEST or first >= last:
        return ()
    a_pixel = distinct / (last - first) * np.mean([one.variance_px2 for one in seams], axis=0)
    gaps = ((0.0, first), (last, samples - 1.0 - last))
    return tuple(
        Component("step", width, at, a_pixel * width, along="samples")
        for at, width in gaps
        if width > 0.0
    )
