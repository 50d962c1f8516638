"""The least squares: the image correction of one scene from points on known ground."""

from dataclasses import dataclass
from typing import Literal

from services.sensors.base import SensorModel
from services.sensors.correction import ImageCorrection
from services.types import Array, BoolArray

Order = Literal["shift", "drift", "affine"]


@dataclass(frozen=True)
class SceneAdjustment:
    """A correction and how sure it is.

    Attributes:
        correction: of the scene's model.
        order: how many parameters were free.
        covariance: (6, 6) of `correction.parameters.ravel()`, px^2; zero for fixed parameters.
        residual_px: (n, 2) observed minus computed, line and sample, of all measures.
        active: (n,) measures that were not deactivated.
        sigma0: a posteriori standard deviation of unit weight.
    """

    correction: ImageCorrection
    order: Order
    covariance: Array
    residual_px: Array
    active: BoolArray
    sigma0: float
