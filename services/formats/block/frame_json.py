"""Conversion between `amers:frame` of a block document and the typed `Frame`."""

import math

import numpy as np

from services.errors import FormatError
from services.types import UNKNOWN_FRAME, Array, Frame

FrameJson = dict[str, list[list[float | None]]]


def format_frame(frame: Frame) -> FrameJson | None:
    """The `amers:frame` of a frame; None when nothing of it is known."""
    if np.isnan(frame.covariance_m2).all():
        return None
    rows = frame.covariance_m2.tolist()
    return {"covariance_m2": [[None if math.isnan(v) else v for v in row] for row in rows]}


def parse_frame(stated: object, sigma_m: float | None) -> Frame:
    """The frame that a block states.

    Args:
        stated: its `amers:frame`; None where it has none.
        sigma_m: its `frame_sigma_m`, for blocks that state no more: the height of their frame is
            unknown. None where it has none.

    Raises:
        FormatError: it is not a covariance.
    """
    if stated is None:
        return UNKNOWN_FRAME if sigma_m is None else Frame.from_sigmas(sigma_m, math.nan)
    rows = stated.get("covariance_m2") if isinstance(stated, dict) else stated
    try:
        covariance = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        covariance = np.empty(0)
    if not _is_covariance(covariance):
        raise FormatError(
            f"block.json: amers:frame: {stated!r:.120} found, a 3 x 3 covariance_m2 in square metres "
            "expected, null in the row and column of a coordinate that is unknown"
        )
    return Frame(covariance)


def _is_covariance(matrix: Array) -> bool:
    """Whether an array is a covariance (3, 3), NaN in rows and columns of unknown coordinates."""
    if matrix.shape != (3, 3) or np.isinf(matrix).any():
        return False
    unknown = np.isnan(np.diagonal(matrix))
    if (np.isnan(matrix) != (unknown[:, None] | unknown[None, :])).any():
        return False
    known = np.nan_to_num(matrix)
    tolerance_m2 = 1e-9 * float(np.abs(known).max())
    if np.abs(known - known.T).max() > tolerance_m2:
        return False
    return bool(np.linalg.eigvalsh(known).min() >= -tolerance_m2)
