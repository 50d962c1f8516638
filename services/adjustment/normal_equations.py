"""Compiled normal equations of a block: points are eliminated; images and their pairs remain."""

from typing import NamedTuple

import numpy as np
from numba import njit

from amers.services.misfit.robust import CAUCHY_TUNING
from amers.services.types import Array, IntArray

_SINGULAR = 1e-13
_PARALLEL = 1e-8
"""Determinant of a normal matrix of unit trace below which two rays do not choose between others."""


class Equations(NamedTuple):
    """Observation equations at the current parameters and points, in units of standard deviations.

    Attributes:
        point, block: (m,) the point and the block of parameters of every observation; points ascending.
        residual: (m, 2) observed minus computed.
        by_ground: (m, 2, 3) derivatives by metres east, north, up.
        by_parameters: (m, 2, k).
        weight: (m,) 0 for observations that do not count.
    """

    point: IntArray
    block: IntArray
    residual: Array
    by_ground: Array
    by_parameters: Array
    weight: Array


class Points(NamedTuple):
    """The part of the normal equations that concerns each point alone.

    Attributes:
        inverse: (p, 3, 3) inverse normal matrices; NaN where a point is undetermined.
        right: (p, 3) right sides.
    """

    inverse: Array
    right: Array


@njit(cache=True)
def _invert(n: Array, limit: float) -> bool:
    """Invert a symmetric (3, 3) matrix in place, unless it is nearly singular."""
    scale = n[0, 0] + n[1, 1] + n[2, 2]
    if not scale > 0.0:
        return False
    a, b, c = n[0, 0] / scale, n[0, 1] / scale, n[0, 2] / scale
    d, e, f = n[1, 1] / scale, n[1, 2] / scale, n[2, 2] / scale
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    if not determinant > limit:
        return False
    one = 1.0 / (determinant * scale)
    n[0, 0], n[1, 1], n[2, 2] = (d * f - e * e) * one, (a * f - c * c) * one, (a * d - b * b) * one
    n[0, 1] = n[1, 0] = (c * e - b * f) * one
    n[0, 2] = n[2, 0] = (b * e - c * d) * one
    n[1, 2] = n[2, 1] = (b * c - a * e) * one
    return True


@njit(cache=True)
def _add(normal: Array, right: Array, derivative: Array, residual: Array, weight: float) -> None:
    for a in range(3):
        for r in range(2):
            scaled = weight * derivative[r, a]
            right[a] += scaled * residual[r]
            for b in range(3):
                normal[a, b] += scaled * derivative[r, b]


class RobustTerms(NamedTuple):
    """How points are intersected robustly, and the prior of heights that rays do not determine.

    Attributes:
        scale: of the Cauchy weights, in sigmas of the observations.
        coordinates: (p,) that the rays of every point determine: 2 or 3.
        height_weight: (p,) of the known height, beside rays of weight one; 0 where it is not needed.
        height_step_m: (p,) known minus present height.
    """

    scale: float
    coordinates: Array
    height_weight: Array
    height_step_m: Array


@njit(cache=True)
def robust_points(equations: Equations, n_images: int, terms: RobustTerms) -> tuple[Array, Array]:
    """Step (p, 3) of every point to where most of its rays intersect, and robust weights (m,).

    Every two rays of a point propose a position, and the one with the smallest Cauchy cost over all rays
    wins: with three rays or more a wrong one does not move the point. Re-weighted least squares from
    there give the weights, relative to what three unknowns leave of the residuals. Rows that are not of
    images do not count. A step is NaN where fewer than two rays are usable, or none intersect, or where
    they tell no height and none is known.
    """
    step = np.full((len(terms.height_weight), 3), np.nan)
    weight = np.where(equations.weight > 0.0, 1.0, 0.0)
    usable = (equations.weight > 0.0) & (equations.block < n_images)
    best = np.empty(3)
    first = 0
    for last in range(1, len(equations.point) + 1):
        if last < len(equations.point) and equations.point[last] == equations.point[first]:
            continue
        rays = np.flatnonzero(usable[first:last]) + first
        if len(rays) >= 2:
            held = terms.coordinates[equations.point[first]] == 3.0
            held = held or terms.height_weight[equations.point[first]] > 0.0
            if held and _best_pair(equations, rays, terms, best):
                _reweight(equations, rays, terms, best, weight)
                step[equations.point[first]] = best
            else:
                weight[rays] = 0.0
        first = last
    return step, weight


