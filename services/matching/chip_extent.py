"""The part of a chip that a scene shows if the scene ends or has no data near the point."""

import numpy as np

from amers.services.types import FloatImage

MIN_VISIBLE_SIDE = 0.5
"""Smallest part of a chip that is searched, as a fraction of the chip's half side."""

MAX_OFF_CENTRE_PX = 1.5
"""Largest distance from the point to the centre of the visible pixels around it: the slopes of the
ground face all directions alike. Where the ground rises by 20 % and the directions of view differ by 15
degrees, a pixel off the centre displaces a chip by 0.05 px."""


def visible_half_side(patch: FloatImage, half_side: int, radius_px: int) -> int:
    """Half side of the largest central square of a chip whose visible pixels surround the point.

    Args:
        patch: square, with the point expected at its centre; NaN or +inf where it is invalid.
        half_side: of the whole chip, pixels.
        radius_px: search radius around the centre, pixels.

    Returns:
        Pixels. `half_side` when the patch has no gaps; 0 where no square of at least `MIN_VISIBLE_SIDE`
        of the chip is centred to `MAX_OFF_CENTRE_PX`. A search wider than that square does not know
        where the chip will lie, and tries the whole of it.
    """
    seen = np.isfinite(patch)
    if seen.all():
        return half_side
    row_col = np.argwhere(~seen)
    centre = patch.shape[0] // 2
    offset = row_col - centre
    distance = np.abs(offset).max(axis=1)
    missing, rows, columns = (
        np.cumsum(np.bincount(distance, weights, centre + 1))
        for weights in (None, offset[:, 0], offset[:, 1])
    )
    visible = (2 * np.arange(centre + 1) + 1) ** 2 - missing
    is_centred = (visible > 0) & (np.hypot(rows, columns) <= MAX_OFF_CENTRE_PX * visible)
    smallest = int(np.ceil(MIN_VISIBLE_SIDE * half_side))
    for half in range(half_side, smallest - 1, -1):
        if is_centred[half + radius_px]:
            return half
    return 0 if radius_px <= smallest else half_side


def central_square(pixels: FloatImage, half_side: int) -> FloatImage:
    """The (2 h + 1, 2 h + 1) pixels at the centre of a square image."""
    first = pixels.shape[0] // 2 - half_side
    return np.ascontiguousarray(
        pixels[first : first + 2 * half_side + 1, first : first + 2 * half_side + 1]
    )
