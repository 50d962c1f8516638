"""Outlier tests of control points: agreement with the block and with each other."""

import numpy as np
from numba import njit
from scipy.special import chdtri

from amers.services.adjustment.block_problem import BlockProblem
from amers.services.adjustment.normal_equations import Equations, Pairs, Points, eliminated, pair_row
from amers.services.errors import InputError
from amers.services.misfit.robust import CAUCHY_TUNING
from amers.services.tasks import Arrays
from amers.services.types import Array, BoolArray, IntArray

_AGREES = 0.9999
"""Probability with which a control point as good as stated stays."""

_NEAR = 2.0
"""Least squares begin with control points up to so many times that far; those that agree stay."""


def check_place_of_control(problem: BlockProblem, values: Array) -> None:
    """Refuse control points of another scene or instrument: they lie where an image cannot be.

    Args:
        problem: the block.
        values: (n, k) parameters to begin with.

    Raises:
        InputError: half of the known ground in an image is not where the model shows it, by more than
            its a priori accuracy makes credible.
    """
    known = np.full((problem.n_points, 3), np.nan)
    whole = problem.control.known.all(axis=1)
    known[problem.control.point[whole]] = problem.control.lon_lat_h[whole]
    for i, (image, rows) in enumerate(zip(problem.images, problem.rows_of_images, strict=True)):
        ground = known[problem.observations.point[rows]]
        seen = np.isfinite(ground[:, 0])
        if not (seen.any() and np.isfinite(image.credible_px)):
            continue
        shown = image.computed(values[i, : len(image.sigma)], ground[seen]).line_sample
        off_px = np.linalg.norm(shown - problem.observations.line_sample[rows[seen]], axis=1)
        beyond = ~(off_px <= image.credible_px)
        if 2 * beyond.sum() <= len(beyond):
            continue
        nearest = "by its model they lie outside the image, or far from it"
        if np.isfinite(off_px).any():
            nearest = f"its model shows them {np.nanmedian(off_px):,.0f} px away"
        raise InputError(
            f"{image.name}: {beyond.sum()} of {len(beyond)} control points are not where the image was "
            f"taken: {nearest}, {image.credible_px:,.0f} px is the most that the accuracy stated for it "
            "makes credible. Give the control points of this image and instrument, or state a larger "
            "accuracy of the image"
        )


def robust_control(problem: BlockProblem, square: Array) -> tuple[Array, BoolArray]:
    """Weights (c,) of control points while the block moves, and whether (c,) they are near the others.

    Misfits are relative to the sigmas of the known ground and of the rays, in units of their own median:
    frames may be far off at first.

    Args:
        problem: the block.
        square: (c,) of the misfits, `control_sizes`.
    """
    if not len(problem.control):
        return np.ones(0), np.ones(0, dtype=np.bool_)
    freedom = problem.control.known_coordinates()
    near = square <= chdtri(freedom, 1.0 - _AGREES) * _NEAR**2
    return robust_weights(np.sqrt(square / freedom)), near


def robust_weights(size: Array) -> Array:
    """Cauchy weights (s,) of sizes in units of their median: all may be far off at first."""
    if not len(size):
        return np.ones(0)
    scale = max(1.0, float(np.median(size)))
    return np.asarray(1.0 / (1.0 + (size / (CAUCHY_TUNING * scale)) ** 2) / scale**2)


def control_sizes(problem: BlockProblem, equations: Equations) -> Array:
    """Squares (c,) of the misfits of control points, in units of their sigmas and of those of the rays.

    Args:
        problem: the block.
        equations: at the current state, without weights of the control.
    """
    rays = eliminated(equations, problem.n_points).inverse[problem.control.point]
    # Points of one ray follow their known ground: they do not contradict it.
    rays = np.where(np.isfinite(rays), rays, 1e12 * np.eye(3))
    halves = problem.control_rows(equations.by_ground).reshape(-1, 4, 3)
    residual = problem.control_rows(equations.residual).reshape(-1, 4)
    spread = np.eye(4) + halves @ rays @ halves.transpose(0, 2, 1)
    return np.asarray((residual * np.linalg.solve(spread, residual[:, :, None])[:, :, 0]).sum(axis=1))


def single_ray_sizes(
    problem: BlockProblem, values: Array, lon_lat_h: Array, equations: Equations
) -> Array:
    """Sizes (s,) of the residuals of the only rays of known points (`BlockProblem.single_rays`).

    They are those at the known ground, in units of the sigmas of both.

    Args:
        problem: the block.
        values: (n, k) parameters.
        lon_lat_h: (p, 3) points.
        equations: there.
    """
    rows, known = problem.single_rays
    if not len(rows):
        return np.empty(0)
    row = problem.place[rows]
    misfit_m = problem.control_misfit_m(values, lon_lat_h)[known]
    by_ground = equations.by_ground[row]
    residual = equations.residual[row] - (by_ground @ misfit_m[:, :, None])[:, :, 0]
    ground_m2 = problem.control.covariance_m2[known]
    spread = np.eye(2) + by_ground @ ground_m2 @ by_ground.transpose(0, 2, 1)
    square = (residual * np.linalg.solve(spread, residual[:, :, None])[:, :, 0]).sum(axis=1)
    return np.asarray(np.sqrt(square / 2.0))