@njit(cache=True)
def _best_pair(equations: Equations, rays: IntArray, terms: RobustTerms, best: Array) -> bool:
    """Fill in the step (3,) that two rays propose and all like best; False where no two intersect."""
    normal, right, x = np.empty((3, 3)), np.empty(3), np.empty(3)
    lowest, point = np.inf, equations.point[rays[0]]
    limit = _PARALLEL if len(rays) > 2 else _SINGULAR
    for i in range(0, len(rays), 1 + len(rays) // 12):
        for j in range(i + 1, len(rays)):
            normal[:] = 0.0
            right[:] = 0.0
            normal[2, 2] = terms.height_weight[point]
            right[2] = terms.height_weight[point] * terms.height_step_m[point]
            for ray in (rays[i], rays[j]):
                _add(normal, right, equations.by_ground[ray], equations.residual[ray], 1.0)
            if not _invert(normal, limit):
                continue
            _multiply(normal, right, x)
            cost = 0.0
            for ray in rays:
                square = _square(equations.residual[ray], equations.by_ground[ray], x)
                cost += np.log1p(square / terms.scale**2)
            if cost < lowest:
                lowest = cost
                best[:] = x
    return lowest < np.inf


@njit(cache=True)
def _multiply(matrix: Array, vector: Array, out: Array) -> None:
    for a in range(3):
        out[a] = matrix[a, 0] * vector[0] + matrix[a, 1] * vector[1] + matrix[a, 2] * vector[2]


@njit(cache=True)
def _square(residual: Array, derivative: Array, x: Array) -> float:
    total = 0.0
    for r in range(2):
        v = residual[r] - derivative[r, 0] * x[0] - derivative[r, 1] * x[1] - derivative[r, 2] * x[2]
        total += v * v
    return total


@njit(cache=True)
def _reweight(equations: Equations, rays: IntArray, terms: RobustTerms, x: Array, weight: Array) -> None:
    """Re-weighted least squares of one point from a start, which moves; its weights are filled in."""
    normal, right = np.empty((3, 3)), np.empty(3)
    effective, point = float(len(rays)), equations.point[rays[0]]
    for _ in range(6):
        free = 2.0 * effective - terms.coordinates[point]
        reach = free / effective * (CAUCHY_TUNING * terms.scale) ** 2
        effective = 0.0
        normal[:] = 0.0
        right[:] = 0.0
        normal[2, 2] = terms.height_weight[point]
        right[2] = terms.height_weight[point] * terms.height_step_m[point]
        for ray in rays:
            square = _square(equations.residual[ray], equations.by_ground[ray], x)
            weight[ray] = 1.0 / (1.0 + square / reach)
            effective += weight[ray]
            _add(normal, right, equations.by_ground[ray], equations.residual[ray], weight[ray])
        effective = max(effective, 2.0)
        if not _invert(normal, _SINGULAR):
            break
        _multiply(normal, right, x)


@njit(cache=True)
def eliminated(equations: Equations, n_points: int) -> Points:
    """The normal equations of every point alone, solved."""
    own = np.zeros((n_points, 3, 3))
    right = np.zeros((n_points, 3))
    for i in range(len(equations.point)):
        p = equations.point[i]
        if equations.weight[i] > 0.0:
            _add(own[p], right[p], equations.by_ground[i], equations.residual[i], equations.weight[i])
    for p in range(n_points):
        if not _invert(own[p], _SINGULAR):
            own[p] = np.nan
    return Points(own, right)


class Pairs(NamedTuple):
    """The pairs of blocks of parameters that have a point in common, and every block with itself.

    Attributes:
        start: (n + 1,) rows of `other` where the pairs of every block begin.
        other: (s,) the second block of each pair, ascending, not smaller than the first.
    """

    start: IntArray
    other: IntArray


def seen_pairs(point: IntArray, block: IntArray, n_blocks: int) -> Pairs:
    """The pairs of a list of observations."""
    alone = np.arange(n_blocks) * (n_blocks + 1)
    keys = np.unique(np.concatenate([alone, common_pairs(point, block, n_blocks)[0]]))
    start = np.searchsorted(keys, np.arange(n_blocks + 1) * n_blocks)
    return Pairs(start.astype(np.int64), keys % n_blocks)


def common_pairs(point: IntArray, block: IntArray, n_blocks: int) -> tuple[IntArray, IntArray]:
    """Keys (s,), first times n plus second, of pairs of rows of one point, and how many (s,) of each."""
    if not len(point):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    keys, counts = np.unique(_pair_keys(point, block, n_blocks), return_counts=True)
    return keys, counts.astype(np.int64)


@njit(cache=True)
def _pair_keys(point: IntArray, block: IntArray, n_blocks: int) -> IntArray:
    count, first = 0, 0
    for i in range(len(point)):
        if point[i] != point[first]:
            first = i
        count += i - first + 1
    keys = np.empty(count, dtype=np.int64)
    at, first = 0, 0
    for i in range(len(point)):
        if point[i] != point[first]:
            first = i
        for j in range(first, i + 1):
            keys[at] = min(block[i], block[j]) * n_blocks + max(block[i], block[j])
            at += 1
    return keys


@njit(cache=True)
def pair_row(pairs: Pairs, a: int, b: int) -> int:
    """Row of the pair of two blocks."""
    if a > b:
        a, b = b, a
    low, high = pairs.start[a], pairs.start[a + 1]
    while high - low > 1:
        middle = (low + high) // 2
        if pairs.other[middle] <= b:
            low = middle
        else:
            high = middle
    return int(low)


@njit(cache=True)
def reduced(equations: Equations, points: Points, pairs: Pairs) -> tuple[Array, Array]:
    """Normal matrix (s, k, k) of pairs and right side (n, k) of the parameters, points eliminated."""
    k = equations.by_parameters.shape[2]
    values = np.zeros((len(pairs.other), k, k))
    right = np.zeros((len(pairs.start) - 1, k))
    across, through = np.empty((len(equations.point), k, 3)), np.empty((k, 3))
    first = 0
    for i in range(len(equations.point)):
        if equations.point[i] != equations.point[first]:
            first = i
        w, p, a = equations.weight[i], equations.point[i], equations.block[i]
        if w == 0.0 or np.isnan(points.inverse[p, 0, 0]):
            continue
        design = equations.by_parameters[i]
        _add_parameters(values[pair_row(pairs, a, a)], right[a], design, equations.residual[i], w)
        for q in range(k):
            for c in range(3):
                of_ground = equations.by_ground[i]
                across[i, q, c] = w * (design[0, q] * of_ground[0, c] + design[1, q] * of_ground[1, c])
            _multiply(points.inverse[p], across[i, q], through[q])
            for c in range(3):
                right[a, q] -= through[q, c] * points.right[p, c]
        for j in range(first, i + 1):
            if equations.weight[j] > 0.0:
                b = equations.block[j]
                _subtract_pair(values[pair_row(pairs, a, b)], through, across[j], b - a, j < i)
    return values, right


@njit(cache=True)
def _add_parameters(normal: Array, right: Array, design: Array, residual: Array, weight: float) -> None:
    for q in range(len(right)):
        for r in range(2):
            scaled = weight * design[r, q]
            right[q] += scaled * residual[r]
            for s in range(len(right)):
                normal[q, s] += scaled * design[r, s]


@njit(cache=True)
def _subtract_pair(normal: Array, through: Array, across: Array, order: int, two_rows: bool) -> None:
    """What two rows of a point take from the block of their images, which lie `order` apart."""
    for q in range(len(through)):
        for s in range(len(through)):
            part = 0.0
            for c in range(3):
                part += through[q, c] * across[s, c]
            if order >= 0:
                normal[q, s] -= part
            if order < 0 or (order == 0 and two_rows):
                normal[s, q] -= part


@njit(cache=True)
def moved_points(equations: Equations, points: Points, change: Array) -> Array:
    """Steps (p, 3) of the points, metres, for steps (n, k) of the parameters."""
    right = points.right.copy()
    for i in range(len(equations.point)):
        w = equations.weight[i]
        if w == 0.0:
            continue
        for r in range(2):
            moved = 0.0
            for q in range(change.shape[1]):
                moved += equations.by_parameters[i, r, q] * change[equations.block[i], q]
            for c in range(3):
                right[equations.point[i], c] -= w * equations.by_ground[i, r, c] * moved
    step = np.empty_like(right)
    for p in range(len(right)):
        step[p] = points.inverse[p] @ right[p]
    return step


@njit(cache=True)
def shared_covariance(
    equations: Equations, points: Points, pairs: Pairs, covariance: Array, move: Array
) -> tuple[Array, Array]:
    """What points take over from the parameters.

    Args:
        equations: at the solution.
        points: eliminated from them.
        pairs: of blocks that have a point in common.
        covariance: (s, k, k) of their parameters.
        move: (n k, 3) change of the parameters when their group moves by a metre east, north, up.

    Returns:
        (p, 3, 3) what the covariance adds to that of every point, and (p, 3, 3) how far every point goes
        when its group moves: nearly the unit matrix.
    """
    k = equations.by_parameters.shape[2]
    added, carried = np.zeros_like(points.inverse), np.zeros_like(points.inverse)
    by_block = np.zeros((len(equations.point), 3, k))
    first = 0
    for i in range(len(equations.point)):
        if equations.point[i] != equations.point[first]:
            first = i
        w, p = equations.weight[i], equations.point[i]
        if w == 0.0:
            continue
        by_block[i] = points.inverse[p] @ (equations.by_ground[i].T @ equations.by_parameters[i]) * w
        a = equations.block[i] * k
        carried[p] += by_block[i] @ move[a : a + k]
        for j in range(first, i + 1):
            if equations.weight[j] == 0.0:
                continue
            b = equations.block[j]
            of_pair = covariance[pair_row(pairs, equations.block[i], b)]
            if equations.block[i] <= b:
                part = by_block[i] @ of_pair @ by_block[j].T
            else:
                part = by_block[i] @ of_pair.T @ by_block[j].T
            added[p] += part
            if j < i:
                added[p] += part.T
    return added, carried
