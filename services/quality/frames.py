"""The frame of control points on the Earth: of several blocks together, and what its error moves."""

from collections.abc import Sequence

import numpy as np

from services.quality.accuracy import LINEAR_LE90
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


def frame_le90_m(frame: Frame) -> float:
    """LE90 of the heights of a frame; NaN when unknown."""
    return LINEAR_LE90 * float(np.sqrt(frame.covariance_m2[2, 2]))


def frame_on_ground(frame: Frame, derivative: Array) -> Array:
    """What an error of the frame moves on the ground, by models that are registered in it.

    At its true height, a place on the ground moves by the frame's horizontal error, and along the line
    of sight by its height error: the covariance is H^-1 J F J^T H^-T, with the derivative J of the model
    and its horizontal part H. Heights that are unknown do not matter where they move nothing.

    Args:
        frame: of the control points.
        derivative: (n, 2, 3) of line, sample by east, north, up, pixels per metre.

    Returns:
        (n, 2, 2) of east, north, m^2; NaN where the frame is unknown.
    """
    moved = np.linalg.solve(derivative[:, :, :2], derivative)
    covariance = frame.covariance_m2
    if np.isnan(covariance[2, 2]) and not derivative[:, :, 2].any():
        covariance = np.where(np.arange(3)[:, None] == 2, 0.0, covariance)
        covariance = np.where(np.arange(3)[None, :] == 2, 0.0, covariance)
    return np.asarray(moved @ covariance @ moved.transpose(0, 2, 1))


def why_unknown(frame: Frame) -> str:
    """What nobody stated of a frame; "" when it is stated completely."""
    unknown = np.isnan(np.diagonal(frame.covariance_m2))
    if unknown.all():
        return "nobody stated the frame of the control points"
    if unknown[2]:
        return "nobody stated the height of the control points' frame"
    return "nobody stated the horizontal part of the control points' frame" if unknown.any() else ""
