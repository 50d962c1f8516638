"""Ground that does not look as it did: edges where contrast has changed, clouds over the rest."""

from collections.abc import Sequence

import cv2
import numpy as np

from services.types import Array, BoolArray, FloatImage

ENOUGH_FOUND = 5
"""From so many points found on, others can be compared with them."""

CLOUD_ROUGHNESS = 0.4
"""A cloud is at most so rough as half of the ground around points that were found."""

CLOUD_BRIGHTNESS = 0.9
"""It is brighter than this share of that ground."""

CLOUD_SHARE = 0.1
"""So much of what is around a point under clouds hides it: nothing else is as bright, and correlation
follows what is brightest."""

CELL_PX = 10
"""Side of the squares that are bright and smooth or not."""


def edges(pixels: FloatImage) -> FloatImage:
    """Root of the length of the gradient, without the outermost pixels.

    It keeps where things end, not which side is brighter: inverted bands, other crops and wet ground
    have the same. The root keeps a few roofs from deciding alone.

    Args:
        pixels: (r, c); what is beside a NaN is one.

    Returns:
        (r - 2, c - 2).
    """
    down = pixels[2:, 1:-1] - pixels[:-2, 1:-1]
    right = pixels[1:-1, 2:] - pixels[1:-1, :-2]
    return np.asarray(cv2.sqrt(cv2.magnitude(right, down)))


def patch_statistics(pixels: FloatImage) -> Array:
    """Brightness and roughness of the squares of a patch: mean, and mean difference of neighbours.

    Args:
        pixels: (r, c), NaN where there is nothing.

    Returns:
        (squares, 2); NaN where a square is not seen whole.
    """
    rows, columns = (size // CELL_PX for size in pixels.shape)
    inner = pixels[: rows * CELL_PX, : columns * CELL_PX]
    squares = inner.reshape(rows, CELL_PX, columns, CELL_PX).transpose(0, 2, 1, 3)
    cells = squares.reshape(rows * columns, CELL_PX, CELL_PX).astype(np.float64)
    rough = np.abs(np.diff(cells, axis=2)).mean(axis=(1, 2))
    return np.column_stack([cells.mean(axis=(1, 2)), rough])


def cloud_mask(looks: Sequence[Array], found: BoolArray) -> BoolArray:
    """Which points are hidden by clouds: not found, and much around them is bright and smooth.

    Args:
        looks: (squares, 2) around each of n points, as `patch_statistics` gives them.
        found: (n,) points that were found. With fewer than `ENOUGH_FOUND` nothing is called a cloud.
    """
    hidden = np.zeros(len(found), dtype=bool)
    if found.sum() < ENOUGH_FOUND:
        return hidden
    ground = np.concatenate([look for look, seen in zip(looks, found, strict=True) if seen])
    bright = np.nanquantile(ground[:, 0], CLOUD_BRIGHTNESS)
    rough = np.nanmedian(ground[:, 1])
    for row in np.flatnonzero(~found).tolist():
        look = looks[row][np.isfinite(looks[row]).all(axis=1)]
        cloud = (look[:, 0] > bright) & (look[:, 1] < CLOUD_ROUGHNESS * rough)
        hidden[row] = len(look) > 0 and cloud.mean() >= CLOUD_SHARE
    return hidden
