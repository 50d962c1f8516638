"""What an adjusted block knows: its frame on the Earth, and its points relative to that frame."""

from collections.abc import Sequence

import numpy as np

from services.adjustment.block_gauge import Gauge
from services.adjustment.normal_equations import Equations, Points, shared_covariance
from services.adjustment.parameters import (
    PASS_SHARE,
    BlockPriors,
    ImageParameters,
    sharing_covariance,
    shift_rows,
)
from services.adjustment.reduced_system import ReducedSystem
from services.types import Array, BoolArray, Frame


def block_frames(
    system: ReducedSystem,
    gauge: Gauge,
    priors: BlockPriors,
    images: Sequence[ImageParameters],
    passes: Sequence[BoolArray],
) -> tuple[tuple[Frame, ...], Array, Array]:
    """The frames of the groups of a block on the Earth.

    The frame is the translation t that fits the errors of the images' parameters best, with D the effect
    of a translation on them and M the inverse of their covariance: F = (D^T M D)^-1. It is the most
    precise of all means of the block, hence independent of how points lie relative to it.

    Images of one pass share orbit, attitude and clock, to an extent that nobody states: shared errors
    weaken the position and strengthen the height. With the covariance F0 for images that share nothing
    and F1 for images that share all, the frame is F0 + (F1 - F0)+, which covers both.

    Args:
        system: normal equations at the solution.
        gauge: translations of the groups.
        priors: of the parameters.
        images: with their own priors.
        passes: masks (n,) of images that may share errors.

    Returns:
        The frames; the covariances (g, 3, 3) without the doubt about passes; the change (n k, 3 g) of
        all parameters, the frames of control included, when the images of a group move by a metre.
    """
    of_images = len(images) * priors.size
    move = gauge.move.copy()
    move[of_images:] = 0.0
    if len(gauge.move) > of_images:
        # The frames of control are unknowns as well: they follow when the images move.
        corner = np.zeros((len(move), len(move) - of_images))
        corner[of_images:] = np.eye(len(move) - of_images)
        own = system.times(corner)[of_images:]
        move[of_images:] = -np.linalg.solve(own, system.times(move)[of_images:])
    together = np.linalg.inv(move.T @ system.times(move))
    gain = together @ (priors.locating @ move).T
    doubted = together.copy()
    for members in passes:
        rows = shift_rows(images, members, priors.size)
        weighted = gain[:, rows]
        none, half, full = (sharing_covariance(images, members, s) for s in (0.0, PASS_SHARE, 1.0))
        doubted += weighted @ (none - half) @ weighted.T
        doubted += positive_part(weighted @ (full - none) @ weighted.T)
    own_blocks = [np.s_[3 * g : 3 * g + 3] for g in range(len(together) // 3)]
    frames = tuple(Frame((doubted[b, b] + doubted[b, b].T) / 2.0) for b in own_blocks)
    return frames, np.stack([together[b, b] for b in own_blocks]), move


def point_covariances(
    equations: Equations, points: Points, covariance: Array, move: Array, frame_m2: Array
) -> Array:
    """Covariance (p, 3, 3) of the points relative to the frames of their groups (p, 3, 3).

    Their own part is that of their rays. The other is taken over from the images, less the frame: with
    the covariance A of what a point takes over and how far T it goes when its group moves by a metre,
    A - T F - F T^T + F.
    """
    # Each image belongs to one group.
    of_group = move.reshape(len(move), -1, 3).sum(axis=1)
    added, carried = shared_covariance(equations, points, covariance, of_group)
    with_frame = carried @ frame_m2
    return np.asarray(points.inverse + added - with_frame - with_frame.transpose(0, 2, 1) + frame_m2)


def positive_part(matrix: Array) -> Array:
    """The nearest positive semidefinite matrix to a symmetric one.

    Added to A, the positive part of B - A gives a matrix that exceeds both A and B.
    """
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2.0)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
