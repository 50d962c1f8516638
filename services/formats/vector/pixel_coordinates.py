"""Pixel coordinates in vector files; origin and signs depend on the tool that wrote them.

| name | x | y | origin | written by |
|---|---|---|---|---|
| `qgis` | column | minus row | corner of the first pixel | QGIS on an image without georeferencing |
| `corner` | column | row | corner of the first pixel | GDAL, most tools for annotation |
| `centre` | column | row | centre of the first pixel | Amers, scientific tools |
"""

from typing import Literal, get_args

import numpy as np

from amers.services.errors import InputError
from amers.services.types import Array, BoolArray

PixelOrigin = Literal["qgis", "corner", "centre"]
PIXEL_ORIGINS: tuple[PixelOrigin, ...] = get_args(PixelOrigin)

_SCALE = {"qgis": (-1.0, 1.0), "corner": (1.0, 1.0), "centre": (1.0, 1.0)}
_OFFSET = {"qgis": -0.5, "corner": -0.5, "centre": 0.0}


def line_sample_of_xy(xy: Array, origin: PixelOrigin) -> Array:
    """Image positions (n, 2), line and sample, of pixel coordinates (n, 2 or 3), x and y."""
    return np.asarray(xy[:, 1::-1] * _SCALE[origin] + _OFFSET[origin])


def xy_of_line_sample(line_sample: Array, origin: PixelOrigin) -> Array:
    """Pixel coordinates (n, 2), x and y, of image positions (n, 2)."""
    return np.asarray(((line_sample - _OFFSET[origin]) * _SCALE[origin])[:, ::-1])


def outside(line_sample: Array, shape: tuple[int, int], margin_px: float) -> BoolArray:
    """Which positions (n, 2) lie outside an image by more than a margin."""
    low, high = -0.5 - margin_px, np.array(shape) - 0.5 + margin_px
    return np.asarray(((line_sample < low) | (line_sample > high)).any(axis=1))


def check_inside(xy: Array, shape: tuple[int, int], origin: PixelOrigin, margin_px: float) -> None:
    """Refuse vertices outside an image: they are not its pixel coordinates, or have another origin.

    Args:
        xy: (n, 2) distinct pixel coordinates, as in the file.
        shape: lines and samples of the image.
        origin: that the caller states.
        margin_px: by which vertices may lie outside.

    Raises:
        InputError: some do; the message says how many, by how much, and which origin fits better.
    """
    counts = {
        name: int(outside(line_sample_of_xy(xy, name), shape, margin_px).sum()) for name in PIXEL_ORIGINS
    }
    if not counts[origin]:
        return
    position = line_sample_of_xy(xy, origin)
    past_px = np.maximum(-0.5 - position, position - np.array(shape) + 0.5).max(axis=1)
    far = int(np.argmax(past_px))
    better = next((name for name in PIXEL_ORIGINS if not counts[name]), None)
    advice = (
        f"with --pixels {better} all of them lie inside"
        if better
        else "give the image that they were drawn on, or a larger --margin-px"
    )
    raise InputError(
        f"{counts[origin]:,} of {len(xy):,} vertices lie outside the image of {shape[0]} lines and "
        f"{shape[1]} samples, taken as --pixels {origin}; the farthest, x {xy[far, 0]:g}, "
        f"y {xy[far, 1]:g}, by {past_px[far]:.1f} px: {advice}"
    )
