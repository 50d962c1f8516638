"""Gauss-Newton steps of a block: points are eliminated, part by part."""

from dataclasses import dataclass

import numpy as np

from amers.services.adjustment.block_accuracy import BlockAccuracy
from amers.services.adjustment.block_gauge import MIN_COMMON, Gauge, block_gauge, connected_groups
from amers.services.adjustment.block_parts import Parts, Place, Weights, joined, same, summed
from amers.services.adjustment.block_problem import BlockProblem
from amers.services.adjustment.parameters import BlockPriors
from amers.services.adjustment.part_tasks import carried_part, moved_part, normal_part
from amers.services.adjustment.reduced_system import ReducedSystem, reduced_system
from amers.services.errors import DisconnectedBlock, NoConvergence
from amers.services.geodesy import longitudes_near
from amers.services.types import Array, BoolArray, IntArray


@dataclass(frozen=True)
class State:
    """Where an adjustment stands.

    Attributes:
        values: (n, k) parameters of images and frames.
        lon_lat_h: (p, 3) points.
        iterations: done so far.
    """

    values: Array
    lon_lat_h: Array
    iterations: int = 0

    @property
    def place(self) -> Place:
        """Where equations are linear."""
        return Place(self.values, self.lon_lat_h)


@dataclass(frozen=True)
class Normals:
    """The normal equations of a block at a place, points eliminated.

    Attributes:
        at: the place.
        weights: of the rows; 0 for those that cannot be computed.
        normal: (s, k, k) of the pairs of blocks of parameters.
        right: (n, k) right sides.
        common: (s,) pairs of observations of one point that they have.
        own, followed: (n, k, k) and (n, k, 9), `followed_ground`.
        determined: (p,) points that rays and control determine.
    """

    at: Place
    weights: Weights
    normal: Array
    right: Array
    common: IntArray
    own: Array
    followed: Array
    determined: BoolArray


@dataclass(frozen=True)
class Solved:
    """A step, with what it was computed from.

    Attributes:
        state: after the step.
        change_px: largest change of a parameter.
        normals, system: before it.
    """

    state: State
    change_px: float
    normals: Normals
    system: ReducedSystem


def normals(parts: Parts, at: Place, weights: Weights) -> Normals:
    """The normal equations of all parts together."""
    extent = same(_extent(parts.problem, at, weights))
    found = parts.each(normal_part, parts.at(at), parts.of_weights(weights), extent)
    n, s = parts.problem.n_blocks, len(parts.pairs.other)
    usable = (joined(parts.observations, found, "observations"), joined(parts.control, found, "control"))
    return Normals(
        at,
        Weights(*(np.where(mask, own, 0.0) for mask, own in zip(usable, weights, strict=True))),
        summed(parts.pair_rows, found, "normal", s),
        summed(parts.blocks, found, "right", n),
        summed(parts.pair_rows, found, "common", s),
        summed(parts.blocks, found, "own", n),
        summed(parts.blocks, found, "followed", n),
        joined(parts.points, found, "determined"),
    )


def _extent(problem: BlockProblem, at: Place, weights: Weights) -> Array:
    """Middle and size (2, 2) of the block, degrees: that of the points that are used."""
    used = np.zeros(problem.n_points, dtype=np.bool_)
    used[problem.observations.point[weights.observations > 0.0]] = True
    used[problem.control.point[weights.control > 0.0]] = True
    place = at.lon_lat_h[used & np.isfinite(at.lon_lat_h[:, 0]), :2]
    if not len(place):
        return np.array([[0.0, 0.0], [1.0, 1.0]])
    place[:, 0] = longitudes_near(place[:, 0], place[0, 0])
    return np.stack([place.mean(axis=0), 2.0 * place.std(axis=0) + 1e-12])


