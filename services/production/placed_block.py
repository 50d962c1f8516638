"""Later control for an adjusted block: matched in its images, and the block shifted onto it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.intersection import intersect
from amers.services.errors import NotEnoughPoints
from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.production.control import Control, MeasuredPoints, with_control
from amers.services.sensors.rpc import RpcModel
from amers.services.tasks import Work
from amers.services.types import Array, ControlPoints, IntArray, Observations, Progress, no_progress

_FEWEST = 3
_POINT_SIGMA_PX = 0.1
"""Any: the positions of the block's own points in its images follow from the points."""


@dataclass(frozen=True)
class FoundControl:
    """Known ground, and where it lies in a block.

    Attributes:
        known: c positions on the Earth.
        lon_lat_h: (c, 3) the same points in the block.
        covariance_m2: (c, 3, 3) of these, relative to the frame of the block.
    """

    known: ControlGround
    lon_lat_h: Array
    covariance_m2: Array


def find_in_block(
    scenes: Sequence[Scene],
    points: ControlPoints,
    control: Control,
    progress: Progress = no_progress,
) -> FoundControl:
    """Control in the images of an adjusted block, by the rays of its models.

    Args:
        scenes: images of the block with their adjusted models; some are enough.
        points: of the block; `views.images` has the names of the scenes.
        control: of any kind.
        progress: receives the fraction done.

    Raises:
        NotEnoughPoints: fewer than three points are found that two images show.
    """
    frame = points.frames[0]
    order = np.argsort(_part_of_ground(points.lon_lat_h), kind="stable")
    own = points.take(order)
    measured = MeasuredPoints(own.lon_lat_h, frame, float(own.views.gsd_m.min()), _seen(scenes, own))
    observations, known = with_control(scenes, measured, control, work=Work(), progress=progress)
    count = len(own) + len(known)
    met = intersect([scene.model for scene in scenes], observations, count)
    lon_lat_h = np.concatenate([own.lon_lat_h, met.lon_lat_h[len(own) :]])
    covariance_m2 = np.concatenate([own.covariance_m2, met.covariance_m2[len(own) :] + frame.shared_m2])
    found = np.isfinite(lon_lat_h[known.point]).all(axis=1)
    if found.sum() < _FEWEST:
        raise NotEnoughPoints(
            int(found.sum()), _FEWEST, "points of the control that two of the images show"
        )
    rows = known.point[found]
    return FoundControl(_taken(known, np.flatnonzero(found)), lon_lat_h[rows], covariance_m2[rows])


def _taken(known: ControlGround, rows: IntArray) -> ControlGround:
    return replace(
        known,
        point=known.point[rows],
        lon_lat_h=known.lon_lat_h[rows],
        covariance_m2=known.covariance_m2[rows],
        source=known.source[rows],
        names=tuple(known.names[row] for row in rows),
        by_hand=None if known.by_hand is None else known.by_hand[rows],
    )


def _part_of_ground(lon_lat_h: Array) -> Array:
    """A number (n,) that is near for points near each other: their square of a lattice."""
    east = np.unwrap(np.radians(lon_lat_h[:, 0]))
    scaled = np.column_stack([east, np.radians(lon_lat_h[:, 1])])
    side = max(float(np.ptp(scaled, axis=0).max()), 1e-9) / 32.0
    cell = np.floor((scaled - scaled.min(axis=0)) / side).astype(np.int64)
    return np.asarray(cell[:, 0] * 64 + cell[:, 1])


def _seen(scenes: Sequence[Scene], points: ControlPoints) -> Observations:
    """Where the images show the points that have views of them, by their adjusted models."""
    row_of = {scene.acquisition.image_id: row for row, scene in enumerate(scenes)}
    views = points.views
    scene_of = np.array([row_of.get(image.image_id, -1) for image in views.images])
    of_point = np.repeat(np.arange(len(points)), np.diff(views.start))
    pairs = np.unique(np.column_stack([of_point, scene_of[views.image]]), axis=0)
    pairs = pairs[pairs[:, 1] >= 0]
    line_sample = np.empty((len(pairs), 2))
    for number, scene in enumerate(scenes):
        rows = pairs[:, 1] == number
        line_sample[rows] = scene.model.project(points.lon_lat_h[pairs[rows, 0]])
    return Observations(pairs[:, 0], pairs[:, 1], line_sample, np.full(len(pairs), _POINT_SIGMA_PX))


def moved_points(points: ControlPoints, translation_m: Array) -> ControlPoints:
    """The points of a block and their surfaces, moved by metres east, north, up (3,)."""
    steps = np.tile(translation_m, (len(points), 1))
    surface = points.surface
    if surface is not None:
        surface = replace(surface, height_m=surface.height_m + translation_m[2])
    return replace(points, lon_lat_h=move_metres(points.lon_lat_h, steps), surface=surface)


def moved_model(model: RpcModel, translation_m: Array) -> RpcModel:
    """A model that shows the moved ground where it showed the ground before."""
    return replace(
        model, ground_offset=move_metres(model.ground_offset[None, :], translation_m[None, :])[0]
    )
