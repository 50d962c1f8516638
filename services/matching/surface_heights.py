"""Height of the surface at the centre of a chip, in contrast to the height of its content."""

from collections.abc import Sequence

import cv2
import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import render_chip
from amers.services.matching.correlate import correlation_map
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, FloatImage

_PART_PX = 11
"""Side of a part: small enough to lie on one surface, large enough to be found."""
_PART_STEP_PX = 13
"""Parts do not overlap: where the inner ones follow the edge of a roof, outer ones show the ground."""
_OFFSETS_PX = (-_PART_STEP_PX, 0, _PART_STEP_PX)
_TEMPLATE_PX = _PART_PX + 2 * _PART_STEP_PX
_RADIUS_PX = 16
"""Largest displacement of a part from the place of the whole chip."""
_STEP_PX = 0.2
"""Displacement between two heights that are tried, in the view with the largest parallax."""
_MIN_SCORE = 0.5
_MIN_PARTS = 7
_NOISE_PX = 0.05
"""Error of the displacement that nine parts measure together, one standard deviation."""
_RELIEF_SHARE = 0.4
"""Share of the variance of parts around their plane that their median differs from the surface by.

Chosen with `_NOISE_PX` on simulated worlds and a DSM; see docs/methods/production.md.
"""
_MAX_ROUGHNESS_PX = 0.3
"""Scatter of parts around their plane, pixels of parallax, above which they lie on several surfaces."""


def surface_height(scenes: Sequence[Scene], ground: Array, gsd_m: float) -> tuple[float, float]:
    """Height of the surface at the centre of a chip above the point's own, and its sigma, metres.

    The height of a point is the one at which its whole chips fit each other: an average over roofs,
    slopes and trees. Here nine parts around the centre are each searched for the height at which the
    views agree best, along the parallax of each view. Their median is the height of the surface. The
    sigma consists of relief, which the scatter around the plane through them shows, and of noise of the
    matching. Parts that scatter by more than 0.3 pixels of parallax lie on several surfaces (roof and
    ground, crown and ground): which of them the line of sight meets first, they do not tell.

    Args:
        scenes: that show the chip, with adjusted models; the first shows the surface whose height is
            sought, on its line of sight through the point.
        ground: (3,) the point.
        gsd_m: ground sampling of the chips, metres.

    Returns:
        NaN where fewer than seven parts are found, they lie on several surfaces, or a single scene is
        given.
    """
    if len(scenes) < 2:
        return np.nan, np.nan
    first = scenes[0]
    chip = render_chip(first.image, first.model, ground, gsd_m, _TEMPLATE_PX)
    by_height = _displacement(first.model, ground)
    parallax = np.array([_displacement(s.model, ground) - by_height for s in scenes[1:]]) / gsd_m
    largest = float(np.hypot(*parallax.T).max())
    if not largest > 0.0:
        return np.nan, np.nan
    size = _TEMPLATE_PX + 2 * _RADIUS_PX
    patches = [render_chip(s.image, s.model, ground, gsd_m, size) for s in scenes[1:]]
    reach_m = (_RADIUS_PX - 1.0) / largest
    tried_m = np.arange(-reach_m, reach_m, _STEP_PX / largest)
    heights = np.array(
        [
            _part_height(chip, patches, (row, col), parallax, tried_m)
            for row in _OFFSETS_PX
            for col in _OFFSETS_PX
        ]
    )
    known = np.isfinite(heights)
    if known.sum() < _MIN_PARTS:
        return np.nan, np.nan
    heights = heights[known]
    plane = np.array([(1.0, row, col) for row in _OFFSETS_PX for col in _OFFSETS_PX])[known]
    residual_m = heights - plane @ np.linalg.lstsq(plane, heights)[0]
    roughness_m = float(np.sqrt(residual_m @ residual_m / (len(heights) - 3)))
    if roughness_m * largest > _MAX_ROUGHNESS_PX:
        return np.nan, np.nan
    sigma_m = np.hypot(np.sqrt(_RELIEF_SHARE) * roughness_m, _NOISE_PX / largest)
    return float(np.median(heights)), float(sigma_m)


def _displacement(model: SensorModel, ground: Array) -> Array:
    """East and north (2,) by which content moves in a chip for each metre that it lies higher."""
    derivative = model.project_derivative(ground[None, :])[0]
    return np.linalg.solve(derivative[:, :2], derivative[:, 2])


def _part_height(
    chip: FloatImage,
    patches: Sequence[FloatImage],
    row_col: tuple[int, int],
    parallax: Array,
    tried_m: Array,
) -> float:
    """The height at which the views agree best on a part; NaN where they do not.

    Args:
        chip: around the point.
        patches: of the other views, larger by the search radius on all sides.
        row_col: centre of the part from that of the chip, pixels.
        parallax: (k, 2) displacement of the patches east and north, chip pixels for each metre.
        tried_m: (h,) heights, ascending in equal steps.
    """
    top, left = (o + (_TEMPLATE_PX - _PART_PX) // 2 for o in row_col)
    part = np.ascontiguousarray(chip[top : top + _PART_PX, left : left + _PART_PX])
    reach = _PART_PX + 2 * _RADIUS_PX
    total, views = np.zeros(len(tried_m)), 0
    for patch, (east, north) in zip(patches, parallax, strict=True):
        scores = correlation_map(
            np.ascontiguousarray(patch[top : top + reach, left : left + reach]), part
        )
        if scores is None:
            continue
        col = (_RADIUS_PX + east * tried_m).astype(np.float32)
        row = (_RADIUS_PX - north * tried_m).astype(np.float32)
        total += cv2.remap(scores, col, row, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).ravel()
        views += 1
    best = int(np.argmax(total))
    if views == 0 or total[best] < _MIN_SCORE * views or best in (0, len(tried_m) - 1):
        return np.nan
    before, at, after = total[best - 1 : best + 2]
    curvature = before - 2.0 * at + after
    fraction = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
    return float(tried_m[best] + fraction * (tried_m[1] - tried_m[0]))
