"""Tasks on the equations of one part of a block, for any process: arrays in, arrays out."""

from typing import Any

import numpy as np

from amers.services.adjustment.block_accuracy import carried_covariances
from amers.services.adjustment.block_gauge import followed_ground
from amers.services.adjustment.block_parts import Part, Place, Weights
from amers.services.adjustment.block_problem import BlockProblem
from amers.services.adjustment.control_check import (
    control_sizes,
    predicted_control,
    ray_coordinates,
    single_ray_sizes,
)
from amers.services.adjustment.normal_equations import (
    Equations,
    Points,
    RobustTerms,
    common_pairs,
    eliminated,
    moved_points,
    reduced,
    robust_points,
)
from amers.services.geodesy import longitudes_near, move_metres
from amers.services.tasks import Arrays
from amers.services.types import Array

_FARTHEST_M = 2000.0
"""Longest step of a point: rays that are nearly parallel promise more."""


def robust_part(part: Part, at: Place, scale: float) -> Arrays:
    """Points where most of their rays intersect, for Cauchy weights of a scale.

    Returns:
        `step_m` (p, 3) of the points, and whether each is `determined` (p,). For image positions: robust
        `weight` (m,), `square` (m,) of the residuals, and `single` (m,), the
        size of the residual where the position is the only ray of a known point, 0 elsewhere.
    """
    problem = part.problem
    equations = problem.equations(at.values, at.lon_lat_h)
    step_m, weight = robust_points(equations, len(problem.images), _terms(problem, at, scale))
    determined = np.isfinite(step_m[:, 0])
    step_m = _held(step_m)
    at = at._replace(step_m=step_m)
    equations = _linear(equations, at)
    single = np.zeros(len(problem.observations))
    single[problem.single_rays[0]] = single_ray_sizes(problem, at.values, _moved(at), equations)
    return {
        "step_m": step_m,
        "determined": determined,
        "weight": problem.image_rows(weight * (equations.weight > 0)),
        "square": problem.image_rows((equations.residual**2).sum(axis=1)),
        "single": single,
    }


def control_part(part: Part, at: Place, weights: Weights) -> Arrays:
    """`square` (c,) of the misfits of control points to the rays alone, in units of their sigmas."""
    without = weights._replace(control=np.zeros(len(part.problem.control)))
    equations = _equations(part, at, without)
    return {"square": control_sizes(part.problem, equations)}


def normal_part(part: Part, at: Place, weights: Weights, extent: Array) -> Arrays:
    """The normal equations of the parameters, points eliminated, and sums for the gauge.

    Args:
        part: of a block.
        at: where.
        weights: of its rows.
        extent: (2, 2) middle and size of the block, degrees.

    Returns:
        For pairs: `normal` (s, k, k), and `common` (s,), the number of their common observations. For
        blocks of parameters: the right side `right` (n, k), and the sums for the gauge, `own` (n, k, k)
        and `followed` (n, k, 9). Flags: `determined` (p,) of points, and `observations` (m,) and
        `control` (c,) of rows that could be computed.
    """
    problem = part.problem
    equations, points = _solved(part, at, weights)
    normal, right = reduced(equations, points, part.pairs)
    if part.common.any():
        # The neighbour has used what common images observe of points that they see together.
        among = equations._replace(weight=equations.weight * part.common[equations.block])
        told = reduced(among, eliminated(among, problem.n_points), part.pairs)
        normal, right = normal - told[0], right - told[1]
    used = equations.weight > 0.0
    place = _moved(at)[equations.point, :2]
    place[:, 0] = longitudes_near(place[:, 0], extent[0, 0])
    place = np.where(used[:, None], (place - extent[0]) / extent[1], 0.0)
    own, followed = followed_ground(equations, place, problem.n_blocks)
    return {
        "normal": normal,
        "right": right,
        "common": _common(part, equations),
        "own": own,
        "followed": followed,
        "determined": np.isfinite(points.inverse[:, 0, 0]),
        "observations": problem.image_rows(used),
        "control": np.asarray(problem.control_rows(used).all(axis=1)),
    }


def moved_part(part: Part, at: Place, weights: Weights, change: Array) -> Arrays:
    """Points `lon_lat_h` (p, 3) after a change (n, k) of the parameters."""
    equations, points = _solved(part, at, weights)
    step_m = _held(moved_points(equations, points, change))
    return {"lon_lat_h": move_metres(_moved(at), step_m)}


