"""The least squares: the image correction of one scene from points on known ground."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from services.adjustment.robust import MAD_TO_STD, cauchy_weights, deactivate, likeliest_variance
from services.conventions import MAX_ERROR_SIGMAS
from services.errors import NotEnoughPoints
from services.sensors.base import SensorModel
from services.sensors.correction import ImageCorrection, no_correction
from services.types import Array, BoolArray

Order = Literal["shift", "drift", "affine"]

_FREE = {
    "shift": np.array([[True, False, False], [True, False, False]]),
    "drift": np.array([[True, True, False], [True, False, True]]),
    "affine": np.ones((2, 3), dtype=bool),
}
ORDERS: tuple[Order, ...] = ("shift", "drift", "affine")

_MUCH_BETTER = 0.5
"""Below this ratio of residuals to declared sigmas, the points are better than declared."""


@dataclass(frozen=True)
class AdjustmentOptions:
    """How a scene is adjusted.

    Attributes:
        order: of the correction; None selects it by cross-validation. Drift and skew are then estimated
            whatever the order, as far as the measures determine them.
        tolerance: a measure is deactivated when its residual exceeds this many standard deviations.
        min_points: smallest number of active measures.
        points_per_parameter: measures for each parameter that an order needs to be considered.
        min_spread: spread of the measures that an order beyond the shift needs: standard deviation along
            each axis, in half sizes of the image (an even spread has 0.58).
        min_gain: an order replaces a simpler one when it reduces the cross-validated residual by this
            fraction.
        folds: of the cross-validation.
        prior_slope_sigma_px: a priori standard deviation of drift and skew at the edge of the image,
            pixels; the measures may raise it, never lower it.
        slope_px: the same where the order is given; None leaves drift and skew to the measures.
    """

    order: Order | None = None
    tolerance: float = 2.7
    min_points: int = 4
    points_per_parameter: float = 2.0
    min_spread: float = 0.1
    min_gain: float = 0.03
    folds: int = 5
    prior_slope_sigma_px: float = 1.0
    slope_px: float | None = None

    def repeating(self, adjustment: "SceneAdjustment") -> "AdjustmentOptions":
        """Options that repeat an adjustment on other measures, with the same prior of drift and skew."""
        if self.order is not None:
            return self
        return replace(self, order="affine", slope_px=adjustment.slope_px)


@dataclass(frozen=True)
class ControlObservations:
    """Where n control points were seen in a scene, and the precision of points and measures.

    Attributes:
        lon_lat_h: (n, 3) the points.
        line_sample: (n, 2) the measures; NaN where a point was not found.
        sigma_px: (n,) of the measures.
        covariance_m2: (n, 3, 3) of the points, east, north, up.
        usable: (n,) measures that may be used; all finite measures when None.
        common_covariance_px2: (2, 2) line, sample, of an error that all measures share; it adds to the
            covariance of the shift. None when there is no such error.
    """

    lon_lat_h: Array
    line_sample: Array
    sigma_px: Array
    covariance_m2: Array
    usable: BoolArray | None = None
    common_covariance_px2: Array | None = None


@dataclass(frozen=True)
class SceneAdjustment:
    """A correction and its precision.

    Attributes:
        correction: of the scene's model.
        order: the simplest order that predicts held-out measures as well as any, or the order given.
        validation_px: every order tried, with its cross-validated residual (rms distance, pixels).
        slope_px: a priori standard deviation of drift and skew at the edge of the image, as used.
        covariance: (6, 6) of `correction.parameters.ravel()`, px^2; zero for parameters that a given
            order leaves out.
        residual_px: (n, 2) observed minus computed, line and sample, of all measures.
        active: (n,) measures that were not deactivated.
        sigma0: a posteriori standard deviation of unit weight.
        point_sigma_px: (2,) contribution of the points' own accuracy to the active residuals, one
            standard deviation of line and sample.
    """

    correction: ImageCorrection
    order: Order
    validation_px: tuple[tuple[Order, float], ...]
    slope_px: float
    covariance: Array
    residual_px: Array
    active: BoolArray
    sigma0: float
    point_sigma_px: Array

    def covariance_at(self, line_sample: Array) -> Array:
        """Covariance (n, 2, 2) of the corrected model at image positions (n, 2), px^2."""
        t = (line_sample - self.correction.centre) / self.correction.half_size
        design = np.zeros((len(t), 2, 6))
        design[:, 0, :3] = design[:, 1, 3:] = np.column_stack([np.ones(len(t)), t])
        return np.asarray(design @ self.covariance @ design.transpose(0, 2, 1))


def adjust_scene(
    model: SensorModel,
    shape: tuple[int, int],
    observations: ControlObservations,
    options: AdjustmentOptions = AdjustmentOptions(),
    *,
    min_points: int | None = None,
) -> SceneAdjustment:
    """The correction of a model that best explains where control points were seen.

    Weighted least squares on `line_sample - model.project(lon_lat_h)`. The weight of a measure follows
    from its sigma and from the covariance of its point, projected to the image; where the measures show
    that the points are much better than declared, a smaller covariance is used. Robust weights give a
    first solution. Then the worst measure beyond tolerance is deactivated, one at a time, until all
    agree.

    Drift and skew that are too small to be seen beside the errors of the points still exist. They are
    not fixed at zero: their a priori standard deviation is estimated from the measures (empirical
    Bayes), and their covariance states what remains undetermined.

    Args:
        model: as delivered.
        shape: lines and samples of the image.
        observations: of the control points.
        options: thresholds.
        min_points: smallest number of active measures; that of the options when None.

    Raises:
        NotEnoughPoints: fewer than `min_points` measures are usable.
    """
    line_sample, sigma_px = observations.line_sample, observations.sigma_px
    min_points = options.min_points if min_points is None else min_points
    misfit = line_sample - model.project(observations.lon_lat_h)
    usable = np.isfinite(misfit).all(axis=1) & np.isfinite(sigma_px)
    if observations.usable is not None:
        usable &= observations.usable
    if usable.sum() < min_points:
        raise NotEnoughPoints(int(usable.sum()), min_points, "measures with a position and a sigma")
    derivative = np.nan_to_num(model.project_derivative(observations.lon_lat_h))
    covariance_px2 = derivative @ observations.covariance_m2 @ derivative.transpose(0, 2, 1)
    own = np.nan_to_num(sigma_px, nan=1.0)[:, None] ** 2
    of_points = np.diagonal(covariance_px2, 0, 1, 2)
    frame = no_correction(shape)
    t = (line_sample - misfit - frame.centre) / frame.half_size
    declared = _Problem(t, np.where(usable[:, None], misfit, 0.0), own + of_points)

    order, validation = _choose_order(declared, usable, options)
    start = declared.robust_solution(usable, _FREE[order])
    problem = declared.with_empirical_variance(start, usable, of_points)
    start = problem.robust_solution(usable, _FREE[order])
    scale = max(problem.scale(start, usable), 1e-9)
    agreeing = usable & (problem.magnitude(start) / scale <= 2.0 * options.tolerance)
    free = _FREE[order]
    slope_px = float("inf") if options.slope_px is None else options.slope_px
    if options.order is None:
        free = _FREE["affine"]
        slope_px = problem.likeliest_slope_px(agreeing, max(scale, 1.0), options.prior_slope_sigma_px)

    def magnitude(active: BoolArray) -> Array:
        parameters, _ = problem.solution(active, free, slope_px)
        # The scale is that of the robust start: a scale of the active measures would shrink with them.
        return np.asarray(problem.magnitude(parameters) / scale)

    active = deactivate(magnitude, agreeing, options.tolerance, min_points)
    sigma0 = declared.sigma0(active, free, slope_px)
    parameters, _ = problem.scaled_by_sigma0(sigma0).solution(active, free, slope_px)
    # A good fit does not reduce the stated sigmas; a bad fit increases them.
    _, covariance = declared.scaled_by_sigma0(sigma0).solution(active, free, slope_px)
    if observations.common_covariance_px2 is not None:
        covariance[np.ix_([0, 3], [0, 3])] += observations.common_covariance_px2
    return SceneAdjustment(
        correction=ImageCorrection(parameters, frame.centre, frame.half_size),
        order=order,
        validation_px=validation,
        slope_px=slope_px,
        covariance=covariance,
        residual_px=np.where(usable[:, None], problem.residual(parameters), np.nan),
        active=active,
        sigma0=sigma0,
        point_sigma_px=np.sqrt(of_points[active].mean(axis=0)),
    )


@dataclass(frozen=True)
class _Problem:
    """Misfits that an affine displacement has to explain; the two coordinates are independent.

    Attributes:
        t: (n, 2) positions, -1 to 1 over the image.
        misfit: (n, 2) pixels.
        variance: (n, 2) px^2.
    """

    t: Array
    misfit: Array
    variance: Array

    def with_empirical_variance(
        self, parameters: Array, active: BoolArray, of_points: Array
    ) -> "_Problem":
        """The same problem with smaller variances, where residuals are much smaller than declared."""
        if self.scale(parameters, active) >= _MUCH_BETTER:
            return self
        variance = self.variance.copy()
        own = (variance - of_points)[active]
        variance[active] = likeliest_variance(self.residual(parameters)[active], own, of_points[active])
        return replace(self, variance=variance)

    def scaled_by_sigma0(self, sigma0: float) -> "_Problem":
        """The same problem with its variances multiplied by sigma0 squared, where sigma0 exceeds 1."""
        return replace(self, variance=self.variance * max(sigma0, 1.0) ** 2)

    def solution(
        self,
        active: BoolArray,
        free: BoolArray,
        slope_px: float = np.inf,
        weights: Array | None = None,
    ) -> tuple[Array, Array]:
        """Parameters (2, 3) and covariance (6, 6), with an a priori sigma of drift and skew."""
        design = np.column_stack([np.ones(len(self.t)), self.t])[active]
        # Both coordinates have as many free parameters in every order: they are solved at once.
        columns = np.array([np.flatnonzero(of_one) for of_one in free])
        weight = 1.0 / self.variance[active].T
        if weights is not None:
            weight = weight * weights[active]
        a = design[:, columns].transpose(1, 2, 0)
        expected = np.where(columns > 0, slope_px**-2.0, 0.0)[:, :, None] * np.eye(columns.shape[1])
        weighted = a * weight[:, None, :]
        inverse = np.linalg.pinv(weighted @ a.transpose(0, 2, 1) + expected, hermitian=True)
        solved = inverse @ (weighted @ self.misfit[active].T[:, :, None])
        parameters = np.zeros((2, 3))
        covariance = np.zeros((6, 6))
        for k in range(2):
            parameters[k, columns[k]] = solved[k, :, 0]
            covariance[np.ix_(3 * k + columns[k], 3 * k + columns[k])] = inverse[k]
        return parameters, covariance

    def likeliest_slope_px(self, active: BoolArray, unit: float, least_px: float) -> float:
        """The a priori sigma of drift and skew that makes their estimates most likely.

        Args:
            active: (n,) measures.
            unit: standard deviation of unit weight.
            least_px: smallest sigma.
        """
        parameters, covariance = self.solution(active, _FREE["affine"])
        slope = parameters[:, 1:].ravel()
        variance = unit**2 * np.diagonal(covariance)[[1, 2, 4, 5]]
        spread_px = least_px * np.geomspace(1.0, 1000.0, 121)
        total = variance + spread_px[:, None] ** 2
        likelihood = -(np.log(total) + slope**2 / total).sum(axis=1)
        return float(spread_px[np.argmax(likelihood)])

    def sigma0(self, active: BoolArray, free: BoolArray, slope_px: float) -> float:
        """Standard deviation of unit weight; 1 without redundancy."""
        parameters, covariance = self.solution(active, free, slope_px)
        chi2 = float((self.residual(parameters)[active] ** 2 / self.variance[active]).sum())
        # A parameter that its prior determines is not determined by the measures.
        prior = np.diagonal(covariance)[[1, 2, 4, 5]].sum() / slope_px**2
        freedom = 2 * int(active.sum()) - int(free.sum()) + prior
        return float(np.sqrt(chi2 / freedom)) if freedom > 0 else 1.0

    def spread(self, active: BoolArray) -> float:
        """Standard deviation of the measures along the worse axis, half sizes of the image."""
        return float(self.t[active].std(axis=0).min())

    def residual(self, parameters: Array) -> Array:
        """(n, 2) pixels."""
        return np.asarray(self.misfit - parameters[:, 0] - self.t @ parameters[:, 1:].T)

    def magnitude(self, parameters: Array) -> Array:
        """(n,) the larger of the two normalised residuals."""
        return np.asarray(np.abs(self.residual(parameters) / np.sqrt(self.variance)).max(axis=1))

    def scale(self, parameters: Array, active: BoolArray) -> float:
        """Robust standard deviation of the normalised residuals."""
        normalised = self.residual(parameters)[active] / np.sqrt(self.variance[active])
        return float(MAD_TO_STD * np.median(np.abs(normalised)))

    def robust_solution(self, active: BoolArray, free: BoolArray) -> Array:
        """Parameters (2, 3) by iterative re-weighting that starts at the median shift."""
        parameters = np.zeros((2, 3))
        parameters[:, 0] = np.median(self.misfit[active], axis=0)
        for _ in range(20):
            scale = max(self.scale(parameters, active), 1e-9)
            weights = cauchy_weights(self.magnitude(parameters) / scale)
            updated, _ = self.solution(active, free, weights=weights)
            if np.abs(updated - parameters).max() < 1e-4:
                return updated
            parameters = updated
        return parameters


def _choose_order(
    problem: _Problem, usable: BoolArray, options: AdjustmentOptions
) -> tuple[Order, tuple[tuple[Order, float], ...]]:
    """Simplest order that predicts held-out measures as well as any, and the score of each order."""
    orders = [options.order] if options.order else _considered(problem, usable, options)
    # All orders are compared on the same measures: those that fit the order with most parameters.
    fullest = problem.robust_solution(usable, _FREE[orders[-1]])
    scale = max(problem.scale(fullest, usable), 1e-9)
    judges = usable & (problem.magnitude(fullest) <= MAX_ERROR_SIGMAS * scale)
    validation = tuple(
        (order, _validation_px(problem, usable, judges, order, options.folds)) for order in orders
    )
    best, best_px = validation[0]
    for order, value_px in validation[1:]:
        if value_px < best_px * (1.0 - options.min_gain):
            best, best_px = order, value_px
    return best, validation


def _considered(problem: _Problem, usable: BoolArray, options: AdjustmentOptions) -> Sequence[Order]:
    """Orders that the number and the spread of the measures can determine."""
    start = problem.robust_solution(usable, _FREE["shift"])
    agreeing = usable & (problem.magnitude(start) <= 5.0 * max(problem.scale(start, usable), 1e-9))
    count = int(agreeing.sum())
    spread = problem.spread(agreeing)
    return [
        order
        for order in ORDERS
        if order == "shift"
        or (spread >= options.min_spread and count >= options.points_per_parameter * _FREE[order].sum())
    ]


def _validation_px(
    problem: _Problem, usable: BoolArray, judges: BoolArray, order: Order, folds: int
) -> float:
    """Distance (rms, pixels) of the judging measures from the prediction of a fit without them."""
    rows = np.flatnonzero(usable)
    folds = min(folds, len(rows))
    # Neighbours in the image go into different folds.
    rank = np.empty(len(rows), dtype=np.int64)
    rank[np.lexsort((problem.t[rows, 1], problem.t[rows, 0]))] = np.arange(len(rows))
    held_out = np.empty((len(rows), 2))
    for fold in range(folds):
        out = rank % folds == fold
        active = usable.copy()
        active[rows[out]] = False
        parameters = problem.robust_solution(active, _FREE[order])
        held_out[out] = problem.residual(parameters)[rows[out]]
    return float(np.sqrt((held_out[judges[rows]] ** 2).sum(axis=1).mean()))
