"""The middle of a chip: what of it a scene shows that ends beside its point."""

import numpy as np

from services.types import FloatImage

MIN_VISIBLE_SIDE = 0.5
"""Of the half side of a chip: less of it is not searched. What is searched stays round the point, so
that slopes lean to all sides alike."""


def visible_half_side(patch: FloatImage, half_side: int, radius_px: int) -> int:
    """Half the side of the part of a chip, round its point, that a patch shows at all places searched.

    Args:
        patch: square, with the point expected in its middle; NaN where there is nothing.
        half_side: of the whole chip, pixels.
        radius_px: how far the point may be from the middle.

    Returns:
        `half_side` where the whole chip is shown, or less than `MIN_VISIBLE_SIDE` of it everywhere.
    """
    row, col = np.nonzero(~np.isfinite(patch))
    if len(row) == 0:
        return half_side
    centre = patch.shape[0] // 2
    nearest = int(np.maximum(np.abs(row - centre), np.abs(col - centre)).min())
    shown = min(nearest - 1 - radius_px, half_side)
    return shown if shown >= MIN_VISIBLE_SIDE * half_side else half_side


def central_square(pixels: FloatImage, half_side: int) -> FloatImage:
    """The (2 h + 1, 2 h + 1) pixels in the middle of a square."""
    first = pixels.shape[0] // 2 - half_side
    return np.ascontiguousarray(
        pixels[first : first + 2 * half_side + 1, first : first + 2 * half_side + 1]
    )
