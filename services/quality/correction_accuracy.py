"""Accuracy of a registered model, as stated with its delivered correction."""

from dataclasses import dataclass

from amers.services.quality.frames import frame_in_image
from amers.services.sensors.correction import ImageCorrection
from amers.services.types import UNKNOWN_FRAME, Array, Frame


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
    """

    correction: ImageCorrection
    covariance_px2: Array
    local_sigma_px: Array
    frame: Frame = UNKNOWN_FRAME
    apart_px: float = 0.0

    def relative_px2(self, line_sample: Array) -> Array:
        """Covariance (n, 2, 2) of the corrected model at image positions (n, 2), without the frame."""
        return self.correction.covariance_at(line_sample, self.covariance_px2, self.local_sigma_px)

    def frame_px2(self, derivative: Array) -> Array:
        """What the frame adds (n, 2, 2), by derivatives (n, 2, 3) of the model; NaN where unknown."""
        return frame_in_image(self.frame, derivative, self.apart_px)
