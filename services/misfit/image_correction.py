"""The least squares: the image correction of one scene from points on known ground."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from amers.services.errors import NotEnoughPoints, UndeterminedCorrection
from amers.services.misfit.affine_fit import FREE, ORDERS, AffineFit, Order
from amers.services.misfit.broken_image import held_parts, on_one_side, part_of_line
from amers.services.misfit.control_observations import (
    ControlObservations,
    declared_fit,
    frame_sigma_px,
)
from amers.services.misfit.displacement_components import Component
from amers.services.misfit.displacement_solution import solve_displacement
from amers.services.misfit.moved_ground import MovedGround, moved_ground
from amers.services.misfit.order_selection import choose_order
from amers.services.misfit.placed_measures import PlacedMeasures
from amers.services.misfit.robust import deactivate
from amers.services.misfit.scene_motion import SceneMotion, what_moves
from amers.services.misfit.scene_solution import AgreeingMeasures
from amers.services.misfit.shared_errors import (
    SharedErrors,
    likeliest_shared_errors,
    offset_sigma_px,
)
from amers.services.misfit.short_motion import STILL, ShortMotion, short_motion
from amers.services.misfit.structure import Structure, unfollowed_variance_px2
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array, BoolArray, IntArray

_THIN = 1e-3
"""Smallest width of the area of the points that determines drift and skew, half sizes of the image."""


_DEFORMED = 0.5, 1.0, 1.0
"""Variances of shift, drift and skew that follow a deformation of the points, over its mean variance.

A linear deformation of a block as large as the scene has a drift and a skew of 1.5; in a larger block
it is mostly a shift of 1. This lies between: 0.5 in the middle of the scene, 2.5 at its corners."""


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
        profile: whether motion along lines and samples that the measures show is followed, where no
            order is given; what is not followed is tested in any case.
        bends: whether bends that the measures leave open are followed beside it, as far as they show
            them. Other images may tell of them.
    """

    order: Order | None = None
    tolerance: float = 2.7
    min_points: int = 4
    points_per_parameter: float = 2.0
    min_spread: float = 0.1
    min_gain: float = 0.03
    folds: int = 5
    prior_slope_sigma_px: float = 1.0
    profile: bool = True
    bends: bool = True


@dataclass(frozen=True)
class SceneAdjustment:
    """A correction and its precision.

    Attributes:
        correction: of the scene's model.
        order: the simplest order that predicts held-out measures as well as any, or the order given.
        validation_px: every order tried, with its cross-validated residual (rms distance, pixels).
        slope_px: a priori standard deviation of drift and skew at the edge of the image, as used.
        covariance: (6, 6) of `correction.parameters.ravel()`, px^2; zero for parameters that a given
            order leaves out. It is relative to the frame that the blocks of the points scatter about.
        deformation: (6, 6) part of it by what the points share, as they are deformed.
        local_sigma_px: (2,) standard deviation, line and sample, of what parts of the image are off by
            and no correction follows: seams between detectors, terrain, motion within chips.
        shared: what the residuals tell of errors that the points share.
        short_motion: what chips show of motion within them.
        apart_px: standard deviation of the offsets of the points' blocks, beyond chance; 0 for one.
        residual_px: (n, 2) observed minus computed, line and sample, of all measures.
        active: (n,) measures that were not deactivated.
        sigma0: a posteriori standard deviation of unit weight.
        point_sigma_px: (2,) contribution of the points' own accuracy to the active residuals, one
            standard deviation of line and sample.
        components: of the displacement beyond the affine correction that residuals show.
        left_open: components of it that the points leave open, where they do not reach: bends, seams.
        structures: what the residuals of the correction still depend on, by family; none where it was
            not tested.
        moved: ground that moved, of which no measure is active; None where none is seen.
    """

    correction: ImageCorrection
    order: Order
    validation_px: tuple[tuple[Order, float], ...]
    slope_px: float
    covariance: Array
    deformation: Array
    local_sigma_px: Array
    shared: SharedErrors
    short_motion: ShortMotion
    apart_px: float
    residual_px: Array
    active: BoolArray
    sigma0: float
    point_sigma_px: Array
    components: tuple[Component, ...] = ()
    left_open: tuple[Component, ...] = ()
    structures: tuple[Structure, ...] = ()
    moved: MovedGround | None = None

    def covariance_at(self, line_sample: Array) -> Array:
        """Covariance (n, 2, 2) of the corrected model at image positions (n, 2), px^2."""
        return self.correction.covariance_at(line_sample, self.covariance, self.local_sigma_px)


