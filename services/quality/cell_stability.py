"""Common errors of neighbouring points: the adjustment repeated without one cell at a time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.quality.stability import (
    AdjustedScene,
    Displacement,
    GroupMeans,
    ImageResiduals,
    Repetition,
    displacements_of,
    repetitions_without,
    residuals_in_image,
    what_repetitions_show,
)
from amers.services.types import IntArray, Measures

CELLS = 4
"""Cells along each side of the area of the active points."""


@dataclass(frozen=True)
class CellStability:
    """The adjustment repeated without the points of one cell at a time, which have no neighbours left.

    An error that neighbours share moves a point held out at random together with those around it, and so
    stays hidden. It appears when all points of a cell are held out, if it does not reach farther than a
    cell; an error that reaches over the whole image appears in neither.

    Attributes:
        cells: along each side of the area of the active points.
        left_out: number of cells with active points whose adjustment succeeded.
        failed: number of cells with active points without which there was no solution.
        displacements: of the four corners and the centre; empty when no adjustment succeeded.
        held_out_px: residuals of the points held out, each counted once.
        held_out_m: the same on the ground, by the ground sampling of the image.
        group_means: mean residuals of the cells.
        note: why there is no figure; "" otherwise.
    """

    cells: int
    left_out: int
    failed: int
    displacements: tuple[Displacement, ...]
    held_out_px: ImageResiduals
    held_out_m: ImageResiduals
    group_means: GroupMeans
    note: str


def measure_cell_stability(scene: AdjustedScene) -> CellStability:
    """Displacements and residuals when the active points of one cell at a time are held out."""
    groups = cells_of(scene.measures)
    return cell_stability_of(scene, repetitions_without(scene, groups if len(groups) > 1 else []))


def cells_of(measures: Measures) -> list[IntArray]:
    """The active points of every cell that has some."""
    active = np.flatnonzero(measures.active)
    if not len(active):
        return []
    line_sample = measures.line_sample[active]
    first, last = line_sample.min(axis=0), line_sample.max(axis=0)
    inside = (line_sample - first) / np.maximum(last - first, 1.0)
    row, column = np.minimum((inside * CELLS).astype(int), CELLS - 1).T
    cell = row * CELLS + column
    return [active[cell == one] for one in np.unique(cell)]


def cell_stability_of(scene: AdjustedScene, repetitions: Sequence[Repetition]) -> CellStability:
    """Displacements and residuals of adjustments, each without the active points of one cell."""
    active, cells = int(scene.measures.active.sum()), len(cells_of(scene.measures))
    repeated = what_repetitions_show(scene, repetitions)
    left_out = len(repeated.moved_px)
    note = f"{active} active points gave no solution without any of {cells} cells"
    if cells < 2:
        note = f"{active} active points in {cells} cells leave none to hold out"
    return CellStability(
        cells=CELLS,
        left_out=left_out,
        failed=cells - left_out,
        displacements=displacements_of(repeated.moved_px, scene.gsd_m),
        held_out_px=residuals_in_image(repeated.residual_px),
        held_out_m=residuals_in_image(repeated.residual_px * scene.gsd_m),
        group_means=repeated.means,
        note="" if left_out else note,
    )
