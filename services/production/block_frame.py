"""The position of a produced block on the Earth, from what the models of its images state."""

from collections.abc import Sequence
from datetime import timedelta

import numpy as np

from services.adjustment.bundle import BlockAdjustment
from services.geodesy import continuous
from services.types import Acquisition, Array, BoolArray, Frame

_LONGEST_PASS = timedelta(minutes=20)
"""A satellite sees a place for less than this from horizon to horizon, and next after a whole orbit."""


def block_frame(
    adjustment: BlockAdjustment, acquisitions: Sequence[Acquisition], sigma_px: Array
) -> Frame:
    """How well the frame of a block is known, by the a priori accuracy of its images.

    A translation t of the whole block moves its images by D t, the derivative of the projections. Tie
    points cannot tell such a translation from errors of the images, so that its covariance is F = D+ C
    D+^T, with the covariance C of the adjusted shifts. The height is weaker than the position by the
    ratio of height to base.

    C takes the a priori errors of the images as independent. Images of one pass share orbit, attitude
    and clock, to an extent that nobody states: shared errors weaken the position and strengthen the
    height. The frame covers both cases.

    Args:
        adjustment: of the block.
        acquisitions: of its n images.
        sigma_px: (n,) a priori standard deviation of the shift of each image, pixels.
    """
    intersected = np.isfinite(adjustment.lon_lat_h).all(axis=1)
    middle = np.median(continuous(adjustment.lon_lat_h[intersected]), axis=0)[None, :]
    derivative = np.concatenate([model.project_derivative(middle)[0] for model in adjustment.models])
    # Weighted by the a priori sigmas, as the adjustment weights the shifts.
    scale = np.repeat(sigma_px, 2)
    inverse = np.linalg.pinv(derivative / scale[:, None]) / scale
    covariance = inverse @ adjustment.covariance_px2 @ inverse.T
    gain = inverse @ adjustment.covariance_px2 / scale**2
    for members in _shared_passes(acquisitions):
        covariance = covariance + _positive_part(
            gain @ _shared_error(derivative, scale, members) @ gain.T
        )
    return Frame((covariance + covariance.T) / 2.0)


def _shared_passes(acquisitions: Sequence[Acquisition]) -> list[BoolArray]:
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


def _shared_error(derivative: Array, scale: Array, members: BoolArray) -> Array:
    """Covariance (2 n, 2 n) between different images of one horizontal error on the ground, pixels^2."""
    u, _, vt = np.linalg.svd(derivative.reshape(-1, 2, 3)[:, :, :2])
    directions = (u @ vt).reshape(-1, 2) * (scale * np.repeat(members, 2))[:, None]
    shared = directions @ directions.T
    for i in range(0, len(shared), 2):
        shared[i : i + 2, i : i + 2] = 0.0
    return np.asarray(shared)


def _positive_part(matrix: Array) -> Array:
    """The nearest positive semidefinite matrix to a symmetric one.

    Added to A, the positive part of B - A gives a matrix that exceeds both A and B.
    """
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2.0)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
