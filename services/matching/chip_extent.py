"""The part of a chip that a scene shows where the scene ends, or lacks data, beside the point."""

import numpy as np

from services.types import FloatImage

MIN_VISIBLE_SIDE = 0.5
"""Smallest part of a chip that is searched, as a fraction of the chip's half side. The part is always
centred on the point, so that the slopes of its ground face all directions alike."""


def visible_half_side(patch: FloatImage, half_side: int, radius_px: int) -> int:
    """Half side of the central square of a chip that a patch shows at all positions searched.

    Args:
        patch: square, with the point expected at its centre; NaN where there is no data.
        half_side: of the whole chip, pixels.
        radius_px: search radius around the centre, pixels.

    Returns:
        Pixels. `half_side` when the patch has no gaps, and also when the visible square is smaller than
        `MIN_VISIBLE_SIDE` of the chip: such a chip is not reduced.
    """
    row, col = np.nonzero(~np.isfinite(patch))
    if len(row) == 0:
        return half_side
    centre = patch.shape[0] // 2
    nearest_gap = int(np.maximum(np.abs(row - centre), np.abs(col - centre)).min())
    visible = min(nearest_gap - 1 - radius_px, half_side)
    return visible if visible >= MIN_VISIBLE_SIDE * half_side else half_side


def central_square(pixels: FloatImage, half_side: int) -> FloatImage:
    """The (2 h + 1, 2 h + 1) pixels at the centre of a square image."""
    first = pixels.shape[0] // 2 - half_side
    return np.ascontiguousarray(
        pixels[first : first + 2 * half_side + 1, first : first + 2 * half_side + 1]
    )
