"""Accuracy of a registered model, as stated with its delivered correction."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from amers.services.quality.frames import frame_in_image
from amers.services.sensors.correction import ImageCorrection
from amers.services.types import UNKNOWN_FRAME, Array, BoolArray, Frame


@dataclass(frozen=True)
class CorrectionAccuracy:
    """A correction and the covariance of its errors.

    Attributes:
        correction: of the delivered model.
        covariance_px2: (6, 6) of its parameters, row by row, relative to the control points; NaN where
            unknown.
        local_sigma_px: (2,) line and sample, of what parts of the image are off by beyond it.
        frame: of the control points on the Earth.
        apart_px: standard deviation of the offsets of the blocks of the points, see `frame_in_image`.
        held: rings (n, 2) of line and sample of the area for which accuracy is stated, see `in_rings`;
            None where it is not known: all of the image is taken for it.
    """

    correction: ImageCorrection
    covariance_px2: Array
    local_sigma_px: Array
    frame: Frame = UNKNOWN_FRAME
    apart_px: float = 0.0
    held: tuple[Array, ...] | None = None

    def relative_px2(self, line_sample: Array) -> Array:
        """Covariance (n, 2, 2) of the corrected model at image positions (n, 2), without the frame.

        NaN beyond the area for which accuracy is stated.
        """
        stated = self.correction.covariance_at(line_sample, self.covariance_px2, self.local_sigma_px)
        if self.held is not None:
            stated[~in_rings(self.held, line_sample)] = np.nan
        return stated

    def frame_px2(self, derivative: Array) -> Array:
        """What the frame adds (n, 2, 2), by derivatives (n, 2, 3) of the model; NaN where unknown."""
        return frame_in_image(self.frame, derivative, self.apart_px)


def in_rings(rings: Sequence[Array], line_sample: Array) -> BoolArray:
    """Which places (n, 2) lie in an area of closed rings (k, 2): in one more ring than in holes."""
    inside = np.zeros(len(line_sample), dtype=bool)
    for ring in rings:
        inside ^= shapely.contains_xy(shapely.Polygon(ring), line_sample)
    return inside
