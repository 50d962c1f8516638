"""Data of the figures of a report: points, a quicklook, chips next to the scene."""

import math
from dataclasses import dataclass

import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import quick_view, render_chip
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.registration.on_points import Registration
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import (
    Array,
    ChipArray,
    ChipSource,
    ControlPoints,
    FloatImage,
    Measures,
    point_chips,
)

QUICKLOOK_PX = 1200
COMPARED_EACH = 6
"""Points compared of the best, of the middle and of the worst scores."""
_NODES_OF_NO_CHANGE = 2
"""Of a displacement along an axis that it does not change along."""


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
class ChipComparison:
    """A chip and the scene at the same place before and after, all in the geometry of the chip.

    Attributes:
        point_id: of the control point.
        gsd_m: ground sampling of the chip.
        chip: (101, 101) as stored.
        raw: (101, 101) the scene through the delivered model, on the grid of the chip.
        registered: (101, 101) the same through the refined model.
        score: correlation; NaN when none was computed.
        residual_px: (2,) line and sample; NaN when the point was not found.
        status: "active", "deactivated" or "not matched".
    """

    point_id: int
    gsd_m: float
    chip: ChipArray
    raw: ChipArray
    registered: ChipArray
    score: float
    residual_px: Array
    status: str


@dataclass(frozen=True)
class Section:
    """The displacement of a correction along a line or a column through the middle of the image.

    Attributes:
        axis: 0 along the lines, 1 along the samples.
        position: (k,) lines or samples.
        displacement_px: (k, 2) line and sample, beyond the affine correction.
        sigma_px: (k, 2) of the corrected model there.
    """

    axis: int
    position: Array
    displacement_px: Array
    sigma_px: Array

    def at(self, position: Array) -> Array:
        """Displacement (n, 2) at lines or samples (n,)."""
        columns = self.displacement_px.T
        return np.stack([np.interp(position, self.position, one) for one in columns], axis=-1)


@dataclass(frozen=True)
class FigureData:
    """What the figures of the page draw; it is not part of report.json.

    Attributes:
        measures: one row for every point that the scene could show.
        quicklook: the scene reduced; None when there is none.
        gallery: chips beside the scene; the page shows the best, middle and worst scores.
        displacement: of the correction; None where it is affine.
        sections: of it, along the axes that it changes along.
    """

    measures: Measures
    quicklook: Quicklook | None
    gallery: tuple[ChipComparison, ...]
    displacement: DisplacementGrid | None = None
    sections: tuple[Section, ...] = ()


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
    return FigureData(
        registration.measures,
        _quicklook(scene),
        gallery,
        registration.adjustment.correction.displacement,
        displacement_sections(registration.adjustment),
    )


def displacement_sections(adjustment: SceneAdjustment) -> tuple[Section, ...]:
    """The displacement of a correction along each axis that it changes along; none of an affine one."""
    correction = adjustment.correction
    grid = correction.displacement
    sections = []
    for axis, nodes in enumerate((grid.line, grid.sample) if grid else ()):
        if len(nodes) > _NODES_OF_NO_CHANGE and grid is not None:
            places = np.tile(correction.centre, (len(nodes), 1))
            places[:, axis] = nodes
            covariance = adjustment.covariance_at(correction.apply(places))
            sigma_px = np.sqrt(np.diagonal(covariance, 0, 1, 2))
            sections.append(Section(axis, nodes, grid.at(places), sigma_px))
    return tuple(sections)


def _quicklook(scene: Scene) -> Quicklook:
    factor = max(1, math.ceil(max(scene.image.shape) / QUICKLOOK_PX))
    return Quicklook(quick_view(scene.image, factor), float(factor))


def _gallery(
    scene: Scene, points: ControlPoints, chips: ChipSource, registration: Registration
) -> tuple[ChipComparison, ...]:
    """Chips beside the scene: best, middle and worst of the scores."""
    measures = registration.measures
    scored = np.flatnonzero(np.isfinite(measures.score))
    ranked = scored[np.argsort(-measures.score[scored], kind="stable")]
    middle = max((len(ranked) - COMPARED_EACH) // 2, 0)
    shown = np.concatenate(
        [ranked[:COMPARED_EACH], ranked[middle:][:COMPARED_EACH], ranked[-COMPARED_EACH:]]
    )
    row_of_id = {int(point_id): row for row, point_id in enumerate(points.id)}
    comparisons = []
    for i in dict.fromkeys(shown.tolist()):
        point_id = int(measures.point_id[i])
        row = row_of_id[point_id]
        gsd_m = float(points.views.gsd_m[points.views.start[row]])
        raw, registered = (
            render_chip(scene.image, model, measures.lon_lat_h[i], gsd_m)
            for model in (scene.model, registration.model)
        )
        comparisons.append(
            ChipComparison(
                point_id=point_id,
                gsd_m=gsd_m,
                chip=point_chips(points, chips, row)[0],
                raw=raw,
                registered=registered,
                score=float(measures.score[i]),
                residual_px=measures.residual_px[i],
                status=measures.status(i),
            )
        )
    return tuple(comparisons)
