"""Points measured chip against chip in all the images that see them."""

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

_KERNEL = 51


@dataclass(frozen=True)
class RefinementOptions:
    """How points are measured on chips.

    Attributes:
        radius_px: how far from the adjusted models' prediction, chip pixels.
        min_sigma_px: no measure is believed to be better than this, chip pixels.
        correlation: when a correlation peak is believed.
    """

    radius_px: int = 6
    min_sigma_px: float = 0.03
    # Steep ground looks different from two sides: half of it in common tells a place among the few that
    # are left. Along the parallax it is blurred then; the rays say how much that matters.
    correlation: CorrelationOptions = field(
        default_factory=lambda: CorrelationOptions(min_score=0.5, max_sigma_px=2.0)
    )


def refine_on_chips(
    scenes: Sequence[Scene],
    models: Sequence[SensorModel],
    lon_lat_h: Array,
    gsd_m: float,
    options: RefinementOptions = RefinementOptions(),
    *,
    progress: Progress = no_progress,
) -> Observations:
    """Measure points again, in every image that shows their chip whole.

    The chip of the steepest view is looked for in the others, all in the geometry of the chip.

    Args:
        scenes: the images.
        models: one per image, already in agreement to a few chip pixels.
        lon_lat_h: (n, 3) the points.
        gsd_m: ground sampling of the chips.
        options: thresholds.
        progress: told the fraction of the points done.

    Returns:
        Image positions of those points that two images or more agree on; `point` is the row of
        `lon_lat_h`.
    """
    whole = np.stack(
        [
            chip_inside(model, scene.image.shape, lon_lat_h, gsd_m)
            for scene, model in zip(scenes, models, strict=True)
        ]
    )
    steepest = np.argsort([np.nan_to_num(s.acquisition.incidence_deg, nan=90.0) for s in scenes])
    point, image, line_sample, sigma = [], [], [], []
    for row, ground in enumerate(lon_lat_h):
        if row % 64 == 0:
            progress(row / len(lon_lat_h), f"measuring {len(lon_lat_h)} points on chips")
        seen_by = [int(i) for i in steepest if whole[i, row]]
        found = _measure(scenes, models, ground, seen_by, gsd_m, options)
        if len(found) < 2:
            continue
        for i, position, sigma_px in found:
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


def _measure(
    scenes: Sequence[Scene],
    models: Sequence[SensorModel],
    ground: Array,
    seen_by: list[int],
    gsd_m: float,
    options: RefinementOptions,
) -> list[tuple[int, Array, float]]:
    """Image, position and sigma of one point in the images that see it."""
    if len(seen_by) < 2:
        return []
    first = seen_by[0]
    chip = render_chip(scenes[first].image, models[first], ground, gsd_m)
    found = []
    best = np.inf
    for i in seen_by[1:]:
        patch = render_chip(scenes[i].image, models[i], ground, gsd_m, CHIP_SIZE + 2 * options.radius_px)
        peak = find_chip(patch, chip, options.correlation)
        if peak.reason != FOUND:
            continue
        moved = [[peak.row_col[1] * gsd_m, -peak.row_col[0] * gsd_m, 0.0]]
        position = models[i].project(move_metres(ground[None, :], np.array(moved)))[0]
        sigma_px = max(peak.sigma_px, options.min_sigma_px)
        best = min(best, sigma_px)
        found.append((i, position, sigma_px * gsd_m / image_gsd_m(models[i], ground)))
    if found:
        # The first view defines the detail: it is as sharp as the best of the others could be measured.
        scale = gsd_m / image_gsd_m(models[first], ground)
        found.append((first, models[first].project(ground[None, :])[0], best * scale))
    return found


def chip_inside(
    model: SensorModel, shape: tuple[int, int], lon_lat_h: Array, gsd_m: float, margin_px: int = 0
) -> BoolArray:
    """Which points (n, 3) have a chip that the image shows whole."""
    reach_m = (CHIP_CENTRE + margin_px + 2.0) * gsd_m
    inside = np.ones(len(lon_lat_h), dtype=bool)
    for east, north in ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)):
        corner = np.tile([east * reach_m, north * reach_m, 0.0], (len(lon_lat_h), 1))
        line_sample = model.project(move_metres(lon_lat_h, corner))
        inside &= ((line_sample >= 0.0) & (line_sample <= np.array(shape) - 1.0)).all(axis=1)
    return inside


def chip_saliency(chip: FloatImage) -> float:
    """How well a chip can be located by its own content, 0 to 1.

    The heart of the chip is looked for in the whole of it: what counts is how much worse the next best
    place is than the right one. Lines and repeated patterns have none.
    """
    if not np.isfinite(chip).all():
        return 0.0
    margin = (CHIP_SIZE - _KERNEL) // 2
    heart = np.ascontiguousarray(chip[margin:-margin, margin:-margin])
    if heart.std() == 0.0:
        return 0.0
    scores = correlation_map(chip, heart)
    if scores is None:
        return 0.0
    scores[margin - 4 : margin + 5, margin - 4 : margin + 5] = -1.0
    return float(np.clip(1.0 - scores.max(), 0.0, 1.0))


def stored_chip(pixels: FloatImage) -> ChipArray:
    """A chip as it is stored: uint16, 0 where there is nodata."""
    stored = np.clip(np.rint(np.nan_to_num(pixels, nan=0.0)), 1, np.iinfo(np.uint16).max)
    return np.where(np.isfinite(pixels), stored, 0).astype(np.uint16)
