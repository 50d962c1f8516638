"""The robust solution of a block, of which a third of the observations may be wrong."""

import numpy as np

from amers.services.adjustment.block_problem import BlockProblem
from amers.services.adjustment.block_scale import (
    LEAST_SCALE,
    check_scale,
    low_scale,
    magnitude,
    robust_scale,
)
from amers.services.adjustment.block_solution import State, checked_gauge, moved, step, unsettled
from amers.services.adjustment.control_check import robust_control, robust_single_rays
from amers.services.adjustment.normal_equations import RobustTerms, robust_points
from amers.services.adjustment.parameters import BlockPriors
from amers.services.errors import NotEnoughPoints
from amers.services.types import Array, BoolArray

_NEARLY_PX = 0.02
"""Change of the parameters at which least squares take over."""


def robust_start(
    problem: BlockProblem, priors: BlockPriors
) -> tuple[State, float, BoolArray, BoolArray]:
    """The robust solution: state, scale of the observations, observations and control that agree.

    The scale of the Cauchy weights falls from what the images may be off to the smallest residuals, by
    half in every step, so that wrong observations lose their weight before images settle on them.

    Raises:
        NotEnoughPoints: too few points can be intersected.
        NoConsensus: the residuals are too large for the sigmas of the observations.
        NoConvergence: the parameters still change after the last iteration.
    """
    point, n = problem.observations.point, len(problem.images)
    state = State(problem.start_values(), problem.start())
    scale, change_px = _falling_scale(problem), np.inf
    falling = scale
    alone = np.isin(np.arange(len(point)), problem.single_rays[0])
    while True:
        equations = problem.equations(state.values, state.lon_lat_h)
        step_m, weight = robust_points(equations, n, _terms(problem, state, max(scale, falling)))
        _check_points(problem, step_m)
        equations, state = moved(equations, state, step_m)
        square = problem.image_rows((equations.residual**2).sum(axis=1))
        square = np.where(np.isfinite(step_m[point, 0]) | alone, square, np.nan)
        measured = np.where(problem.by_hand, np.nan, square)
        scale = max(low_scale(measured, point, problem.ray_coordinates), LEAST_SCALE)
        weight = problem.image_rows(weight * (equations.weight > 0)) / max(scale, falling) ** 2
        weight[problem.single_rays[0]] = robust_single_rays(problem, state, equations)
        control_weight, near = robust_control(problem, equations, weight)
        if change_px <= _NEARLY_PX and falling <= scale:
            break
        if state.iterations == problem.options.max_iterations:
            raise unsettled(problem, change_px, state)
        equations = equations._replace(weight=problem.weights(weight, control_weight))
        gauge = checked_gauge(problem, equations, state.lon_lat_h, refuse=False)
        solved = step(problem, priors, gauge, state, equations)
        state, change_px = solved.state, solved.change_px
        falling *= 0.5
    scale = max(robust_scale(measured, point, problem.ray_coordinates), LEAST_SCALE)
    check_scale(scale)
    small = square <= (problem.options.tolerance * problem.scales(scale)) ** 2
    active = active_observations(problem, square, small, scale, near)
    return state, scale, active, near


def started(problem: BlockProblem, values: Array) -> State:
    """The state with known parameters (n, k) of the images, and points where most of their rays meet."""
    state = State(problem.start_values(), problem.start())
    state.values[: len(values), : values.shape[1]] = values
    equations = problem.equations(state.values, state.lon_lat_h)
    step_m, _ = robust_points(equations, len(problem.images), _terms(problem, state, 1.0))
    return moved(equations, state, step_m)[1]


def _falling_scale(problem: BlockProblem) -> float:
    """What images may be off, in units of the sigmas of the observations."""
    sigmas = np.concatenate([image.sigma[image.locating] for image in problem.images])
    observed_px = problem.observations.sigma_px
    return float(np.sqrt(np.mean(sigmas**2)) / np.median(observed_px)) if len(observed_px) else 1.0


def _terms(problem: BlockProblem, state: State, scale: float) -> RobustTerms:
    """The terms of a scale; known heights hold the points that ortho-images alone show."""
    known_m, variance_m2 = problem.known_heights
    held = problem.flat & np.isfinite(known_m)
    return RobustTerms(
        scale=scale,
        coordinates=problem.ray_coordinates,
        height_weight=np.where(held, scale**2 / np.where(held, variance_m2, 1.0), 0.0),
        height_step_m=np.where(held, known_m - state.lon_lat_h[:, 2], 0.0),
    )


def _check_points(problem: BlockProblem, step_m: Array) -> None:
    # A ray of a known point needs no second one.
    intersected = int(np.isfinite(step_m[:, 0]).sum()) + len(problem.single_rays[0])
    if intersected < problem.options.min_points:
        rays = np.bincount(problem.observations.point, minlength=problem.n_points)
        without = int((problem.flat & (rays >= 2) & np.isnan(problem.known_heights[0])).sum())
        explanation = f"tie points between {len(problem.images)} images"
        if without:
            explanation += (
                f"; {without} points that ortho-images alone show have no height: "
                "give an elevation model (--control-dem)"
            )
        raise NotEnoughPoints(intersected, problem.options.min_points, explanation)


def active_observations(
    problem: BlockProblem,
    square: Array,
    active: BoolArray,
    scale: float,
    control_active: BoolArray,
    *,
    coordinates: Array | None = None,
) -> BoolArray:
    """Observations (m,) within the tolerance, of points with two such rays, or one and a known position.

    A height alone does not check a ray. Every point has `coordinates` (p,) that its rays determine, by
    default those of points whose ground is not known.
    """
    point = problem.observations.point
    coordinates = problem.ray_coordinates if coordinates is None else coordinates
    size = magnitude(square, point, active, coordinates)
    within = np.nan_to_num(size, nan=np.inf) <= problem.options.tolerance * problem.scales(scale)
    rays = np.bincount(point[within], minlength=problem.n_points)
    places = problem.control.known[:, :2].all(axis=1)
    rays[problem.control.point[control_active & places]] += 1
    return np.asarray(within & (rays[point] >= 2))
