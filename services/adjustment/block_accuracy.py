"""Accuracy of an adjusted block: its frame on the Earth, and its points relative to the frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.adjustment.block_gauge import Gauge
from amers.services.adjustment.known_images import Tie
from amers.services.adjustment.normal_equations import Equations, Pairs, Points, shared_covariance
from amers.services.adjustment.parameters import (
    PASS_SHARE,
    AdjustableImage,
    BlockPriors,
    own_part,
    shared_part,
    shift_rows,
)
from amers.services.adjustment.reduced_system import ReducedSystem
from amers.services.types import Array, BoolArray, Frame, IntArray


@dataclass(frozen=True)
class BlockAccuracy:
    """The covariance of a block in two independent parts: that of its frames, and the rest.

    The doubt about the frame may be a hundred thousand times that of the points in it, as squares ten
    digits: the parts are computed apart, as no difference of the two would leave anything.

    Attributes:
        frame_m2: (3 g, 3 g) of the translations of the groups, without the doubt about passes.
        move: (n k, 3 g) change of all parameters, the frames of control included, when the images of a
            group move by a metre.
        pairs: of images (and frames) that have a point in common.
        relative: (s, k, k) of the parameters of pairs, for exact frames.
    """

    frame_m2: Array
    move: Array
    pairs: Pairs
    relative: Array

    def covariance(self) -> Array:
        """Of the parameters of pairs (s, k, k), with the doubt about the frame."""
        return np.asarray(self.relative + _of_pairs(self.pairs, self.move, self.frame_m2))

    def variance(self) -> Array:
        """Of the parameters (n k,), with the doubt about the frame."""
        own = np.diagonal(self.relative[self.pairs.start[:-1]], 0, 1, 2).ravel()
        return np.asarray(own + ((self.move @ self.frame_m2) * self.move).sum(axis=1))

    @property
    def followed(self) -> Array:
        """Change (n, k, 3) of all parameters when their own group moves by a metre."""
        # Each image belongs to one group.
        own = self.move.reshape(len(self.move), -1, 3).sum(axis=1)
        return np.asarray(own.reshape(len(self.pairs.start) - 1, -1, 3))

    def frames_m2(self, group: IntArray) -> Array:
        """Covariances (p, 3, 3) of the frames of points of given groups (p,)."""
        return np.stack(_of_groups(self.frame_m2))[group]


def _of_pairs(pairs: Pairs, move: Array, frame_m2: Array) -> Array:
    """Blocks (s, k, k) of what frames add to the covariance of the parameters."""
    by_block = move.reshape(len(pairs.start) - 1, -1, len(frame_m2))
    first = np.repeat(np.arange(len(by_block)), np.diff(pairs.start))
    return np.asarray((by_block @ frame_m2)[first] @ by_block[pairs.other].transpose(0, 2, 1))


def block_accuracy(system: ReducedSystem, pairs: Pairs, gauge: Gauge, of_images: int) -> BlockAccuracy:
    """The accuracy of a solution.

    The frame is the translation t that fits the errors of the images' parameters best, with D the effect
    of a translation on them and M the inverse of their covariance: F = (D^T M D)^-1. It is the most
    precise of all means of the block, hence independent of what is left: M^-1 = D F D^T + R.

    Args:
        system: normal equations at the solution.
        pairs: of images (and frames) that have a point in common.
        gauge: translations of the groups.
        of_images: number of parameters of images; those of the frames of control are behind.
    """
    move = gauge.move.copy()
    move[of_images:] = 0.0
    if len(gauge.move) > of_images:
        # The frames of control are unknowns as well: they follow when the images move.
        corner = np.zeros((len(move), len(move) - of_images))
        corner[of_images:] = np.eye(len(move) - of_images)
        own = system.times(corner)[of_images:]
        # Where no image follows, as ortho-images do not follow heights, the frames of heights do alone.
        alone = ~move[:of_images].any(axis=0)
        followed = -np.linalg.solve(own, system.times(move)[of_images:])
        move[of_images:] = np.where(alone, gauge.move[of_images:], followed)
    weight = system.times(move)
    frame_m2 = _frame_m2(move.T @ weight)
    # M + (a - 1) M D F D^T M has the inverse R + D F D^T / a: taking off a small F loses nothing.
    stiffer, root = _stiffened(weight, frame_m2)
    relative = system.inverse(pairs, root) - _of_pairs(pairs, move, _felt(frame_m2) / stiffer)
    return BlockAccuracy(frame_m2, move, pairs, relative)


def _frame_m2(weight: Array) -> Array:
    """The inverse F of D^T M D; translations that change no parameter have the largest variance.

    One image on one control point moves along its line of sight without any change.
    """
    values, vectors = np.linalg.eigh((weight + weight.T) / 2.0)
    if values[0] > _UNFELT_M**-2.0:
        return np.asarray(np.linalg.inv(weight), dtype=np.float64)
    return np.asarray((vectors / np.maximum(values, _UNFELT_M**-2.0)) @ vectors.T)


def _felt(frame_m2: Array) -> Array:
    """The covariance of frames without the translations that change no parameter."""
    values, vectors = np.linalg.eigh(frame_m2)
    if values[-1] < _NEARLY * _UNFELT_M**2:
        return frame_m2
    return np.asarray((vectors * np.where(values < _NEARLY * _UNFELT_M**2, values, 0.0)) @ vectors.T)


def joint_relative(system: ReducedSystem, accuracy: BlockAccuracy) -> Array:
    """Covariance (K, K) of all parameters for exact frames: `BlockAccuracy.relative` of all pairs."""
    stiffer, root = _stiffened(system.times(accuracy.move), accuracy.frame_m2)
    added = accuracy.move @ (_felt(accuracy.frame_m2) / stiffer) @ accuracy.move.T
    return np.asarray(system.dense_inverse(root) - added)


def _stiffened(weight: Array, frame_m2: Array) -> tuple[float, Array]:
    """The factor a, and columns whose squares add (a - 1) M D F D^T M, of M D and F."""
    felt = _felt(frame_m2)
    stiffer = max(1.0, float(np.trace(felt)) / len(felt) / _LITTLE_M**2)
    if felt is frame_m2:
        return stiffer, np.sqrt(stiffer - 1.0) * weight @ np.linalg.cholesky(felt)
    values, vectors = np.linalg.eigh(felt)
    return stiffer, np.sqrt(stiffer - 1.0) * weight @ (vectors * np.sqrt(np.maximum(values, 0.0)))


_LITTLE_M = 0.1
"""Standard deviation of a frame that is taken off without loss."""
_UNFELT_M = 1e5
"""Standard deviation of a translation that changes no parameter: farther than any model is off, and its
square still far from what rounding leaves of the others."""
_NEARLY = 0.999


def earth_frames(
    accuracy: BlockAccuracy,
    priors: BlockPriors,
    images: Sequence[AdjustableImage],
    passes: Sequence[BoolArray],
    tie: Tie | None = None,
) -> tuple[Frame, ...]:
    """The frames of the groups of a block on the Earth.

    Images of one pass share orbit, attitude and clock, to an unknown extent: shared errors
    weaken the position and strengthen the height. With the covariance F0 for images that share nothing
    and F1 for images that share all, the frame is F0 + (F1 - F0)+, which covers both.

    The frame of a neighbour may share errors in turn with those images of a pass that it has not: with
    what it adds, X, and what these add, Y, their sum has at most the covariance (1 + a) X + (1 + 1/a) Y.

    Args:
        accuracy: of the block.
        priors: of the parameters.
        images: with their own priors.
        passes: masks (n,) of images that may share errors.
        tie: images in common with an adjusted block.
    """
    common = np.zeros(len(images), dtype=np.bool_) if tie is None else tie.members(len(images))
    gain = accuracy.frame_m2 @ priors.located(accuracy.move).T
    doubted = accuracy.frame_m2.copy()
    beside = np.zeros_like(doubted)
    for both in passes:
        members = both & ~common
        if not members.any():
            continue
        rows = shift_rows(images, members, priors.size)
        weighted = gain[:, rows]
        shared = shared_part(images, members, weighted)
        doubted += positive_part(shared) - PASS_SHARE * shared
        if (both & common).any():
            beside += own_part(images, members, weighted) + shared
    if tie is not None and beside.any():
        own = tie.parameter_rows(priors.size)
        weighted = gain[:, own]
        carried = weighted @ np.linalg.solve(priors.apart[np.ix_(own, own)].toarray(), weighted.T)
        together = np.linalg.inv(doubted)
        share = np.sqrt(np.trace(together @ beside) / np.trace(together @ carried))
        doubted += share * carried + beside / share
    return tuple(Frame((own + own.T) / 2.0) for own in _of_groups(doubted))


def _of_groups(covariance: Array) -> list[Array]:
    """Diagonal blocks (3, 3)."""
    return [covariance[i : i + 3, i : i + 3] for i in range(0, len(covariance), 3)]


def carried_covariances(
    equations: Equations, points: Points, pairs: Pairs, accuracy: tuple[Array, Array, Array]
) -> Array:
    """What images add to the covariances of points, relative to their frames: (p, 3, 3).

    The other part is that of a point's own rays; this one neighbours share. With how far T a point goes
    when its group moves by a metre, nearly the unit matrix, the frame F adds (T - I) F (T - I)^T.

    Args:
        equations: at the solution.
        points: eliminated from them.
        pairs: of blocks that have a point in common.
        accuracy: (s, k, k) `BlockAccuracy.relative` of them, (n, k, 3) `BlockAccuracy.followed`, and
            (p, 3, 3) of the frame of each point.
    """
    relative, followed, frame_m2 = accuracy
    of_group = followed.reshape(-1, 3)
    added, carried = shared_covariance(equations, points, pairs, relative, of_group)
    turned = carried - np.eye(3)
    carried_m2 = added + turned @ frame_m2 @ turned.transpose(0, 2, 1)
    return np.asarray((carried_m2 + carried_m2.transpose(0, 2, 1)) / 2.0)


def positive_part(matrix: Array) -> Array:
    """The nearest positive semidefinite matrix to a symmetric one.

    Added to A, the positive part of B - A gives a matrix that exceeds both A and B.
    """
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2.0)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
