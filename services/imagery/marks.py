"""Checks of marks: inside their image, with longitude and latitude in the right order."""

from collections.abc import Sequence

import numpy as np

from amers.services.errors import InputError
from amers.services.imagery.scene import Scene, scene_footprint
from amers.services.types import Array, BoolArray, IntArray, StrArray

_MAP_COORDINATES = 10.0
"""Marks that lie outside by so many sizes of their image are coordinates of a map."""


def check_marks_inside(
    line_sample: Array, point: StrArray, image: StrArray, shape: IntArray, source: str
) -> None:
    """Refuse marks outside their image.

    Args:
        line_sample: (m, 2) pixels.
        point: (m,) names of the points.
        image: (m,) names of the images.
        shape: (m, 2) lines and samples of the images.
        source: name of the file, for messages.

    Raises:
        InputError: some lie outside; the message has the first, and the number of them.
    """
    outside = np.asarray(((line_sample < -0.5) | (line_sample > shape - 0.5)).any(axis=1))
    if not outside.any():
        return
    mark = int(np.flatnonzero(outside)[0])
    (line, sample), (lines, samples) = line_sample[mark], shape[mark]
    on_map = (np.abs(line_sample[mark]) > _MAP_COORDINATES * shape[mark]).any()
    flipped = line < 0.0 and -line < lines
    advice = (
        "its line has the other sign: QGIS counts lines downwards with negative numbers"
        if flipped
        else (
            "these are coordinates of a map: mark the points in the raw image, not in one on a map"
            if on_map
            else "correct the mark or the image it names"
        )
    )
    others = f" ({int(outside.sum())} of {len(outside)} marks lie outside)" if len(outside) > 1 else ""
    raise InputError(
        f"{source}, point {point[mark]}: line {line:g}, sample {sample:g} found, outside {image[mark]} "
        f"with {lines:g} lines of {samples:g} samples{others}; {advice}"
    )


def check_not_exchanged(lon_lat_h: Array, scenes: Sequence[Scene], source: str) -> None:
    """Refuse ground points that lie on no scene as given, but do with latitude and longitude exchanged.

    Args:
        lon_lat_h: (n, 2 or 3) degrees.
        scenes: that should show some of the points.
        source: name of the file, for messages.

    Raises:
        InputError: latitude and longitude are exchanged.
    """
    boxes = [_box(scene) for scene in scenes]
    as_given = _in_any(lon_lat_h[:, :2], boxes)
    exchanged = _in_any(lon_lat_h[:, 1::-1], boxes)
    if as_given.any() or not exchanged.any():
        return
    row = int(np.flatnonzero(exchanged)[0])
    lon, lat = lon_lat_h[row, :2]
    raise InputError(
        f"{source}: latitude and longitude seem exchanged: none of {len(lon_lat_h)} points lies on the "
        f"scene as given (longitude {lon:.6f}, latitude {lat:.6f}), {int(exchanged.sum())} do with both "
        "exchanged; exchange the two columns of the file"
    )


def _box(scene: Scene) -> Array:
    """Middle and half size (2, 2) of a box, lon and lat, of twice the extent of a scene."""
    outline = scene_footprint(scene)
    low, high = outline.min(axis=0), outline.max(axis=0)
    return np.array([(low + high) / 2.0, high - low])


def _in_any(lon_lat: Array, boxes: Sequence[Array]) -> BoolArray:
    """Which points (n,) lie in one of the boxes."""
    inside = np.zeros(len(lon_lat), dtype=np.bool_)
    for middle, half_size in boxes:
        off = np.abs(lon_lat - middle)
        off[:, 0] = np.abs((lon_lat[:, 0] - middle[0] + 180.0) % 360.0 - 180.0)
        inside |= (off <= half_size).all(axis=1)
    return inside
