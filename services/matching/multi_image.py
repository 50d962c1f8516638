"""Points measured by chip matching in all the images that see them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from services.conventions import CHIP_CENTRE, CHIP_SIZE
from services.geodesy import move_metres
from services.imagery.scene import Scene
from services.imagery.source import image_gsd_m, render_chip
from services.matching.correlate import FOUND, CorrelationOptions, correlation_map, find_chip
from services.sensors.base import SensorModel
from services.types import (
    Array,
    BoolArray,
    ChipArray,
    FloatImage,
    Observations,
    Progress,
    no_progress,
)

_CORE_PX = 51
"""Side of the core of a chip whose correlation with the whole chip measures the saliency."""
_MAX_LOST_SHARE = 0.1
"""Largest share of missing and saturated pixels in the chip of a new point."""


@dataclass(frozen=True)
class RefinementOptions:
    """How points are measured on chips.

    Attributes:
        radius_px: search radius around the prediction of the adjusted models, chip pixels.
        min_sigma_px: smallest sigma of a measure, chip pixels.
        correlation: when a correlation peak is accepted.
    """

    radius_px: int = 6
    min_sigma_px: float = 0.03
    # Steep ground looks different from two directions: a correlation of 0.5 is enough within the small
    # search radius. The position is then uncertain along the parallax, which the residuals of the rays
    # show.
    correlation: CorrelationOptions = field(
        default_factory=lambda: CorrelationOptions(min_score=0.5, max_sigma_px=2.0)
    )


def refine_on_chips(
    scenes: Sequence[Scene],
    lon_lat_h: Array,
    gsd_m: float,
    options: RefinementOptions = RefinementOptions(),
    progress: Progress = no_progress,
) -> Observations:
    """Positions of points in every image that shows their whole chip, measured by chip matching.

    The view closest to the vertical gives the chip, which is searched in the other images, rendered into
    the geometry of the chip.

    Args:
        scenes: the images, with models that are consistent with each other to a few chip pixels.
        lon_lat_h: (n, 3) the points.
        gsd_m: ground sampling of the chips, metres.
        options: thresholds.
        progress: receives the fraction of the points done.

    Returns:
        Image positions of the points that two images or more measure; `point` is the row of `lon_lat_h`.
    """
    whole = np.stack([chip_inside(scene.model, scene.image.shape, lon_lat_h, gsd_m) for scene in scenes])
    by_incidence = np.argsort([np.nan_to_num(s.acquisition.incidence_deg, nan=90.0) for s in scenes])
    point, image, line_sample, sigma = [], [], [], []
    for row, ground in enumerate(lon_lat_h):
        if row % 64 == 0:
            progress(row / len(lon_lat_h), f"measuring {len(lon_lat_h)} points on chips")
        seen_by = [int(i) for i in by_incidence if whole[i, row]]
        measures = _measure_point(scenes, seen_by, ground, gsd_m, options)
        if len(measures) < 2:
            continue
        for i, position, sigma_px in measures:
            point.append(row)
            image.append(i)
            line_sample.append(position)
            sigma.append(sigma_px)
    return Observations(
        np.array(point, dtype=np.int64),
        np.array(image, dtype=np.int64),
        np.array(line_sample).reshape(-1, 2),
        np.array(sigma),
    )


def _measure_point(
    scenes: Sequence[Scene],
    seen_by: list[int],
    ground: Array,
    gsd_m: float,
    options: RefinementOptions,
) -> list[tuple[int, Array, float]]:
    """Image, position (2,) and sigma, in pixels, of one point (3,) in the images that show its chip.

    The first image of `seen_by` gives the chip. Its own position, the last one returned, is the
    projection of the point.
    """
    if len(seen_by) < 2:
        return []
    first = scenes[seen_by[0]]
    chip = render_chip(first.image, first.model, ground, gsd_m)
    measures = []
    best_sigma_px = np.inf
    for i in seen_by[1:]:
        scene = scenes[i]
        patch = render_chip(scene.image, scene.model, ground, gsd_m, CHIP_SIZE + 2 * options.radius_px)
        peak = find_chip(patch, chip, options.correlation)
        if peak.reason != FOUND:
            continue
        displacement_m = [[peak.row_col[1] * gsd_m, -peak.row_col[0] * gsd_m, 0.0]]
        position = scene.model.project(move_metres(ground[None, :], np.array(displacement_m)))[0]
        sigma_px = max(peak.sigma_px, options.min_sigma_px)
        best_sigma_px = min(best_sigma_px, sigma_px)
        measures.append((i, position, sigma_px * gsd_m / image_gsd_m(scene.model, ground)))
    if measures:
        # The first view defines the detail: its position is as precise as the best of the others.
        scale = gsd_m / image_gsd_m(first.model, ground)
        measures.append((seen_by[0], first.model.project(ground[None, :])[0], best_sigma_px * scale))
    return measures


def chip_inside(
    model: SensorModel, shape: tuple[int, int], lon_lat_h: Array, gsd_m: float, margin_px: int = 0
) -> BoolArray:
    """Which points (n, 3) have a chip that lies completely inside the image.

    Args:
        model: of the image.
        shape: lines and samples of the image.
        lon_lat_h: (n, 3) the points.
        gsd_m: ground sampling of the chip, metres.
        margin_px: distance from the border of the image that is kept free, chip pixels.
    """
    reach_m = (CHIP_CENTRE + margin_px + 2.0) * gsd_m
    inside = np.ones(len(lon_lat_h), dtype=bool)
    for east, north in ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)):
        corner = np.tile([east * reach_m, north * reach_m, 0.0], (len(lon_lat_h), 1))
        line_sample = model.project(move_metres(lon_lat_h, corner))
        inside &= ((line_sample >= 0.0) & (line_sample <= np.array(shape) - 1.0)).all(axis=1)
    return inside


def nearly_whole(chip: FloatImage) -> bool:
    """Whether at most a tenth of a chip is missing or saturated."""
    return bool(np.isfinite(chip).mean() >= 1.0 - _MAX_LOST_SHARE)


def chip_saliency(chip: FloatImage) -> float:
    """How well a chip can be located by its own content, 0 to 1.

    The core of the chip is correlated with the whole chip. The saliency is 1 minus the second best
    score, the best being 1 at the true position. Lines and repeated patterns have a saliency near 0, and
    so has a chip that is not nearly whole.
    """
    if not nearly_whole(chip):
        return 0.0
    valid = np.isfinite(chip)
    margin = (CHIP_SIZE - _CORE_PX) // 2
    core = np.ascontiguousarray(chip[margin:-margin, margin:-margin])
    if core[valid[margin:-margin, margin:-margin]].std() == 0.0:
        return 0.0
    scores = correlation_map(chip, core)
    if scores is None:
        return 0.0
    scores[margin - 4 : margin + 5, margin - 4 : margin + 5] = -1.0
    return float(np.clip(1.0 - scores.max(), 0.0, 1.0))


def stored_chip(pixels: FloatImage) -> ChipArray:
    """A chip as it is stored: uint16, 0 where nodata, 1 at least elsewhere."""
    stored = np.clip(np.rint(np.nan_to_num(pixels, nan=0.0)), 1, np.iinfo(np.uint16).max)
    return np.where(np.isfinite(pixels), stored, 0).astype(np.uint16)
