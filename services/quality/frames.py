"""The frame of control points on the Earth: several blocks combined, and the effect of its error."""

from collections.abc import Sequence

import numpy as np

from amers.services.quality.normal_law import LINEAR_LE90
from amers.services.types import Array, BoolArray, ControlPoints, Frame


def shared_frame(points: ControlPoints, active: BoolArray) -> Frame:
    """The frame that the active points (n,) of a mask have together: see `weighted_frame`."""
    shares = np.bincount(points.block[active], minlength=len(points.frames))
    return weighted_frame(points.frames, shares.astype(np.float64))


def weighted_frame(frames: Sequence[Frame], weights: Array) -> Frame:
    """The mean of the covariances of frames, and of what points share in them, by their weights (n,).

    Whatever the correlation between the errors of the frames, the covariance of their weighted mean
    cannot exceed this (the square is convex). It is unknown where a frame of positive weight is, and
    assumed where one is.
    """
    used = weights > 0.0
    if not used.any():
        return Frame(np.full((3, 3), np.nan))
    covariance_m2, shared_m2 = (
        np.average(np.array(matrices)[used], axis=0, weights=weights[used])
        for matrices in zip(*((frame.covariance_m2, frame.shared_m2) for frame in frames), strict=True)
    )
    assumed = [frame.assumed for frame, is_used in zip(frames, used, strict=True) if is_used]
    return Frame(covariance_m2, shared_m2, assumed=next(filter(None, assumed), ""))


def frame_le90_m(frame: Frame) -> float:
    """LE90 of the heights of a frame; NaN when unknown."""
    return LINEAR_LE90 * float(np.sqrt(frame.covariance_m2[2, 2]))


def frame_in_image(frame: Frame, derivative: Array, apart_px: float) -> Array:
    """What an error of the frame moves in the image, by models that are registered in it.

    It is J F J^T with the derivative J of the model; heights that are unknown do not matter where they
    move nothing. Blocks that are seen to be apart do not share all of the error of their frames: what
    they differ by is an error relative to the control points already.

    Args:
        frame: of the control points.
        derivative: (n, 2, 3) of line, sample by east, north, up, pixels per metre.
        apart_px: standard deviation of the offsets of the blocks; 0 for one.

    Returns:
        (n, 2, 2) of line, sample, px^2; NaN where the frame is unknown.
    """
    covariance = frame.covariance_m2
    if np.isnan(covariance[2, 2]) and not derivative[:, :, 2].any():
        covariance = np.where(np.arange(3)[:, None] == 2, 0.0, covariance)
        covariance = np.where(np.arange(3)[None, :] == 2, 0.0, covariance)
    stated = derivative @ covariance @ derivative.transpose(0, 2, 1)
    variance = np.maximum(np.trace(stated, axis1=1, axis2=2) / 2.0, 1e-12)
    return np.asarray(stated * np.maximum(1.0 - apart_px**2 / variance, 0.0)[:, None, None])


def why_unknown(frame: Frame) -> str:
    """Which part of the accuracy of a frame is not stated; "" when all of it is."""
    unknown = np.isnan(np.diagonal(frame.covariance_m2))
    if not unknown.any():
        return ""
    part = "" if unknown.all() else "height " if unknown[2] else "horizontal "
    how = f"; give {frame.how_to_state}" if frame.how_to_state else ""
    return f"the {part}sigma of the control points' common error is not stated{how}"