def ray_coordinates(problem: BlockProblem, equations: Equations, points: Points) -> Array:
    """Coordinates (p,) of every point that its rays determine: 3, less where its ground is known.

    Known ground determines the rest, and the residuals of the rays are as much larger.
    """
    coordinates = np.full(problem.n_points, 3.0)
    by_ground = problem.control_rows(equations.by_ground).reshape(-1, 4, 3)
    weight = problem.control_rows(equations.weight)[:, 0]
    inverse = points.inverse[problem.control.point]
    known = weight * np.einsum("cra,cab,crb->c", by_ground, inverse, by_ground)
    np.subtract.at(coordinates, problem.control.point, np.nan_to_num(known))
    return coordinates


def predicted_control(
    problem: BlockProblem, equations: Equations, points: Points, pairs: Pairs, covariance: Array
) -> Arrays:
    """What the solution tells of every control point.

    Args:
        problem: the block.
        equations: at the solution.
        points: eliminated from them.
        pairs: of blocks that have a point in common.
        covariance: (s, k, k) of their parameters.

    Returns:
        Its `halves` (c, 4, 3) and `residual` (c, 4) in units of its sigmas, and the `predicted`
        covariance (c, 3, 3) of its computed ground with the error of its frame.
    """
    place = np.column_stack([problem.control.point, len(problem.images) + problem.control.source])
    return {
        "halves": problem.control_rows(equations.by_ground).reshape(-1, 4, 3),
        "residual": problem.control_rows(equations.residual).reshape(-1, 4),
        "predicted": _predicted_covariance(equations, points, pairs, covariance, place),
    }


def agreeing_control(freedom: IntArray, told: Arrays, active: BoolArray) -> BoolArray:
    """The control points (c,) that agree, after the worst has left or the best has come back.

    The misfit of a point is judged by its own covariance and by that of what all others predict: a point
    that takes part has drawn the block towards itself.

    Args:
        freedom: (c,) known coordinates of each.
        told: what the solution tells of each, `predicted_control`.
        active: (c,) that took part in the solution.
    """
    if not len(active):
        return active
    halves, residual, predicted = told["halves"], told["residual"], told["predicted"]
    limit = chdtri(freedom, 1.0 - _AGREES)
    ratio = np.full(len(active), np.inf)
    for i in range(len(active)):
        fitted = halves[i] @ predicted[i] @ halves[i].T
        if not np.isfinite(fitted).all():
            continue
        spread = np.eye(4) - fitted if active[i] else np.eye(4) + fitted
        values, vectors = np.linalg.eigh(spread)
        # What nothing else predicts cannot be checked.
        checked = values > 1e-6
        part = vectors[:, checked].T @ residual[i]
        ratio[i] = float((part**2 / values[checked]).sum()) / limit[i]
    out = active.copy()
    worst = int(np.argmax(np.where(active, ratio, -np.inf)))
    best = int(np.argmin(np.where(active, np.inf, ratio)))
    if active[worst] and ratio[worst] > 1.0:
        out[worst] = False
    elif not active[best] and ratio[best] < 1.0:
        out[best] = True
    return out


@njit(cache=True)
def _predicted_covariance(
    equations: Equations,
    points: Points,
    pairs: Pairs,
    covariance: Array,
    place: IntArray,
) -> Array:
    """Covariance (c, 3, 3) of the computed ground of control points with the errors of their frames.

    `place` (c, 2) are the points, and the blocks of parameters of their frames.
    """
    k = equations.by_parameters.shape[2]
    out = np.empty((len(place), 3, 3))
    for c in range(len(place)):
        p = place[c, 0]
        first = np.searchsorted(equations.point, p)
        last = np.searchsorted(equations.point, p, side="right")
        by_block = np.zeros((last - first + 1, 3, k))
        block = np.empty(last - first + 1, dtype=np.int64)
        for i in range(first, last):
            w = equations.weight[i]
            block[i - first] = equations.block[i]
            if w > 0.0:
                cross = equations.by_ground[i].T @ equations.by_parameters[i]
                by_block[i - first] = -w * (points.inverse[p] @ cross)
        block[last - first] = place[c, 1]
        for a in range(3):
            by_block[last - first, a, a] = 1.0
        total = points.inverse[p].copy()
        for i in range(len(block)):
            for j in range(len(block)):
                of_pair = covariance[pair_row(pairs, block[i], block[j])]
                if block[i] <= block[j]:
                    total += by_block[i] @ of_pair @ by_block[j].T
                else:
                    total += by_block[i] @ of_pair.T @ by_block[j].T
        out[c] = total
    return out