def judged_part(
    part: Part, at: Place, weights: Weights, after: Place, covariance: Array | None
) -> Arrays:
    """Residuals of the observations, and of control points, after the last step of least squares.

    Args:
        part: of a block.
        at: before the last step.
        weights: of its rows.
        after: the last step.
        covariance: (s, k, k) of the parameters of pairs; None without control.

    Returns:
        `square` (m,) of the residuals; coordinates (p,) that `rays` determine; and of control points
        their `halves`, `residual` and `predicted` covariance.
    """
    problem = part.problem
    equations, points = _solved(part, at, weights)
    judged: Arrays = {
        "square": problem.squares(after.values, after.lon_lat_h),
        "rays": ray_coordinates(problem, equations, points),
    }
    if covariance is None:
        return judged
    return {**judged, **predicted_control(problem, equations, points, part.pairs, covariance)}


def carried_part(
    part: Part,
    at: Place,
    weights: Weights,
    after: Place,
    accuracy: tuple[Array, Array, Array],
) -> Arrays:
    """Covariances of points relative to their frames, and the residuals that are left.

    Args:
        part: of a block.
        at: before the last step.
        weights: of its rows.
        after: the last step.
        accuracy: (s, k, k) of the parameters of pairs for exact frames, (n, k, 3) their change when
            their group moves by a metre, and (p, 3, 3) of the frames of the points.

    Returns:
        `carried` (p, 3, 3) from the images; `relative` (p, 3, 3) with that of the points' own rays, NaN
        where a point is not determined; `residual` (m, 2) in units of the sigmas.
    """
    problem = part.problem
    equations, points = _solved(part, at, weights)
    carried = carried_covariances(equations, points, part.pairs, accuracy)
    residual = problem.equations(after.values, after.lon_lat_h).residual
    return {
        "carried": carried,
        "relative": points.inverse + carried,
        "residual": problem.image_rows(residual),
    }


def _solved(part: Part, at: Place, weights: Weights) -> tuple[Equations, Points]:
    """Equations, and points eliminated from them; those of a block of one part are computed once."""
    given = (*at, *weights)
    if part.last and all(map(_same, part.last["given"], given)):
        return part.last["equations"], part.last["points"]
    equations = _equations(part, at, weights)
    points = eliminated(equations, part.problem.n_points)
    if part.last is not None:
        part.last.update(given=given, equations=equations, points=points)
    return equations, points


def _same(one: Array | None, other: Array | None) -> bool:
    if one is None or other is None:
        return one is other
    return np.array_equal(one, other, equal_nan=True)


def _equations(part: Part, at: Place, weights: Weights) -> Equations:
    weight = part.problem.weights(weights.observations, weights.control)
    return _linear(part.problem.equations(at.values, at.lon_lat_h, weight), at)


def _linear(equations: Equations, at: Place) -> Equations:
    if at.step_m is None:
        return equations
    moved = np.einsum("mrc,mc->mr", equations.by_ground, at.step_m[equations.point])
    return equations._replace(residual=equations.residual - moved)


def _moved(at: Place) -> Array:
    return at.lon_lat_h if at.step_m is None else move_metres(at.lon_lat_h, at.step_m)


def _held(step_m: Array) -> Array:
    """Steps that are not too long; 0 where a point cannot be computed."""
    return np.clip(np.nan_to_num(step_m), -_FARTHEST_M, _FARTHEST_M)


def _common(part: Part, equations: Equations) -> Any:
    used = equations.weight > 0.0
    n = part.problem.n_blocks
    keys, counts = common_pairs(equations.point[used], equations.block[used], n)
    out = np.zeros(len(part.pairs.other), dtype=np.int64)
    first = np.repeat(np.arange(n), np.diff(part.pairs.start))
    out[np.searchsorted(first * n + part.pairs.other, keys)] = counts
    return out


def _terms(problem: BlockProblem, at: Place, scale: float) -> RobustTerms:
    """The terms of a scale; known heights hold the points that ortho-images alone show."""
    known_m, variance_m2 = problem.known_heights
    held = problem.flat & np.isfinite(known_m)
    return RobustTerms(
        scale=scale,
        coordinates=problem.ray_coordinates,
        height_weight=np.where(held, scale**2 / np.where(held, variance_m2, 1.0), 0.0),
        height_step_m=np.where(held, known_m - at.lon_lat_h[:, 2], 0.0),
    )
