"""The frame of control from several blocks, on the Earth."""

from collections.abc import Sequence

import numpy as np

from services.types import Array, BoolArray, ControlPoints, Frame


def shared_frame(points: ControlPoints, active: BoolArray) -> Frame:
    """The frame that the active points (n,) of a mask have together: see `weighted_frame`."""
    shares = np.bincount(points.block[active], minlength=len(points.frames))
    return weighted_frame(points.frames, shares.astype(np.float64))


def weighted_frame(frames: Sequence[Frame], weights: Array) -> Frame:
    """The mean of the covariances of frames, by their weights (n,).

    Whatever the correlation between the errors of the frames, the covariance of their weighted mean
    cannot exceed this (the square is convex). It is unknown where a frame of positive weight is.
    """
    used = weights > 0.0
    if not used.any():
        return Frame(np.full((3, 3), np.nan))
    covariances = np.array([frame.covariance_m2 for frame in frames])
    return Frame(np.average(covariances[used], axis=0, weights=weights[used]))
