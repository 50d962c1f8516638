"""Points measured by chip matching in all images that show them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from amers.services.conventions import CHIP_CENTRE, CHIP_SIZE
from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import image_gsd_m, render_chip
from amers.services.matching.correlate import FOUND, CorrelationOptions, correlation_map, find_chip
from amers.services.sensors.base import SensorModel
from amers.services.types import (
    Array,
    BoolArray,
    ChipArray,
    FloatImage,
    Observations,
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


@dataclass(frozen=True)
class ChipMeasures:
    """Points measured on chips.

    Attributes:
        observations: image positions of the points that two images or more measure; `point` is the row
            of the point.
        saliency: (n,) of the chips; 0 where fewer than two images show a whole one.
    """

    observations: Observations
    saliency: Array


def refine_on_chips(
    scenes: Sequence[Scene],
    lon_lat_h: Array,
    gsd_m: float,
    options: RefinementOptions = RefinementOptions(),
) -> ChipMeasures:
    """Positions of points in every image that shows their whole chip, measured by chip matching.

    The view closest to the vertical that shows the point gives the chip, which is searched in the other
    images, rendered into the geometry of the chip.

    Args:
        scenes: the images, with models that are consistent with each other to a few chip pixels.
        lon_lat_h: (n, 3) the points.
        gsd_m: ground sampling of the chips, metres.
        options: thresholds.
    """
    point, image, line_sample, sigma = [], [], [], []
    saliency = np.zeros(len(lon_lat_h))
    for row, (ground, seen_by) in enumerate(
        zip(lon_lat_h, seen_whole(scenes, lon_lat_h, gsd_m), strict=True)
    ):
        if len(seen_by) < 2:
            continue
        reference, chip = reference_chip(scenes, seen_by, ground, gsd_m)
        saliency[row] = chip_saliency(chip)
        others = {i: scenes[i] for i in seen_by if i != reference}
        measures = _measures(others, ground, chip, gsd_m, options)
        if not measures:
            continue
        # The reference defines the detail: its position is as precise as the best of the others.
        position = scenes[reference].model.project(ground[None, :])[0]
        measures[reference] = position, min(sigma_px for _, sigma_px in measures.values())
        for i, (position, sigma_px) in measures.items():
            point.append(row)
            image.append(i)
            line_sample.append(position)
            sigma.append(sigma_px * gsd_m / image_gsd_m(scenes[i].model, ground))
    observations = Observations(
        np.array(point, dtype=np.int64),
        np.array(image, dtype=np.int64),
        np.array(line_sample).reshape(-1, 2),
        np.array(sigma),
    )
    return ChipMeasures(observations, saliency)


def seen_whole(scenes: Sequence[Scene], lon_lat_h: Array, gsd_m: float) -> list[list[int]]:
    """The images that show the whole chip of every point (n, 3), those closest to the vertical first."""
    whole = np.stack([chip_inside(scene.model, scene.image.shape, lon_lat_h, gsd_m) for scene in scenes])
    by_incidence = np.argsort([np.nan_to_num(s.acquisition.incidence_deg, nan=90.0) for s in scenes])
    return [[int(i) for i in by_incidence if whole[i, row]] for row in range(len(lon_lat_h))]


def reference_chip(
    scenes: Sequence[Scene], seen_by: Sequence[int], ground: Array, gsd_m: float
) -> tuple[int, FloatImage]:
    """The first image that shows a point (3,) without clouds or gaps, or else the last; its chip."""
    for i in seen_by:
        chip = render_chip(scenes[i].image, scenes[i].model, ground, gsd_m)
        if nearly_whole(chip):
            break
    return i, chip


def _measures(
    scenes: Mapping[int, Scene],
    ground: Array,
    chip: FloatImage,
    gsd_m: float,
    options: RefinementOptions,
) -> dict[int, tuple[Array, float]]:
    """Image position (2,) and sigma, chip pixels, of a point (3,) in the images that show its chip."""
    found = {}
    for i, scene in scenes.items():
        patch = render_chip(scene.image, scene.model, ground, gsd_m, CHIP_SIZE + 2 * options.radius_px)
        peak = find_chip(patch, chip, options.correlation)
        if peak.reason == FOUND:
            displacement_m = [[peak.row_col[1] * gsd_m, -peak.row_col[0] * gsd_m, 0.0]]
            position = scene.model.project(move_metres(ground[None, :], np.array(displacement_m)))[0]
            found[i] = position, max(peak.sigma_px, options.min_sigma_px)
    return found


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
