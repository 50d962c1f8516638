"""Conversion between `amers:frame` of a block document and the typed `Frame`."""

import math

import numpy as np

from amers.services.errors import FormatError
from amers.services.types import UNKNOWN_FRAME, Array, Frame

_LONGEST_TEXT = 300
FrameJson = dict[str, list[list[float | None]] | str]


def format_frame(frame: Frame) -> FrameJson | None:
    """The `amers:frame` of a frame; None when nothing of it is known."""
    if np.isnan(frame.covariance_m2).all():
        return None
    rows = frame.covariance_m2.tolist()
    stated: FrameJson = {"covariance_m2": [[None if math.isnan(v) else v for v in row] for row in rows]}
    if frame.shared_m2.any():
        stated["shared_m2"] = frame.shared_m2.tolist()
    if frame.assumed:
        stated["assumed"] = frame.assumed
    return stated


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
    rows, shared, assumed = stated, None, ""
    if isinstance(stated, dict):
        rows, shared = stated.get("covariance_m2"), stated.get("shared_m2")
        assumed = _sentence(stated.get("assumed", ""))
    covariance = _matrix(rows)
    if not _is_covariance(covariance):
        raise FormatError(
            f"block.json: amers:frame: {stated!r:.120} found, a 3 x 3 covariance_m2 in square metres "
            "expected, null in the row and column of a coordinate that is unknown"
        )
    if shared is None:
        return Frame(covariance, assumed=assumed)
    shared_m2 = _matrix(shared)
    if not _is_covariance(shared_m2) or np.isnan(shared_m2).any():
        raise FormatError(
            f"block.json: amers:frame: shared_m2: {shared!r:.120} found, a 3 x 3 covariance in square "
            "metres expected; leave it out where it is not known"
        )
    return Frame(covariance, shared_m2, assumed=assumed)


def _sentence(stated: object) -> str:
    """What was assumed of a frame."""
    if not isinstance(stated, str) or len(stated) > _LONGEST_TEXT or not (stated + " ").isprintable():
        raise FormatError(
            f"block.json: amers:frame: assumed: {stated!r:.120} found, a sentence of at most "
            f"{_LONGEST_TEXT} characters expected"
        )
    return stated


def _matrix(rows: object) -> Array:
    """Rows as an array; an empty one where they are not numbers."""
    try:
        return np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)


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