def adjust_scene(
    model: SensorModel,
    shape: tuple[int, int],
    observations: ControlObservations,
    options: AdjustmentOptions = AdjustmentOptions(),
    *,
    min_points: int | None = None,
    like: SceneAdjustment | None = None,
    ground_may_move: bool = False,
) -> SceneAdjustment:
    """The correction of a model that best explains where control points were seen.

    Weighted least squares on `line_sample - model.project(lon_lat_h)`. The weight of a measure follows
    from its sigma and from the covariance of its point, projected to the image; where the measures show
    that the points are much better than declared, a smaller covariance is used. Robust weights give a
    first solution. Then the worst measure beyond tolerance is deactivated, one at a time, until all
    agree.

    Drift and skew that are too small to be seen beside the errors of the points still exist. They are
    not fixed at zero: their a priori standard deviation is estimated from the measures (empirical
    Bayes), and their covariance states what remains undetermined. So it is with an offset for each
    block, where the points come from several. The covariance holds what the residuals show of errors
    that neighbours share: see `shared_errors`. They are errors of the points and of the image, in the
    proportion of their declared variances; those of the image remain at every place of it.

    Args:
        model: as delivered.
        shape: lines and samples of the image.
        observations: of the control points.
        options: thresholds.
        min_points: smallest number of active measures; that of the options when None.
        like: an adjustment of these measures and others, whose prior of drift and skew, shared errors
            and motion hold; they are estimated when None.
        ground_may_move: whether an area of the ground is left out that explains the measures better
            than motion does. Only measures of a narrow search tell: in a wide one, areas are found at
            wrong places together.

    Raises:
        NotEnoughPoints: fewer than `min_points` measures are usable.
        UndeterminedCorrection: the points lie on a line, which does not determine the order given.
    """
    min_points = options.min_points if min_points is None else min_points
    again = partial(
        adjust_scene,
        model,
        shape,
        options=options,
        min_points=min_points,
        ground_may_move=ground_may_move,
    )
    if moved := like and like.moved:
        return _beside(moved, partial(again, like=replace(like, moved=None)), model, observations)
    declared, seen, of_points = declared_fit(model, shape, observations)
    usable = seen if observations.usable is None else seen & observations.usable
    if usable.sum() < min_points:
        raise NotEnoughPoints(int(usable.sum()), min_points, "measures with a position and a sigma")
    order, validation = _order(declared, usable, options, like)
    free = FREE[order]
    start = declared.robust_solution(usable, free)
    fit = declared.with_empirical_variance(start, usable, of_points)
    start = fit.robust_solution(usable, free)
    scale = fit.scale(start, usable, free)
    agreeing = usable & (fit.magnitude(start) / scale <= 2.0 * options.tolerance)
    slope_px = float("inf")
    if options.order is None:
        free = FREE["affine"]
        least_px = options.prior_slope_sigma_px
        slope_px = like.slope_px if like else fit.likeliest_slope_px(agreeing, max(scale, 1.0), least_px)
    else:
        _refuse_undetermined(fit, agreeing, order)
    apart_px = 0.0
    if fit.member.shape[1]:
        stated_px = frame_sigma_px(model, observations, fit.member)
        unit = max(scale, 1.0)
        offset_px, apart_px = offset_sigma_px(
            fit, agreeing, free, slope_px, unit=unit, stated_px=stated_px
        )
        fit, declared = (replace(one, offset_px=offset_px) for one in (fit, declared))

    def magnitude(active: BoolArray) -> Array:
        parameters, _ = fit.solution(active, free, slope_px)
        # The scale is that of the robust start: a scale of the active measures would shrink with them.
        return np.asarray(fit.magnitude(parameters) / scale)

    active = deactivate(magnitude, agreeing, options.tolerance, min_points)
    measured = PlacedMeasures.of(model, shape, observations, fit=declared, of_points=of_points)
    expected, limit = fit.expected(slope_px), options.tolerance
    clipped = fit.clipped(start, 2.0 * limit * scale)
    motion = (
        SceneMotion(like.components, (), active)
        if like
        else _motion(
            measured, fit, start, clipped, options, seen=seen, active=active, breaks=observations.breaks
        )
    )
    ground = (
        moved_ground(measured, fit, clipped, motion, seen=seen, tolerance=limit)
        if ground_may_move
        else None
    )
    if ground and (usable & ~ground.measures).sum() >= min_points:
        return _beside(ground, again, model, observations)
    components = motion.components
    if components:
        active = measured.agreeing(fit, seen if like is None else usable, components, expected, limit)
        active &= _in_held_parts(observations, active)
    shared = (
        like.shared
        if like
        else _shared_errors(
            measured,
            fit,
            components,
            declared=declared,
            active=active,
            agreeing=agreeing,
            free=free,
            slope_px=slope_px,
        )
    )
    agreeing_measures = AgreeingMeasures(measured, fit, declared, active, shared, limit)
    left_open = _left_open(agreeing_measures, expected, components, options, like)
    if components or left_open:
        solution = agreeing_measures.displaced(expected, (*components, *left_open))
    else:
        solution = agreeing_measures.affine(free, slope_px)
    displacement, covariance = solution.displacement, solution.covariance
    correction = replace(
        no_correction(shape), parameters=solution.parameters[:, :3], displacement=displacement
    )
    if observations.common_covariance_px2 is not None:
        covariance[np.ix_([0, 3], [0, 3])] += observations.common_covariance_px2
    deformation = (
        np.zeros((6, 6))
        if observations.deformation_px2 is None
        else deformation_covariance(observations.deformation_px2, correction)
    )
    explained = measured.without(displacement, fit) if displacement else fit
    misfit_px = (
        explained.misfit - np.column_stack([np.ones(len(fit.t)), fit.t]) @ correction.parameters.T
    )
    of_image = np.median((1.0 - of_points / declared.variance)[active], axis=0)
    local_px2 = shared.clear_share * of_image * np.mean(misfit_px[active] ** 2, axis=0)
    short = like.short_motion if like else _short_motion(measured, observations, active, displacement)
    tested = (
        like.structures
        if like
        else measured.structures(fit, active, components, shared, motion.along_axes)
    )
    unfollowed = unfollowed_variance_px2(tested, of_image)
    return SceneAdjustment(
        correction=correction,
        order=order,
        validation_px=validation,
        slope_px=slope_px,
        covariance=covariance + deformation,
        deformation=deformation,
        local_sigma_px=np.sqrt(np.maximum(local_px2, unfollowed) + short.variance_px2),
        shared=shared,
        short_motion=short,
        apart_px=apart_px,
        residual_px=np.where((usable | active)[:, None], misfit_px, np.nan),
        active=active,
        sigma0=solution.sigma0,
        point_sigma_px=np.sqrt(of_points[active].mean(axis=0)),
        components=components,
        left_open=left_open,
        structures=tested if like else (*tested, short.structure),
    )


