"""Robust affine correction of one scene, the start of all further estimates."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from amers.services.errors import NotEnoughPoints, UndeterminedCorrection
from amers.services.misfit.affine_fit import FREE, ORDERS, AffineFit, Order
from amers.services.misfit.control_observations import ControlObservations, declared_fit, frame_sigma_px
from amers.services.misfit.order_selection import choose_order
from amers.services.misfit.robust import deactivate
from amers.services.misfit.scene_adjustment import AdjustmentOptions, SceneAdjustment
from amers.services.misfit.shared_errors import offset_sigma_px
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, BoolArray

_THIN = 1e-3
"""Smallest width of the area of the points that determines drift and skew, half sizes of the image."""


@dataclass(frozen=True)
class AffineStart:
    """The n measures of a scene, and its affine correction.

    Attributes:
        declared: fit of the measures with the variances that are stated.
        fit: with those that they show.
        of_points: (n, 2) part of the variances by the points.
        seen: (n,) measures that there are.
        usable: (n,) those of them that may be used.
        order: given or chosen.
        validation_px: of every order tried.
        parameters: (2, 3 + b) of a robust solution of the order.
        scale: standard deviation of unit weight about it.
        agreeing: (n,) usable measures within twice the tolerance of it.
        free: (2, 3) parameters that are estimated.
        slope_px: a priori standard deviation of drift and skew at the edge of the image.
        apart_px: see `SceneAdjustment`.
        active: (n,) measures that agree with the affine correction.
    """

    declared: AffineFit
    fit: AffineFit
    of_points: Array
    seen: BoolArray
    usable: BoolArray
    order: Order
    validation_px: tuple[tuple[Order, float], ...]
    parameters: Array
    scale: float
    agreeing: BoolArray
    free: BoolArray
    slope_px: float
    apart_px: float
    active: BoolArray

    @property
    def expected(self) -> Array:
        """A priori weight (2, 3 + b) of the parameters."""
        return self.fit.expected(self.slope_px)

    def clipped(self, tolerance: float) -> AffineFit:
        """The fit whose residuals from the robust solution are at most twice the tolerance."""
        return self.fit.clipped(self.parameters, 2.0 * tolerance * self.scale)


def affine_start(
    model: SensorModel,
    shape: tuple[int, int],
    observations: ControlObservations,
    options: AdjustmentOptions,
    *,
    min_points: int,
    like: SceneAdjustment | None,
) -> AffineStart:
    """The affine correction of a scene; see `adjust_scene` for arguments and errors."""
    declared, seen, of_points = declared_fit(model, shape, observations)
    usable = seen if observations.usable is None else seen & observations.usable
    if usable.sum() < min_points:
        raise NotEnoughPoints(int(usable.sum()), min_points, "measures with a position and a sigma")
    order, validation_px = _order(declared, usable, options, like)
    free = FREE[order]
    stated = (
        np.zeros(len(usable), dtype=np.bool_) if observations.stated is None else observations.stated
    )
    shown = usable & ~stated if (usable & ~stated).any() else usable
    fit = declared.with_empirical_variance(declared.robust_solution(usable, free), shown, of_points)
    parameters = fit.robust_solution(usable, free)
    scale = fit.scale(parameters, usable, free)
    scales = np.where(stated, max(scale, 1.0), scale)
    agreeing = usable & (fit.magnitude(parameters) / scales <= 2.0 * options.tolerance)
    unit, slope_px = max(scale, 1.0), float("inf")
    if options.order is None:
        free = FREE["affine"]
        least_px = options.prior_slope_sigma_px
        slope_px = like.slope_px if like else fit.likeliest_slope_px(agreeing, unit, least_px)
    else:
        _refuse_undetermined(fit, agreeing, order)
    apart_px = 0.0
    if fit.member.shape[1]:
        stated_px = frame_sigma_px(model, observations, fit.member)
        offset_px, apart_px = offset_sigma_px(
            fit, agreeing, free, slope_px, unit=unit, stated_px=stated_px
        )
        fit, declared = (replace(one, offset_px=offset_px) for one in (fit, declared))
    # The scale is that of the robust start: a scale of the active measures would shrink with them.
    magnitude = partial(_magnitude, fit=fit, free=free, slope_px=slope_px, scales=scales)
    return AffineStart(
        declared=declared,
        fit=fit,
        of_points=of_points,
        seen=seen,
        usable=usable,
        order=order,
        validation_px=validation_px,
        parameters=parameters,
        scale=scale,
        agreeing=agreeing,
        free=free,
        slope_px=slope_px,
        apart_px=apart_px,
        active=deactivate(magnitude, agreeing, options.tolerance, min_points),
    )


def _magnitude(
    active: BoolArray, *, fit: AffineFit, free: BoolArray, slope_px: float, scales: Array
) -> Array:
    """The larger normalised residual (n,) of each measure from the solution of the active ones."""
    parameters, _ = fit.solution(active, free, slope_px)
    return np.asarray(fit.magnitude(parameters) / scales)


def _order(
    fit: AffineFit, usable: BoolArray, options: AdjustmentOptions, like: SceneAdjustment | None
) -> tuple[Order, tuple[tuple[Order, float], ...]]:
    """The order given or chosen, and the score of each order that was considered."""
    if like is not None:
        return like.order, like.validation_px
    orders: list[Order] = [options.order] if options.order else ["shift"]
    if options.order is None and fit.spread(usable) >= options.min_spread:
        # Of all measures: those that agree with a shift are few where there is a drift.
        enough = usable.sum() / options.points_per_parameter
        orders += [order for order in ORDERS[1:] if enough >= FREE[order].sum()]
    return choose_order(fit, usable, orders, options.min_gain, options.folds)


def _refuse_undetermined(fit: AffineFit, active: BoolArray, order: Order) -> None:
    """Raise where the measures do not determine what the user's order leaves to them."""
    for of_one in FREE[order]:
        slopes = fit.t[active][:, of_one[1:]] - fit.t[active][:, of_one[1:]].mean(axis=0)
        if not slopes.shape[1]:
            continue
        width = float(np.sqrt(max(np.linalg.eigvalsh(slopes.T @ slopes / len(slopes))[0], 0.0)))
        if width < _THIN:
            raise UndeterminedCorrection(
                f"the {int(active.sum())} points lie on a line, {width:.1g} half sizes of the image "
                f"wide, which does not determine the order {order!r} (at least {_THIN:g} expected): "
                "give the order 'shift', or none, so that parameters which no point determines stay "
                "small"
            )
