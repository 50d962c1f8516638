"""Least-squares estimate of the image correction of one scene, from known ground points.

Drift and skew that are too small to be seen beside the errors of the points still exist. They are not
fixed at zero: their a priori standard deviation is estimated from the measures (empirical Bayes), and
their covariance states what remains undetermined. So it is with an offset for each block, where the
points come from several. The covariance holds what the residuals show of errors that neighbours share:
see `shared_errors`. They are errors of the points and of the image, in the proportion of their declared
variances; those of the image remain at every place of it.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from amers.services.misfit.affine_start import AffineStart, affine_start
from amers.services.misfit.broken_image import held_parts, part_of_line
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.displacement_components import Component
from amers.services.misfit.displacement_solution import solve_displacement
from amers.services.misfit.moved_ground import MovedGround, moved_ground
from amers.services.misfit.placed_measures import PlacedMeasures
from amers.services.misfit.scene_adjustment import AdjustmentOptions, SceneAdjustment
from amers.services.misfit.scene_motion import SceneMotion, what_moves
from amers.services.misfit.scene_solution import AgreeingMeasures
from amers.services.misfit.shared_errors import SharedErrors, likeliest_shared_errors
from amers.services.misfit.structure import unfollowed_variance_px2
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from amers.services.types import Array, BoolArray, IntArray

_DEFORMED = 0.5, 1.0, 1.0
"""Variances of shift, drift and skew that follow a deformation of the points, over its mean variance.

A linear deformation of a block as large as the scene has a drift and a skew of 1.5; in a larger block
it is mostly a shift of 1. This lies between: 0.5 in the middle of the scene, 2.5 at its corners."""


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
    fewest = options.min_points if min_points is None else min_points
    again = partial(
        adjust_scene, model, shape, options=options, min_points=fewest, ground_may_move=ground_may_move
    )
    if like and like.moved:
        return _beside(like.moved, partial(again, like=replace(like, moved=None)), model, observations)
    start = affine_start(model, shape, observations, options, min_points=fewest, like=like)
    fit, declared, limit = start.fit, start.declared, options.tolerance
    measured = PlacedMeasures.of(model, shape, observations, fit=declared, of_points=start.of_points)
    motion = _motion(measured, start, options, observations.breaks, like)
    if ground_may_move:
        clipped = start.clipped(limit)
        ground = moved_ground(measured, fit, clipped, motion, seen=start.seen, tolerance=limit)
        if ground and (start.usable & ~ground.measures).sum() >= fewest:
            return _beside(ground, again, model, observations)
    active = _active(measured, start, motion, observations, tolerance=limit, like=like)
    shared = like.shared if like else _shared_errors(measured, start, motion.components, active)
    agreeing = AgreeingMeasures(measured, fit, declared, active, shared, limit)
    left_open = _left_open(agreeing, start.expected, motion.components, options, like)
    return _solved(agreeing, left_open, start, motion, observations, like=like)


def _motion(
    measured: PlacedMeasures,
    start: AffineStart,
    options: AdjustmentOptions,
    breaks: IntArray | None,
    like: SceneAdjustment | None,
) -> SceneMotion:
    """What no affine correction follows, as far as the options want it followed."""
    if like:
        return SceneMotion(like.components, (), start.active)
    if not options.profile or options.order is not None:
        components, along_axes = measured.components(start.fit, start.active, wanted=False)
        return SceneMotion(components, along_axes, start.active)
    return what_moves(
        measured,
        start.fit,
        start.parameters,
        start.clipped(options.tolerance),
        seen=start.seen,
        active=start.active,
        breaks=breaks,
        tolerance=options.tolerance,
    )


def _active(
    measured: PlacedMeasures,
    start: AffineStart,
    motion: SceneMotion,
    observations: ControlObservations,
    *,
    tolerance: float,
    like: SceneAdjustment | None,
) -> BoolArray:
    """Measures (n,) that agree with the correction and what it follows beyond an affine one."""
    if not motion.components:
        return start.active
    rows = start.seen if like is None else start.usable
    active = measured.agreeing(start.fit, rows, motion.components, start.expected, tolerance)
    return active & _in_held_parts(observations, active)


def _shared_errors(
    measured: PlacedMeasures,
    start: AffineStart,
    components: tuple[Component, ...],
    active: BoolArray,
) -> SharedErrors:
    """The errors that neighbours share, of what the components leave."""
    left, of_left = start.declared, start.agreeing
    if components:
        residuals = measured.residuals(start.fit, active)
        followed = solve_displacement(residuals, components, start.expected, measured.shape)
        left, of_left = measured.without(followed.displacement, start.declared), active
    position, overlapping = measured.position, measured.overlapping
    return likeliest_shared_errors(
        left, of_left, start.free, start.slope_px, position=position, overlapping=overlapping
    )


def _solved(
    measures: AgreeingMeasures,
    left_open: tuple[Component, ...],
    start: AffineStart,
    motion: SceneMotion,
    observations: ControlObservations,
    *,
    like: SceneAdjustment | None,
) -> SceneAdjustment:
    """The last least squares on the measures that agree, and what it states."""
    measured, active, components = measures.measured, measures.active, motion.components
    if components or left_open:
        solution = measures.displaced(start.expected, (*components, *left_open))
    else:
        solution = measures.affine(start.free, start.slope_px)
    displacement, covariance = solution.displacement, solution.covariance
    correction = replace(
        no_correction(measured.shape), parameters=solution.parameters[:, :3], displacement=displacement
    )
    if observations.common_covariance_px2 is not None:
        covariance[np.ix_([0, 3], [0, 3])] += observations.common_covariance_px2
    deformation = np.zeros((6, 6))
    if observations.deformation_px2 is not None:
        deformation = deformation_covariance(observations.deformation_px2, correction)
    explained = measured.without(displacement, start.fit) if displacement else start.fit
    design = np.column_stack([np.ones(len(explained.t)), explained.t])
    misfit_px = explained.misfit - design @ correction.parameters.T
    of_image = np.median((1.0 - start.of_points / start.declared.variance)[active], axis=0)
    local_px2 = measures.shared.clear_share * of_image * np.mean(misfit_px[active] ** 2, axis=0)
    tested = (
        like.structures
        if like
        else measured.structures(start.fit, active, components, measures.shared, motion.along_axes)
    )
    unfollowed = unfollowed_variance_px2(tested, of_image)
    return SceneAdjustment(
        correction=correction,
        order=start.order,
        validation_px=start.validation_px,
        slope_px=start.slope_px,
        covariance=covariance + deformation,
        deformation=deformation,
        local_sigma_px=np.sqrt(np.maximum(local_px2, unfollowed)),
        shared=measures.shared,
        apart_px=start.apart_px,
        residual_px=np.where((start.usable | active)[:, None], misfit_px, np.nan),
        active=active,
        sigma0=solution.sigma0,
        point_sigma_px=np.sqrt(start.of_points[active].mean(axis=0)),
        components=components,
        left_open=left_open,
        structures=tested,
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


def _in_held_parts(observations: ControlObservations, active: BoolArray) -> BoolArray:
    """Measures (n,) in parts of a broken image with more than two active measures."""
    if observations.breaks is None:
        return np.ones_like(active)
    line = np.nan_to_num(observations.line_sample[:, 0])
    held = held_parts(observations.breaks, line, active)
    return held[part_of_line(observations.breaks, line)]


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
