"""Control of all kinds, which determines the position of a block on the Earth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from amers.services.adjustment.control_ground import ControlGround, joined_ground
from amers.services.adjustment.intersection import intersect
from amers.services.adjustment.known_images import KnownImages
from amers.services.imagery.scene import Scene
from amers.services.production.control_points import ControlBlock, find_control
from amers.services.production.height_control import (
    ControlHeights,
    known_heights,
    ortho_heights,
    surfaces_above,
)
from amers.services.production.marked_control import MarkedGround, known_marks
from amers.services.production.ortho_control import ControlOrtho, known_on_ortho
from amers.services.statements import Statements
from amers.services.tasks import Work
from amers.services.types import Array, Frame, Observations, Progress, joined_observations, part_of


@dataclass(frozen=True)
class Control:
    """What is known of the ground of a block.

    Attributes:
        blocks: older blocks, whose points are searched by their chips.
        marked: ground points that people marked in the images.
        orthos: ortho-images, which tell the positions of the points of the block.
        heights: elevation models, which tell their heights.
        neighbour: images of an adjusted block, some of which are images of this one.
    """

    blocks: tuple[ControlBlock, ...] = ()
    marked: tuple[MarkedGround, ...] = ()
    orthos: tuple[ControlOrtho, ...] = ()
    heights: tuple[ControlHeights, ...] = ()
    neighbour: KnownImages | None = None

    @property
    def statements(self) -> Statements:
        """Of the files of the control, but for blocks."""
        parts = [one.statements for one in self.marked]
        parts += [one.reference.statements for one in self.orthos]
        parts += [one.terrain.statements for one in self.heights]
        return tuple(chain.from_iterable(parts))


@dataclass(frozen=True)
class MeasuredPoints:
    """Points of a block, measured in its images before they are adjusted.

    Attributes:
        lon_lat_h: (n, 3) in the frame of the images; those near each other follow each other.
        frame: of the images on the Earth.
        gsd_m: ground sampling of the chips, metres.
        measures: of the points; `point` is the row of `lon_lat_h`.
    """

    lon_lat_h: Array
    frame: Frame
    gsd_m: float
    measures: Observations

    def measured(self, scenes: Sequence[Scene]) -> Array:
        """Positions (n, 3) where the rays of the measures intersect; NaN for points without any."""
        count = len(self.lon_lat_h)
        return intersect([scene.model for scene in scenes], self.measures, count).lon_lat_h


def with_control(
    scenes: Sequence[Scene],
    points: MeasuredPoints,
    control: Control,
    *,
    work: Work,
    progress: Progress,
) -> tuple[Observations, ControlGround]:
    """The measures of a block with those of its control, and the known ground.

    Ortho-images and elevation models tell where the points of the block lie; blocks and marks bring
    points of their own, which are numbered behind those.

    Args:
        scenes: with models that agree.
        points: of the block.
        control: may be empty.
        work: computes the tasks and keeps their results.
        progress: receives the fraction done.

    Raises:
        NotEnoughPoints: too few points of a source are found.
    """
    first = len(points.lon_lat_h)
    observations, ground = [points.measures], _told_of(scenes, points, control, work, progress)
    if control.blocks:
        found, known = find_control(
            scenes,
            points.frame,
            control.blocks,
            first_point=first,
            work=work,
            progress=progress,
        )
        observations.append(found)
        ground.append(known)
        first += len(known)
    for marked in control.marked:
        marks, known = known_marks(marked, first)
        observations.append(marks)
        ground.append(known)
        first += len(known)
    return joined_observations(observations), joined_ground(ground)


def _told_of(
    scenes: Sequence[Scene], points: MeasuredPoints, control: Control, work: Work, progress: Progress
) -> list[ControlGround]:
    """What ortho-images and elevation models tell of the points of a block."""
    at = points.measured(scenes)
    rows = np.flatnonzero(np.isfinite(at).all(axis=1))
    share = 1.0 / (1 + len(control.orthos) + bool(control.heights))
    ground = [ortho_heights(scenes, points.measures, heights) for heights in control.heights]
    placed = np.unique(np.concatenate([rows, *(known.point for known in ground)]))
    for number, ortho in enumerate(control.orthos):
        known = known_on_ortho(
            scenes,
            points.frame,
            points.lon_lat_h[placed],
            ortho,
            gsd_m=points.gsd_m,
            name=f"ortho/{number:02d}",
            work=work,
            progress=part_of(progress, number * share, share),
        )
        ground.append(replace(known, point=placed[known.point]))
    # Where ortho-images alone show all points, there is no surface beside them.
    if control.heights and len(rows):
        above = surfaces_above(
            scenes, at[rows], points.gsd_m, work, part_of(progress, 1.0 - share, share)
        )
        for heights in control.heights:
            known = known_heights(at[rows], above, points.frame.sigma_m, heights)
            ground.append(replace(known, point=rows[known.point]))
    return ground
