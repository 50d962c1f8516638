"""What the figures of a report draw beside its numbers: points, a quicklook, chips beside the scene."""

import math
from dataclasses import dataclass

import numpy as np

from services.imagery.scene import Scene
from services.imagery.source import reduce_image, render_chip
from services.registration.on_points import Registration
from services.sensors.correction import LineProfile
from services.types import Array, ChipArray, ChipSource, ControlPoints, FloatImage, Measures, point_chips

QUICKLOOK_PX = 1200
PAIRS_EACH = 6
"""Chip pairs of the best, of the middle and of the worst scores."""


@dataclass(frozen=True)
class Quicklook:
    """The scene, reduced to a size that fits a page.

    Attributes:
        pixels: (h, w); NaN or 0 where there is no data, +inf where saturated.
        reduction: pixels of the scene for one of the quicklook.
    """

    pixels: FloatImage
    reduction: float


@dataclass(frozen=True)
class ChipPair:
    """A chip and the scene at the same place, both in the geometry of the chip.

    Attributes:
        point_id: of the control point.
        gsd_m: ground sampling of the chip.
        chip: (101, 101) as stored.
        scene: (101, 101) the scene through the refined model, on the grid of the chip.
        score: correlation; NaN when none was computed.
        residual_px: (2,) line and sample; NaN when the point was not found.
        status: "active", "deactivated" or "not matched".
    """

    point_id: int
    gsd_m: float
    chip: ChipArray
    scene: ChipArray
    score: float
    residual_px: Array
    status: str


@dataclass(frozen=True)
class FigureData:
    """What the figures of the page draw; it is not part of report.json.

    Attributes:
        measures: one row for every point that the scene could show.
        quicklook: the scene reduced; None when there is none.
        gallery: chips beside the scene; the page shows the best, middle and worst scores.
        profile: of the correction, along the lines; None where it is affine.
    """

    measures: Measures
    quicklook: Quicklook | None
    gallery: tuple[ChipPair, ...]
    profile: LineProfile | None = None


def figure_data(
    scene: Scene, points: ControlPoints, chips: ChipSource, registration: Registration
) -> FigureData:
    """What the figures draw of a registered scene.

    Args:
        scene: as delivered; its pixels are read.
        points: the control points of the registration, with their chips.
        chips: of the points.
        registration: of the scene.
    """
    gallery = _gallery(scene, points, chips, registration)
    profile = registration.adjustment.correction.profile
    return FigureData(registration.measures, _quicklook(scene), gallery, profile)


def _quicklook(scene: Scene) -> Quicklook:
    factor = max(1, math.ceil(max(scene.image.shape) / QUICKLOOK_PX))
    return Quicklook(reduce_image(scene.image, factor).pixels, float(factor))


def _gallery(
    scene: Scene, points: ControlPoints, chips: ChipSource, registration: Registration
) -> tuple[ChipPair, ...]:
    """Chips beside the scene: best, middle and worst of the scores."""
    measures = registration.measures
    scored = np.flatnonzero(np.isfinite(measures.score))
    ranked = scored[np.argsort(-measures.score[scored], kind="stable")]
    middle = max((len(ranked) - PAIRS_EACH) // 2, 0)
    shown = np.concatenate([ranked[:PAIRS_EACH], ranked[middle:][:PAIRS_EACH], ranked[-PAIRS_EACH:]])
    row_of_id = {int(point_id): row for row, point_id in enumerate(points.id)}
    pairs = []
    for i in dict.fromkeys(shown.tolist()):
        point_id = int(measures.point_id[i])
        row = row_of_id[point_id]
        gsd_m = float(points.views.gsd_m[points.views.start[row]])
        pairs.append(
            ChipPair(
                point_id=point_id,
                gsd_m=gsd_m,
                chip=point_chips(points, chips, row)[0],
                scene=render_chip(scene.image, registration.model, measures.lon_lat_h[i], gsd_m),
                score=float(measures.score[i]),
                residual_px=measures.residual_px[i],
                status=measures.status(i),
            )
        )
    return tuple(pairs)