def _motion(
    measured: PlacedMeasures,
    fit: AffineFit,
    start: Array,
    clipped: AffineFit,
    options: AdjustmentOptions,
    *,
    seen: BoolArray,
    active: BoolArray,
    breaks: IntArray | None,
) -> SceneMotion:
    """What no affine correction follows, as far as the options want it followed."""
    if not options.profile or options.order is not None:
        return SceneMotion(*measured.components(fit, active, wanted=False), active)
    return what_moves(
        measured,
        fit,
        start,
        clipped,
        seen=seen,
        active=active,
        breaks=breaks,
        tolerance=options.tolerance,
    )


def _shared_errors(
    measured: PlacedMeasures,
    fit: AffineFit,
    components: tuple[Component, ...],
    *,
    declared: AffineFit,
    active: BoolArray,
    agreeing: BoolArray,
    free: BoolArray,
    slope_px: float,
) -> SharedErrors:
    """The errors that neighbours share, of what the components leave."""
    left, of_left = declared, agreeing
    if components:
        residuals, expected = measured.residuals(fit, active), fit.expected(slope_px)
        followed = solve_displacement(residuals, components, expected, measured.shape)
        left, of_left = measured.without(followed.displacement, declared), active
    position, overlapping = measured.position, measured.overlapping
    return likeliest_shared_errors(
        left, of_left, free, slope_px, position=position, overlapping=overlapping
    )


