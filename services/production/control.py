"""What places a block on the Earth, from all kinds of control."""

from collections.abc import Sequence
from dataclasses import dataclass

from services.adjustment.control_ground import ControlGround, joined_ground
from services.imagery.scene import Scene
from services.production.control_points import ControlBlock, find_control
from services.production.marked_control import MarkedGround, known_marks
from services.tasks import Work
from services.types import Frame, Observations, Progress, joined_observations


@dataclass(frozen=True)
class Control:
    """What is known of the ground of a block.

    Attributes:
        blocks: older blocks, whose points are searched by their chips.
        marked: ground points that people marked in the images.
    """

    blocks: tuple[ControlBlock, ...] = ()
    marked: tuple[MarkedGround, ...] = ()


def with_control(
    scenes: Sequence[Scene],
    frame: Frame,
    measures: Observations,
    control: Control,
    *,
    first_point: int,
    work: Work,
    progress: Progress,
) -> tuple[Observations, ControlGround]:
    """The measures of a block with those of its control, and the known ground.

    Args:
        scenes: with models that agree.
        frame: of the scenes on the Earth.
        measures: of the points of the block.
        control: may be empty.
        first_point: number of the first point of the control.
        work: computes the tasks and keeps their results.
        progress: receives the fraction done.

    Raises:
        NotEnoughPoints: too few points of older blocks are found.
    """
    observations, ground = [measures], []
    if control.blocks:
        found, known = find_control(
            scenes, frame, control.blocks, first_point=first_point, work=work, progress=progress
        )
        observations.append(found)
        ground.append(known)
    for marked in control.marked:
        first = first_point + sum(map(len, ground))
        marks, known = known_marks(marked, first)
        observations.append(marks)
        ground.append(known)
    return joined_observations(observations), joined_ground(ground)
