"""Gauss-Newton steps of a block with its points eliminated."""

from dataclasses import dataclass, replace

import numpy as np

from amers.services.adjustment.block_gauge import MIN_COMMON, Gauge, block_gauge, connected_groups
from amers.services.adjustment.block_problem import BlockProblem
from amers.services.adjustment.normal_equations import (
    Equations,
    Points,
    eliminated,
    moved_points,
    reduced,
)
from amers.services.adjustment.parameters import BlockPriors
from amers.services.adjustment.reduced_system import ReducedSystem, reduced_system
from amers.services.errors import DisconnectedBlock, NoConvergence
from amers.services.geodesy import move_metres
from amers.services.types import Array

_FARTHEST_M = 2000.0
"""Longest step of a point: rays that are nearly parallel promise more."""


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


@dataclass(frozen=True)
class Solved:
    """A step, with the equations it was computed from.

    Attributes:
        state: after the step.
        change_px: largest change of a parameter.
        equations, points, system: before it.
    """

    state: State
    change_px: float
    equations: Equations
    points: Points
    system: ReducedSystem


def step(
    problem: BlockProblem, priors: BlockPriors, gauge: Gauge, state: State, equations: Equations
) -> Solved:
    """One Gauss-Newton step with the points eliminated."""
    points = eliminated(equations, problem.n_points)
    values, right = reduced(equations, points, problem.pairs)
    if problem.tie is not None:
        # The neighbour has used what common images observe of points that they see together.
        among = equations._replace(weight=equations.weight * problem.common[equations.block])
        told = reduced(among, eliminated(among, problem.n_points), problem.pairs)
        values, right = values - told[0], right - told[1]
        priors = problem.tie.priors(priors, gauge.move)
    system = reduced_system(values, problem.pairs, priors, gauge)
    right_side = system.right_side(right.ravel(), state.values.ravel())
    change = system.solve(right_side).reshape(state.values.shape)
    step_m = np.clip(np.nan_to_num(moved_points(equations, points, change)), -_FARTHEST_M, _FARTHEST_M)
    state = State(state.values + change, move_metres(state.lon_lat_h, step_m), state.iterations + 1)
    return Solved(state, float(np.abs(change).max()), equations, points, system)


def least_squares(
    problem: BlockProblem, priors: BlockPriors, gauge: Gauge, state: State, weight: Array
) -> Solved:
    """The solution of given weights, with the equations of its last step.

    A ray that cannot be computed stays out: a point at the limit of what a model is valid for would
    cross it with every step.
    """
    while True:
        equations = problem.equations(state.values, state.lon_lat_h, weight)
        solved = step(problem, priors, gauge, state, equations)
        state, weight = solved.state, equations.weight
        if solved.change_px <= problem.options.converged_px:
            return solved
        if state.iterations >= problem.options.max_iterations:
            raise unsettled(problem, solved.change_px, state)


def moved(equations: Equations, state: State, step_m: Array) -> tuple[Equations, State]:
    """The equations and the state after steps (p, 3) of the points; NaN leaves a point where it is."""
    step_m = np.clip(np.nan_to_num(step_m), -_FARTHEST_M, _FARTHEST_M)
    moved = np.einsum("mrc,mc->mr", equations.by_ground, step_m[equations.point])
    state = replace(state, lon_lat_h=move_metres(state.lon_lat_h, step_m))
    return equations._replace(residual=equations.residual - moved), state


def checked_gauge(
    problem: BlockProblem, equations: Equations, lon_lat_h: Array, refuse: bool = True
) -> Gauge:
    """The gauge of the groups; refuses groups that nothing holds together."""
    n = len(problem.images)
    group = connected_groups(equations, n, problem.n_blocks)
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
    return block_gauge(equations, group, lon_lat_h, deformable, problem.sigma)


def unsettled(problem: BlockProblem, change_px: float, state: State) -> NoConvergence:
    return NoConvergence(
        f"the block of {len(problem.images)} images still moves by {change_px:.2g} px after "
        f"{state.iterations} iterations"
    )