def step(parts: Parts, priors: BlockPriors, gauge: Gauge, before: Normals, iterations: int) -> Solved:
    """One Gauss-Newton step with the points eliminated, the first after so many `iterations`."""
    if parts.problem.tie is not None:
        priors = parts.problem.tie.priors(priors, gauge.move)
    at = before.at
    system = reduced_system(before.normal, parts.pairs, priors, gauge, lambda: parts.dissection)
    right_side = system.right_side(before.right.ravel(), at.values.ravel())
    change = system.solve(right_side).reshape(at.values.shape)
    found = parts.each(
        moved_part, parts.at(at), parts.of_weights(before.weights), parts.of_blocks(change)
    )
    lon_lat_h = joined(parts.points, found, "lon_lat_h")
    state = State(at.values + change, lon_lat_h, iterations + 1)
    return Solved(state, float(np.abs(change).max()), before, system)


def least_squares(
    parts: Parts, priors: BlockPriors, gauge: Gauge, first: Normals, iterations: int = 0
) -> Solved:
    """The solution of given weights, with the equations of its last step.

    A ray that cannot be computed stays out: a point at the limit of what a model is valid for would
    cross it with every step.

    Args:
        parts: of the block.
        priors: of the parameters.
        gauge: of the block.
        first: normal equations where it begins.
        iterations: done before.
    """
    before, options = first, parts.problem.options
    while True:
        solved = step(parts, priors, gauge, before, iterations)
        state, iterations = solved.state, solved.state.iterations
        if solved.change_px <= options.converged_px:
            return solved
        if iterations >= options.max_iterations:
            raise unsettled(parts.problem, solved.change_px, state)
        before = normals(parts, state.place, before.weights)


def point_covariances(
    parts: Parts, of: Normals, after: Place, accuracy: BlockAccuracy, group: IntArray
) -> tuple[Array, Array, Array]:
    """What least squares state of points.

    Args:
        parts: of the block.
        of: normal equations before the last step.
        after: the last step.
        accuracy: of the parameters.
        group: (p,) of the points.

    Returns:
        (p, 3, 3) what points take over from images, (p, 3, 3) with the covariance of their own rays,
        relative to the frames of their groups; (m, 2) residuals in units of the sigmas.
    """
    relative, followed = parts.of_pairs(accuracy.relative), parts.of_blocks(accuracy.followed)

    def frames_m2(number: int) -> Array:
        return accuracy.frames_m2(group[parts.points[number]])

    found = parts.each(
        carried_part,
        parts.at(of.at),
        parts.of_weights(of.weights),
        parts.at(after),
        lambda number: (relative(number), followed(number), frames_m2(number)),
    )
    carried_m2, relative_m2 = (joined(parts.points, found, key) for key in ("carried", "relative"))
    return carried_m2, relative_m2, joined(parts.observations, found, "residual")


def checked_gauge(parts: Parts, of: Normals, refuse: bool = True) -> Gauge:
    """The gauge of the groups; refuses groups that nothing holds together."""
    problem = parts.problem
    n = len(problem.images)
    group = connected_groups(parts.pairs, of.common, n)
    known = [np.isfinite(frame.covariance_m2).any() for frame in problem.control.frames]
    held = set(group[n:][np.array(known, dtype=np.bool_)]) | set(group[problem.common])
    number = int(group.max(initial=-1)) + 1
    if refuse and number > 1 and len(held) < number:
        names = [
            ", ".join(image.name for image, its in zip(problem.images, group, strict=False) if its == g)
            for g in range(number)
        ]
        raise DisconnectedBlock(
            f"the images fall into {number} groups without {MIN_COMMON} tie points between them: "
            f"{' | '.join(names)}. Make a block of each, or give control points to each"
        )
    deformable = np.zeros(problem.n_blocks, dtype=np.bool_)
    deformable[:n] = [image.deformable for image in problem.images]
    return block_gauge(group, of.own, of.followed, deformable, problem.sigma)


def unsettled(problem: BlockProblem, change_px: float, state: State) -> NoConvergence:
    return NoConvergence(
        f"the block of {len(problem.images)} images still moves by {change_px:.2g} px after "
        f"{state.iterations} iterations"
    )
