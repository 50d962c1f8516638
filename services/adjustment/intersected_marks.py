"""Intersection of marks in images with model errors: positions, covariances, and wrong marks.

A model is off by an error that all points of its image share. It is solved for as a shift of the image
with the a priori covariance of the model, together with all points: so it stays in the covariance of
each point, and does not hide marks that disagree with the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from amers.services.adjustment.intersection import intersect, residuals_and_derivatives
from amers.services.geodesy import ecef_from_east_north_up, move_metres
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, BoolArray, IntArray, Observations

_STEPS = 4
_FALSE_ALARM = 1e-3
"""Chance that a file of correct marks has one that is rejected: the limit that reports of networks use
(Baarda, 1968, A testing procedure for use in geodetic networks)."""
_LIKELY = 6.0
"""Difference of test values of two marks of a point below which either may be the wrong one: the odds
are 20 to 1."""
_FEWEST_SCALED = 5
"""Points of three marks from which the scale of the errors is estimated: fewer may all be wrong."""
_ROUND_SHARE = 0.25
"""Marks with a test value below this share of the largest one wait for the next round: what is wrong
moves what is right."""


@dataclass(frozen=True)
class ModelErrors:
    """Errors of the model of one image, relative to those of the others.

    Attributes:
        shift_px2: (2, 2) covariance of the error that all points of the image share; zero for a model
            that is taken as exact.
        local_px: (2,) standard deviation of what parts of the image are off by beyond it.
    """

    shift_px2: Array
    local_px: Array


EXACT_MODEL = ModelErrors(np.zeros((2, 2)), np.zeros(2))


@dataclass(frozen=True)
class IntersectedMarks:
    """n points from m marks in k images.

    Attributes:
        lon_lat_h: (n, 3); NaN where a point has fewer than two marks that agree, or parallel rays.
        marks_m2: (n, 3, 3) covariance of east, north, up by the errors of the marks alone.
        joint_m2: (n, 3, 3) with the errors of the models.
        residual_px: (m, 2) observed minus computed, with the shifts of the images.
        test: (m,) square of the residual, normalised by its own covariance; NaN where it has none.
        used: (m,) whether the mark is used: not rejected, and of a point with a position.
        rejected: (m,) whether the mark disagrees with two others or more of its point.
        alternative: (m,) int64, for a rejected mark: another one of its point that may be wrong in its
            place; -1 for none.
        disagree: (n,) whether two marks disagree, of which nothing shows which one is wrong.
        base_to_height: (n,) largest base over height of two marks.
        shift_px: (k, 2) shifts of the images, within the errors of their models.
        scale: residuals over what is stated of marks and models; NaN without redundancy.
        freedom: redundant coordinates, from which the scale is.
    """

    lon_lat_h: Array
    marks_m2: Array
    joint_m2: Array
    residual_px: Array
    test: Array
    used: BoolArray
    rejected: BoolArray
    alternative: IntArray
    disagree: BoolArray
    base_to_height: Array
    shift_px: Array
    scale: float
    freedom: int

    @property
    def found(self) -> BoolArray:
        """Which points (n,) have a position."""
        return np.asarray(np.isfinite(self.lon_lat_h).all(axis=1))

    @property
    def scale_chance(self) -> float:
        """Probability of a scale as far from 1, if what is stated is true; NaN without redundancy."""
        if self.freedom <= 0:
            return float("nan")
        below = float(chi2.cdf(self.freedom * self.scale**2, self.freedom))
        return 2.0 * min(below, 1.0 - below)


@dataclass(frozen=True)
class _Solution:
    """A solution with some marks; the attributes are those of `IntersectedMarks`."""

    lon_lat_h: Array
    marks_m2: Array
    joint_m2: Array
    residual_px: Array
    test: Array
    freedom: IntArray
    rays: IntArray
    shift_px: Array


def intersect_marks(
    models: Sequence[SensorModel], errors: Sequence[ModelErrors], marks: Observations, n_points: int
) -> IntersectedMarks:
    """The positions of points from their marks, without the marks that disagree.

    A mark of a point with three marks or more is rejected where its residual, normalised by its own
    covariance, exceeds what chance gives once in a thousand files; the scale of the errors is estimated
    where five points or more have so many marks.

    Args:
        models: one per image.
        errors: of the models.
        marks: positions in the images, at most one of a point in an image; `point` ascending.
        n_points: number of points.
    """
    active = np.ones(len(marks), dtype=np.bool_)
    alternative = np.full(len(marks), -1, dtype=np.int64)
    network = _Network(models, errors, marks, n_points)
    scale2, solution = 1.0, _solved(network, active)
    for _ in range(len(marks)):
        scale2 = _scale2(solution, marks, active)
        worst = _worst_marks(solution, marks, active, scale2)
        if not len(worst):
            break
        alternative[worst] = [
            _alternative(solution.test, marks, active, row, scale2) for row in worst.tolist()
        ]
        active[worst] = False
        solution = _solved(network, active)
    used = active & np.isfinite(solution.lon_lat_h[marks.point, 0])
    freedom = 2 * int(used.sum()) - 3 * int(np.isfinite(solution.lon_lat_h[:, 0]).sum())
    square = float((solution.residual_px[used] ** 2 / network.variance_px2[used]).sum())
    for image, one in enumerate(errors):
        shift_px = solution.shift_px[image]
        square += float(shift_px @ np.linalg.pinv(one.shift_px2) @ shift_px)
    pairs = used & (solution.rays[marks.point] == 2)
    limit = scale2 * chi2.isf(_FALSE_ALARM / max(int(active.sum()), 1), 1)
    disagree = np.zeros(n_points, dtype=np.bool_)
    disagree[marks.point[pairs & (np.nan_to_num(solution.test) > limit)]] = True
    return IntersectedMarks(
        lon_lat_h=solution.lon_lat_h,
        marks_m2=solution.marks_m2,
        joint_m2=solution.joint_m2,
        residual_px=solution.residual_px,
        test=solution.test,
        used=used,
        rejected=~active,
        alternative=alternative,
        disagree=disagree,
        base_to_height=_base_to_height(models, marks, used, solution.lon_lat_h),
        shift_px=solution.shift_px,
        scale=float(np.sqrt(square / freedom)) if freedom > 0 else float("nan"),
        freedom=freedom,
    )


@dataclass(frozen=True)
class _Network:
    """What `intersect_marks` is given."""

    models: Sequence[SensorModel]
    errors: Sequence[ModelErrors]
    marks: Observations
    n_points: int

    @property
    def variance_px2(self) -> Array:
        """Variances (m, 2) of the marks, with what parts of their images are off by."""
        local_px = np.array([one.local_px for one in self.errors])[self.marks.image]
        return np.asarray(self.marks.sigma_px[:, None] ** 2 + local_px**2)


def _solved(network: _Network, active: BoolArray) -> _Solution:
    """Points and shifts together, by Gauss-Newton steps from the intersection by the marks alone."""
    models, errors, marks = network.models, network.errors, network.marks
    rows = np.flatnonzero(active)
    met = intersect(models, marks.take(rows), network.n_points)
    rows = rows[np.isfinite(met.covariance_m2[marks.point[rows], 0, 0])]
    own = replace(network, marks=marks.take(rows))
    lon_lat_h = np.where(np.isfinite(met.covariance_m2[:, 0, :1]), met.lon_lat_h, np.nan)
    free = [k for k, one in enumerate(errors) if one.shift_px2.any() and (own.marks.image == k).any()]
    for _ in range(_STEPS):
        residual, by_ground = residuals_and_derivatives(models, own.marks, lon_lat_h)
        normal = _Normal.of(own, residual, by_ground, free)
        shift_px, step_m = normal.solved()
        lon_lat_h = move_metres(lon_lat_h, step_m)
    residual, by_ground = residuals_and_derivatives(models, own.marks, lon_lat_h)
    shifts = np.zeros((len(errors), 2))
    shifts[free] = shift_px.reshape(-1, 2)
    joint_m2, test, freedom = normal.tested(own, residual - shifts[own.marks.image], by_ground)
    every, _ = residuals_and_derivatives(models, marks, lon_lat_h)
    tests, freedoms = np.full(len(marks), np.nan), np.zeros(len(marks), dtype=np.int64)
    tests[rows], freedoms[rows] = test, freedom
    return _Solution(
        lon_lat_h=lon_lat_h,
        marks_m2=normal.inverse,
        joint_m2=joint_m2,
        residual_px=every - shifts[marks.image],
        test=tests,
        freedom=freedoms,
        rays=np.bincount(own.marks.point, minlength=network.n_points),
        shift_px=shifts,
    )


@dataclass(frozen=True)
class _Normal:
    """Normal equations of points, and of shifts of f images once the points are eliminated.

    Attributes:
        inverse: (n, 3, 3) of the matrices of the points; NaN for points without marks.
        right: (n, 3) of the points.
        coupling: (n, 2 f, 3) of shifts and points.
        reduced: (2 f, 2 f) inverse of the matrix of the shifts.
        right_of_shifts: (2 f,) before the elimination.
        column: (k,) first column of each image; -1 for an exact model.
    """

    inverse: Array
    right: Array
    coupling: Array
    reduced: Array
    right_of_shifts: Array
    column: IntArray

    @classmethod
    def of(cls, network: _Network, residual: Array, by_ground: Array, free: Sequence[int]) -> "_Normal":
        """The equations of marks whose residuals (m, 2) and derivatives (m, 2, 3) are given."""
        marks, variance, n_points = network.marks, network.variance_px2, network.n_points
        weighted = by_ground / variance[:, :, None]
        normal = np.zeros((n_points, 3, 3))
        np.add.at(normal, marks.point, weighted.transpose(0, 2, 1) @ by_ground)
        right = np.zeros((n_points, 3))
        np.add.at(right, marks.point, np.einsum("mka,mk->ma", weighted, residual))
        known = np.bincount(marks.point, minlength=n_points) >= 2
        inverse = np.full((n_points, 3, 3), np.nan)
        inverse[known] = np.linalg.inv(normal[known])
        column = np.full(len(network.errors), -1, dtype=np.int64)
        column[list(free)] = 2 * np.arange(len(free))
        shifted = column[marks.image] >= 0
        at = column[marks.image[shifted]]
        coupling = np.zeros((n_points, 2 * len(free), 3))
        matrix = np.zeros((2 * len(free), 2 * len(free)))
        right_of_shifts = np.zeros(2 * len(free))
        for axis in range(2):
            np.add.at(coupling, (marks.point[shifted], at + axis), weighted[shifted, axis])
            np.add.at(matrix, (at + axis, at + axis), 1.0 / variance[shifted, axis])
            np.add.at(right_of_shifts, at + axis, residual[shifted, axis] / variance[shifted, axis])
        for k, image in enumerate(free):
            own = np.s_[2 * k : 2 * k + 2]
            matrix[own, own] += np.linalg.inv(network.errors[image].shift_px2)
        matrix -= np.einsum("nia,nab,njb->ij", coupling[known], inverse[known], coupling[known])
        return cls(inverse, right, coupling, np.asarray(np.linalg.inv(matrix)), right_of_shifts, column)

    def solved(self) -> tuple[Array, Array]:
        """Shifts (2 f,) and steps (n, 3) of the points, metres."""
        known = np.isfinite(self.inverse[:, 0, 0])
        by_points = np.einsum(
            "nia,nab,nb->i", self.coupling[known], self.inverse[known], self.right[known]
        )
        shift_px = self.reduced @ (self.right_of_shifts - by_points)
        right = self.right - np.einsum("nia,i->na", self.coupling, shift_px)
        return shift_px, np.einsum("nab,nb->na", self.inverse, right)

    def tested(
        self, network: _Network, residual: Array, by_ground: Array
    ) -> tuple[Array, Array, IntArray]:
        """Covariances (n, 3, 3) of the points with the shifts; tests (m,) of marks and their freedom."""
        marks, variance = network.marks, network.variance_px2
        carried = self.inverse @ self.coupling.transpose(0, 2, 1)
        crossed = -carried @ self.reduced
        joint = self.inverse - crossed @ carried.transpose(0, 2, 1)
        computed = by_ground @ joint[marks.point] @ by_ground.transpose(0, 2, 1)
        shifted = np.flatnonzero(self.column[marks.image] >= 0)
        columns = self.column[marks.image[shifted]][:, None] + np.arange(2)
        of_shifts = np.take_along_axis(crossed[marks.point[shifted]], columns[:, None, :], axis=2)
        both = by_ground[shifted] @ of_shifts
        computed[shifted] += both + both.transpose(0, 2, 1)
        computed[shifted] += self.reduced[columns[:, :, None], columns[:, None, :]]
        of_residual = variance[:, :, None] * np.eye(2) - computed
        values, vectors = np.linalg.eigh(of_residual)
        determined = values > 1e-6 * variance.sum(axis=1)[:, None]
        along = np.einsum("mka,mk->ma", vectors, residual)
        square = np.where(determined, along**2 / np.where(determined, values, 1.0), 0.0)
        return joint, square.sum(axis=1), determined.sum(axis=1)


def _scale2(solution: _Solution, marks: Observations, active: BoolArray) -> float:
    """Variance of marks over what is stated of them, by the median of their tests; 1 at least."""
    whole = active & (solution.freedom == 2) & (solution.rays[marks.point] >= 3)
    if len(np.unique(marks.point[whole])) < _FEWEST_SCALED:
        return 1.0
    return max(1.0, float(np.median(solution.test[whole]) / chi2.median(2)))


def _worst_marks(solution: _Solution, marks: Observations, active: BoolArray, scale2: float) -> IntArray:
    """Rows of the marks that disagree most with two others of their point, one a point."""
    testable = active & (solution.freedom == 2) & (solution.rays[marks.point] >= 3)
    test = np.where(testable, solution.test, 0.0)
    limit = scale2 * chi2.isf(_FALSE_ALARM / max(int(active.sum()), 1), 2)
    limit = max(limit, _ROUND_SHARE * float(test.max(initial=0.0)))
    order = np.argsort(-test, kind="stable")
    order = order[test[order] > limit]
    return np.asarray(order[np.sort(np.unique(marks.point[order], return_index=True)[1])])


def _alternative(test: Array, marks: Observations, active: BoolArray, row: int, scale2: float) -> int:
    """Another mark of a point that may be wrong in place of the one of a row; -1 for none."""
    others = np.flatnonzero(active & (marks.point == marks.point[row]))
    others = others[others != row]
    best = int(others[np.argmax(test[others])])
    return best if test[row] - test[best] < _LIKELY * scale2 else -1


def _base_to_height(
    models: Sequence[SensorModel], marks: Observations, used: BoolArray, lon_lat_h: Array
) -> Array:
    """Largest base over height (n,) of the marks of each point; NaN for points without position."""
    across = np.full((len(marks), 2), np.nan)
    for image, model in enumerate(models):
        rows = np.flatnonzero(used & (marks.image == image))
        _, sight = model.line_of_sight(marks.line_sample[rows])
        axes = ecef_from_east_north_up(lon_lat_h[marks.point[rows]])
        towards = np.einsum("mai,ma->mi", axes, -sight)
        across[rows] = towards[:, :2] / towards[:, 2:]
    out = np.full(len(lon_lat_h), np.nan)
    for point in np.unique(marks.point[used]).tolist():
        own = across[used & (marks.point == point)]
        out[point] = np.linalg.norm(own[:, None] - own[None], axis=2).max()
    return out
