"""The image correction that is nearest to an adjusted model, and the difference between both."""

from dataclasses import dataclass, replace

import numpy as np

from amers.services.adjustment.parameters import AdjustableImage, ImageParameters
from amers.services.joint.block import JointBlock
from amers.services.sensors.correction import ImageCorrection, no_correction
from amers.services.types import Array

_SIDE = 9
"""Places a side of an image at which models are compared, at the lowest and the highest ground."""
_HEIGHT_MARGIN = 0.1, 100.0
"""What the ground may lie beyond the heights of its points: share of their range, and metres."""


@dataclass(frozen=True)
class NearestCorrection:
    """An affine correction of the delivered model that stands for an adjusted one.

    Attributes:
        correction: from positions of the delivered model to those of the adjusted one.
        covariance: (6, 6) of its parameters, row by row, px^2.
        local_px: (2,) line and sample, one standard deviation of what the errors of the adjusted model
            have beyond that covariance.
        max_error_px: largest distance of both models in the image; 0 for an image correction.
    """

    correction: ImageCorrection
    covariance: Array
    local_px: Array
    max_error_px: float


def nearest_correction(block: JointBlock, number: int) -> NearestCorrection:
    """The correction of a scene of a block: its own, or the nearest to its adjusted rigorous model.

    The positions and their derivatives by the parameters are fitted alike, over the image and the
    heights of its ground: the covariance is that of the parameters, projected.
    """
    image, values, own = block.images[number], block.values(number), block.covariance(number)
    if isinstance(image, ImageParameters):
        free = np.flatnonzero(image.free.ravel())
        covariance = np.zeros((6, 6))
        covariance[np.ix_(free, free)] = own
        return NearestCorrection(image.corrected(values).correction, covariance, np.zeros(2), 0.0)
    return _nearest(image, values, own, scene_heights_m(block, number))


def scene_heights_m(block: JointBlock, number: int) -> tuple[float, float]:
    """Lowest and highest ground of a scene: that of its points that agree, and a little more.

    Of a scene without any, those of its model.
    """
    adjustment = block.adjustment
    agree = adjustment.active[: len(block.ties)] & (block.ties.image == number)
    control = block.held_by[number][adjustment.active[block.at[number]]]
    rows = np.concatenate([block.ties.point[agree], block.control.point[control]])
    height_m = adjustment.lon_lat_h[rows, 2]
    height_m = height_m[np.isfinite(height_m)]
    low, high = block.images[number].model.height_range_m
    if not len(height_m):
        return low, high
    share, least_m = _HEIGHT_MARGIN
    margin_m = max(share * float(np.ptp(height_m)), least_m)
    return max(low, float(height_m.min()) - margin_m), min(high, float(height_m.max()) + margin_m)


def _nearest(
    image: AdjustableImage, values: Array, own: Array, heights_m: tuple[float, float]
) -> NearestCorrection:
    zero = replace(no_correction(image.shape), displacement=image.displacement)
    side = np.linspace(-1.0, 1.0, _SIDE)
    t = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    t = np.tile(t, (2, 1))
    delivered = zero.centre + t * zero.half_size
    ground = image.model.locate(delivered, np.repeat(heights_m, len(t) // 2))
    computed = image.computed(values, ground)
    terms = np.column_stack([np.ones(len(t)), t])
    fitting = np.linalg.pinv(terms)
    moved = computed.line_sample - zero.apply(delivered)
    parameters = fitting @ moved
    missed = np.linalg.norm(moved - terms @ parameters, axis=1)
    of_values = np.einsum("an,nck->cak", fitting, computed.by_parameters)
    beyond = computed.by_parameters - np.einsum("na,cak->nck", terms, of_values)
    variance = np.einsum("nck,kl,ncl->nc", beyond, own, beyond)
    projected = of_values.reshape(6, -1)
    return NearestCorrection(
        replace(zero, parameters=np.asarray(parameters.T)),
        np.asarray(projected @ own @ projected.T),
        np.sqrt(np.maximum(variance.mean(axis=0), 0.0)),
        float(missed.max()),
    )
