"""Whether two pictures of a page have the same layout, whatever drew their letters and their maps."""

from pathlib import Path

import numpy as np
import rasterio

from amers.services.types import Array

BLOCK_PX = 20
"""Side of the blocks whose means are compared: other drawing of letters hardly changes them."""
A_CHANGE = 12.0
"""Difference of the mean grey values (0 to 255) of a block that has changed."""
MOST_CHANGED = 0.025
"""Share of changed blocks of pictures with one layout. A panel moved by 40 px changes 4.6 % or more."""


def grey(path: Path) -> Array:
    """A picture as grey values (lines, samples), 0 to 255."""
    with rasterio.open(path) as picture:
        values: Array = picture.read().astype(np.float64).mean(axis=0)
    return values


def changed_share(one: Array, other: Array) -> float:
    """Share of the blocks of two pictures of the same size that differ; 1 for other sizes."""
    if one.shape != other.shape:
        return 1.0
    return float((np.abs(_means(one) - _means(other)) > A_CHANGE).mean())


def _means(picture: Array) -> Array:
    lines, samples = (size // BLOCK_PX for size in picture.shape)
    inside = picture[: lines * BLOCK_PX, : samples * BLOCK_PX]
    means: Array = inside.reshape(lines, BLOCK_PX, samples, BLOCK_PX).mean(axis=(1, 3))
    return means