def _left_open(
    measures: AgreeingMeasures,
    expected: Array,
    components: tuple[Component, ...],
    options: AdjustmentOptions,
    like: SceneAdjustment | None,
) -> tuple[Component, ...]:
    """What the measures leave open, of a scanned image whose motion is followed."""
    if like:
        return like.left_open
    wanted = options.profile and options.bends and options.order is None
    if not wanted or not measures.measured.scanned:
        return ()
    return measures.left_open(expected, components)


def _beside(
    moved: MovedGround,
    adjust: Callable[[ControlObservations], SceneAdjustment],
    model: SensorModel,
    observations: ControlObservations,
) -> SceneAdjustment:
    """The adjustment on measures beside ground that moved, with the residuals of all."""
    on_it = moved.measures[:, None]
    line_sample = np.where(on_it, np.nan, observations.line_sample)
    beside = adjust(replace(observations, line_sample=line_sample))
    computed = CorrectedModel(model, beside.correction).project(observations.lon_lat_h)
    residual_px = np.where(on_it, observations.line_sample - computed, beside.residual_px)
    if beside.moved:
        moved = replace(beside.moved, measures=moved.measures | beside.moved.measures)
    return replace(beside, residual_px=residual_px, moved=moved)


def _short_motion(
    measured: PlacedMeasures,
    observations: ControlObservations,
    active: BoolArray,
    displacement: DisplacementGrid | None,
) -> ShortMotion:
    """The motion within the chips of active measures (n,) that a displacement does not follow."""
    if observations.strips is None or not measured.scanned:
        return STILL
    if observations.breaks is not None:
        # Beyond a break, a chip shows other lines, not a motion.
        line, side_px = observations.line_sample[:, 0], observations.chip_side_px
        active = active & on_one_side(observations.breaks, line, side_px, 0.0)
    place, strips = measured.position_px[active], observations.strips.take(active)
    if displacement is not None:
        left_px = strips.displacement_px - strips.against(displacement, place)
        strips = replace(strips, displacement_px=left_px)
    return short_motion(strips, place, observations.chip_side_px)


def _in_held_parts(observations: ControlObservations, active: BoolArray) -> BoolArray:
    """Measures (n,) in parts of a broken image with more than two active measures."""
    if observations.breaks is None:
        return np.ones_like(active)
    line = np.nan_to_num(observations.line_sample[:, 0])
    held = held_parts(observations.breaks, line, active)
    return held[part_of_line(observations.breaks, line)]


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


def deformation_covariance(deformation_px2: Array, correction: ImageCorrection) -> Array:
    """Covariance (6, 6) of a correction by what its points are deformed by, (2, 2) line and sample."""
    return np.asarray(np.kron(deformation_px2, _deformed_parameters(correction)), np.float64)


def _deformed_parameters(correction: ImageCorrection) -> Array:
    """Covariance (3, 3) of the parameters of one coordinate by a deformation of unit variance.

    Shift, drift and skew are those of the middle of the image: a model that is far off has it far from
    the origin of its parameters.
    """
    centre = correction.centre
    t = (correction.invert(centre[None, :])[0] - centre) / correction.half_size
    moves = np.array([[1.0, 0.0, 0.0], [-t[0], 1.0, 0.0], [-t[1], 0.0, 1.0]])
    return np.asarray(moves.T @ np.diag(_DEFORMED) @ moves)
