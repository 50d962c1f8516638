"""The accuracy of a block before any image exists: its covariance, from geometry and sigmas alone."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.adjustment.block_accuracy import (
    BlockAccuracy,
    block_accuracy,
    earth_frames,
)
from amers.services.adjustment.block_parts import Place, Weights, block_parts
from amers.services.adjustment.block_problem import BlockOptions, BlockProblem
from amers.services.adjustment.block_solution import checked_gauge, normals, point_covariances
from amers.services.adjustment.control_ground import NO_CONTROL, ControlGround
from amers.services.adjustment.parameters import AdjustableImage, block_priors
from amers.services.adjustment.reduced_system import reduced_system
from amers.services.errors import NotEnoughPoints
from amers.services.types import Array, BoolArray, Frame, IntArray, Observations


@dataclass(frozen=True)
class PredictedBlock:
    """What a block would declare whose observations have the sigmas that are stated.

    Attributes:
        point_covariance_m2: (p, 3, 3) east, north, up, relative to the frame of the point's group; NaN
            for points that are not determined.
        group: (p,) of the points; -1 for those that are not determined.
        frames: of the groups, on the Earth.
        accuracy: covariance of the parameters.
    """

    point_covariance_m2: Array
    group: IntArray
    frames: tuple[Frame, ...]
    accuracy: BlockAccuracy

    def on_earth_m2(self) -> Array:
        """Covariance (p, 3, 3) of the points with that of their frames."""
        frames_m2 = np.stack([frame.covariance_m2 for frame in self.frames])
        return np.asarray(self.point_covariance_m2 + frames_m2[self.group])


def planned_observations(
    images: Sequence[AdjustableImage], lon_lat_h: Array, seen: Sequence[BoolArray], sigma_px: Array
) -> Observations:
    """Observations without errors of ground points (p, 3), where images have them.

    Args:
        images: as planned.
        lon_lat_h: the points.
        seen: of every image, which points (p,) it may show; those outside of it are left out.
        sigma_px: (n,) of a measure in each image.
    """
    tables = []
    for number, (image, mask) in enumerate(zip(images, seen, strict=True)):
        position = image.model.project(lon_lat_h)
        with np.errstate(invalid="ignore"):
            inside = (position >= 0.0) & (position <= np.array(image.shape) - 1.0)
        rows = np.flatnonzero(inside.all(axis=1) & mask)
        sigma = np.full(len(rows), sigma_px[number])
        tables.append(np.column_stack([rows, np.full(len(rows), number), position[rows], sigma]))
    table = np.concatenate(tables)
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    return Observations(
        table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2:4], table[:, 4]
    )


def predicted_block(
    images: Sequence[AdjustableImage],
    observations: Observations,
    lon_lat_h: Array,
    *,
    control: ControlGround = NO_CONTROL,
    passes: Sequence[BoolArray] = (),
) -> PredictedBlock:
    """The covariance that `adjust_block` would have with errors as large as stated.

    The normal equations depend on where points and images are, not on what is measured. What the
    adjustment estimates from residuals, the scale of the sigmas and that of drifts, is taken as stated.

    Args:
        images: with what may move.
        observations: positions in the images, as `planned_observations` has them.
        lon_lat_h: (p, 3) the points.
        control: known ground of some of them.
        passes: masks (n,) of images that may share errors.

    Raises:
        NotEnoughPoints: too few points are determined.
        DisconnectedBlock: groups of images without common points, and without control of each.
    """
    options = BlockOptions()
    priors = block_priors(images, passes, control.frame_covariances())
    problem = BlockProblem(images, observations, control, options, len(lon_lat_h), priors.size)
    rays = np.bincount(observations.point, minlength=len(lon_lat_h))
    known = control.point[control.known[:, :2].all(axis=1)]
    counted = rays + np.isin(np.arange(len(rays)), known) >= 2
    at = Place(np.zeros((problem.n_blocks, priors.size)), lon_lat_h)
    parts = block_parts(problem)
    weights = Weights(counted[observations.point].astype(np.float64), np.ones(len(control)))
    found = normals(parts, at, weights)
    determined = found.determined & counted & (rays >= 1)
    if determined.sum() < options.min_points:
        raise NotEnoughPoints(
            int(determined.sum()),
            options.min_points,
            f"points that two of {len(images)} images show, or one and known ground: more overlap, "
            "denser points, or heights are needed",
        )
    gauge = checked_gauge(parts, found)
    system = reduced_system(found.normal, parts.pairs, priors, gauge, lambda: parts.dissection)
    accuracy = block_accuracy(system, parts.pairs, gauge, len(images) * priors.size)
    group = np.full(len(lon_lat_h), -1)
    group[observations.point[::-1]] = gauge.group[observations.image[::-1]]
    group[~determined] = -1
    relative_m2 = point_covariances(parts, found, at, accuracy, group)[1]
    return PredictedBlock(
        point_covariance_m2=np.where(determined[:, None, None], relative_m2, np.nan),
        group=group,
        frames=earth_frames(accuracy, priors, images, passes),
        accuracy=accuracy,
    )
