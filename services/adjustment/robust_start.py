"""Robust solution of a block in which up to a third of the observations may be wrong."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from amers.services.adjustment.block_parts import Parts, Place, Weights, joined, same
from amers.services.adjustment.block_problem import BlockProblem
from amers.services.adjustment.block_scale import (
    LEAST_SCALE,
    check_scale,
    low_scale,
    magnitude,
    robust_scale,
)
from amers.services.adjustment.block_solution import State, checked_gauge, normals, step, unsettled
from amers.services.adjustment.control_check import robust_control, robust_weights
from amers.services.adjustment.parameters import BlockPriors
from amers.services.adjustment.part_tasks import control_part, robust_part
from amers.services.errors import NotEnoughPoints
from amers.services.geodesy import move_metres
from amers.services.types import Array, BoolArray

_STAGE = "robust"
_NEARLY_PX = 0.02
"""Change of the parameters at which least squares take over."""


def robust_start(parts: Parts, priors: BlockPriors) -> tuple[State, float, BoolArray, BoolArray]:
    """The robust solution: state, scale of the observations, observations and control that agree.

    The scale of the Cauchy weights falls from what the images may be off to the smallest residuals, by
    half in every step, so that wrong observations lose their weight before images settle on them.

    Raises:
        NotEnoughPoints: too few points can be intersected.
        NoConsensus: the residuals are too large for the sigmas of the observations.
        NoConvergence: the parameters still change after the last iteration.
    """
    problem = parts.problem
    point = problem.observations.point
    state = State(problem.start_values(), problem.start())
    scale, change_px = _falling_scale(problem), np.inf
    falling = scale
    if (kept := parts.kept(_STAGE)) is not None:
        state = State(kept["values"], kept["lon_lat_h"], int(kept["iterations"]))
        change_px, falling = float(kept["change_px"]), float(kept["falling"])
        scale = float(kept["scale"])
    while True:
        rays = _robust_rays(parts, state.place, max(scale, falling))
        measured = np.where(problem.by_hand, np.nan, rays.square)
        scale = max(low_scale(measured, point, problem.ray_coordinates), LEAST_SCALE)
        weight = rays.weight / max(scale, falling) ** 2
        weight[problem.single_rays[0]] = robust_weights(rays.single)
        weights, near = _with_control(parts, rays.at, weight)
        if change_px <= _NEARLY_PX and falling <= scale:
            break
        if state.iterations == problem.options.max_iterations:
            raise unsettled(problem, change_px, state)
        before = normals(parts, rays.at, weights)
        gauge = checked_gauge(parts, before, refuse=False)
        solved = step(parts, priors, gauge, before, state.iterations)
        state, change_px = solved.state, solved.change_px
        falling *= 0.5
        parts.keep(_STAGE, **vars(state), change_px=change_px, falling=falling, scale=scale)
    scale = max(robust_scale(measured, point, problem.ray_coordinates), LEAST_SCALE)
    check_scale(scale)
    small = rays.square <= (problem.options.tolerance * problem.scales(scale)) ** 2
    active = active_observations(problem, rays.square, small, scale, near)
    return rays.state(state.iterations), scale, active, near


class _Rays(NamedTuple):
    """The robust intersections of all points.

    Attributes:
        at: where points were, and how far they have moved.
        weight: (m,) of the image positions, for a scale of one.
        square: (m,) of their residuals; NaN where unusable.
        single: (s,) sizes of the residuals of the only rays of known points.
    """

    at: Place
    weight: Array
    square: Array
    single: Array

    def state(self, iterations: int) -> State:
        """The state with the moved points."""
        step_m = np.zeros_like(self.at.lon_lat_h) if self.at.step_m is None else self.at.step_m
        return State(self.at.values, move_metres(self.at.lon_lat_h, step_m), iterations)


def _robust_rays(parts: Parts, at: Place, scale: float) -> _Rays:
    problem = parts.problem
    found = parts.each(robust_part, parts.at(at), same(scale))
    determined = joined(parts.points, found, "determined")
    _check_points(problem, int(determined.sum()))
    single = problem.single_rays[0]
    usable = determined[problem.observations.point]
    usable[single] = True
    square = joined(parts.observations, found, "square")
    return _Rays(
        at._replace(step_m=joined(parts.points, found, "step_m")),
        joined(parts.observations, found, "weight"),
        np.where(usable, square, np.nan),
        joined(parts.observations, found, "single")[single],
    )


def _with_control(parts: Parts, at: Place, weight: Array) -> tuple[Weights, BoolArray]:
    """Weights (m,) of image positions with those of the control, and whether it is near (c,)."""
    square = np.empty(0)
    if len(parts.problem.control):
        without = Weights(weight, np.zeros(len(parts.problem.control)))
        found = parts.each(control_part, parts.at(at), parts.of_weights(without))
        square = joined(parts.control, found, "square")
    of_control, near = robust_control(parts.problem, square)
    return Weights(weight, of_control), near


def started(parts: Parts, values: Array) -> State:
    """The state with known parameters (n, k) of the images, and points where most of their rays meet."""
    problem = parts.problem
    state = State(problem.start_values(), problem.start())
    state.values[: len(values), : values.shape[1]] = values
    found = parts.each(robust_part, parts.at(state.place), same(1.0))
    step_m = joined(parts.points, found, "step_m")
    return replace(state, lon_lat_h=move_metres(state.lon_lat_h, step_m))


def _falling_scale(problem: BlockProblem) -> float:
    """What images may be off, in units of the sigmas of the observations."""
    sigmas = np.concatenate([image.sigma[image.locating] for image in problem.images])
    observed_px = problem.observations.sigma_px
    return float(np.sqrt(np.mean(sigmas**2)) / np.median(observed_px)) if len(observed_px) else 1.0


def _check_points(problem: BlockProblem, determined: int) -> None:
    # A ray of a known point needs no second one.
    intersected = determined + len(problem.single_rays[0])
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
