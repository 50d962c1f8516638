"""Bundle adjustment: the parameters of all images of a block, from tie points and control."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amers.services.adjustment.block_accuracy import (
    BlockAccuracy,
    block_accuracy,
    carried_covariances,
    earth_frames,
    joint_relative,
)
from amers.services.adjustment.block_problem import BlockOptions, BlockProblem
from amers.services.adjustment.block_scale import LEAST_SCALE, check_scale, posterior_scale
from amers.services.adjustment.block_solution import checked_gauge, least_squares
from amers.services.adjustment.control_check import (
    agreeing_control,
    check_place_of_control,
    ray_coordinates,
)
from amers.services.adjustment.control_ground import NO_CONTROL, ControlGround
from amers.services.adjustment.known_images import KnownImages, known_images, tie
from amers.services.adjustment.parameters import AdjustableImage, BlockPriors, block_priors
from amers.services.adjustment.reduced_system import DENSE_ROWS, ReducedSystem
from amers.services.adjustment.robust_start import active_observations, robust_start, started
from amers.services.errors import InputError, NoConsensus
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, BoolArray, Frame, IntArray, Observations


@dataclass(frozen=True)
class BlockAdjustment:
    """A block whose images agree.

    Attributes:
        models: the images' models with their corrections.
        values: (n, k) parameters of the images; 0 where an image has fewer.
        determined: (n, k) share of every parameter that observations tell, 0 to 1; the rest is what was
            expected of it.
        accuracy: covariance of the parameters, with and without the doubt about the frame.
        slope_factor: standard deviation of drifts and skews over what was stated, by the residuals; for
            the parameters that are `estimated`.
        lon_lat_h: (p, 3) the points; NaN where they cannot be intersected.
        point_covariance_m2: (p, 3, 3) east, north, up, relative to the frame of the point's group: with
            the errors that points take over from images.
        group: (n,) group of images that points tie together; -1 for images without an observation.
        known: what a later block may be tied to: the images of the first group; None beyond 333 images.
        frames: of the groups, on the Earth. The error of a point on the Earth is that of its frame plus
            its own; the two are independent.
        residual_px: (m, 2) observed minus computed.
        active: (m,) observations within tolerance, of points with at least two such observations.
        control_active: (c,) control points that agree.
        control_misfit_m: (c, 3) known minus computed, east, north, up; NaN for unknown coordinates.
        sigma_px: a posteriori standard deviation of an observation with an a priori sigma of one.
        iterations: number of iterations.
    """

    models: tuple[SensorModel, ...]
    values: Array
    determined: Array
    accuracy: BlockAccuracy
    slope_factor: float
    lon_lat_h: Array
    point_covariance_m2: Array
    group: IntArray
    known: KnownImages | None
    frames: tuple[Frame, ...]
    residual_px: Array
    active: BoolArray
    control_active: BoolArray
    control_misfit_m: Array
    sigma_px: float
    iterations: int


_SLOPE_OBSERVATIONS = 0.3
"""Drifts and skews that what is stated of them counts for, when their variance is estimated. A pair
shows two, and those may be small by chance: counted for one, regions of 90 % hold 75 % where images
drift more."""
_ROUNDS = 15
_SETTLED = 0.02
"""Relative change of the scales at which they have settled."""


def adjust_block(
    images: Sequence[AdjustableImage],
    observations: Observations,
    *,
    control: ControlGround = NO_CONTROL,
    neighbour: KnownImages | None = None,
    passes: Sequence[BoolArray] = (),
    options: BlockOptions = BlockOptions(),
    like: BlockAdjustment | None = None,
) -> BlockAdjustment:
    """The parameters of every image for which the rays of the points intersect, on the known ground.

    Gauss-Newton on image residuals with the points eliminated (Schur complement). It begins robustly:
    every point is where most of its rays intersect, and Cauchy weights of a falling scale join images.
    Least squares on what agrees follow. The a priori sigmas and the frames of control determine what tie
    points cannot: the frame of the whole block, and the parallax of pairs.

    Args:
        images: with what may move.
        observations: m image positions of points, by point.
        control: known ground positions of some of the points.
        neighbour: images of an adjusted block, some of them also images of this one. Their adjusted
            parameters are observations here; their own observations of common points are not used again.
        passes: masks (n,) of images that may share errors, such as those of one pass; it is unknown how
            much, and the frames cover every share.
        options: thresholds.
        like: an adjustment of these images on these observations and others, whose scale and drifts
            hold: all observations are used, and none leaves.

    Raises:
        InputError: the neighbour has no image of the block, or one with another model; control points
            are of another scene; the common error of the heights of ortho-images alone is not stated.
        NotEnoughPoints: too few points can be intersected.
        NoConsensus: the residuals are too large for the sigmas of the observations, or most control
            points disagree.
        DisconnectedBlock: groups of images without common points, and without control of each.
        NoConvergence: the parameters still change after the last iteration.
    """
    tied = None if neighbour is None else tie(images, neighbour)
    common = np.zeros(len(images), dtype=np.bool_) if tied is None else tied.members(len(images))
    apart = [members & ~common for members in passes if (members & ~common).any()]
    priors = block_priors(images, apart, control.frame_covariances())
    n_points = int(observations.point[-1]) + 1 if len(observations) else 0
    problem = BlockProblem(images, observations, control, options, n_points, priors.size, tied)
    _check_heights(problem)
    if like is None:
        check_place_of_control(problem, problem.start_values())
        state, scale, active, control_active = robust_start(problem, priors)
        slope_factor = 1.0
    else:
        state, scale, slope_factor = started(problem, like.values), like.sigma_px, like.slope_factor
        active = np.ones(len(observations), dtype=np.bool_)
        control_active = np.ones(len(control), dtype=np.bool_)
        priors = priors.with_slopes(slope_factor)
    _check_control(control, control_active)
    used = active
    for _ in range(_ROUNDS):
        weight = problem.weights(active / problem.scales(max(scale, LEAST_SCALE)) ** 2, control_active)
        equations = problem.equations(state.values, state.lon_lat_h, weight)
        gauge = checked_gauge(problem, equations, state.lon_lat_h)
        solved = least_squares(problem, priors, gauge, state, weight)
        state = solved.state
        accuracy = block_accuracy(solved.system, problem.pairs, gauge, len(images) * priors.size)
        before, used, previous = used, active, (scale, slope_factor)
        square = problem.squares(state.values, state.lon_lat_h)
        determined = _determined(solved.system.priors, accuracy.variance())
        computed = used & np.isfinite(square) & ~problem.by_hand
        coordinates = ray_coordinates(problem, solved.equations, solved.points)
        # What people marked determines the parameters as well.
        own = float(determined.sum()) * float(computed.sum()) / max(float(used.sum()), 1.0)
        scale = posterior_scale(square[computed], observations.point[computed], coordinates, own)
        check_scale(scale)
        factor = _slope_factor(state.values.ravel(), solved.system.priors, determined, slope_factor)
        active = active_observations(
            problem, square, used, scale, control_active, coordinates=coordinates
        )
        used_control, control_active = (
            control_active,
            agreeing_control(problem, solved.equations, solved.points, accuracy, control_active),
        )
        # Observations at the limit of the tolerance would come back and leave for ever: they stay out.
        again = np.array_equal(active, before) and bool((used <= active).all())
        same = again or np.array_equal(active, used)
        settled = same and np.array_equal(control_active, used_control)
        settled = settled and np.allclose((scale, slope_factor * factor), previous, rtol=_SETTLED)
        if settled or like is not None:
            break
        priors, slope_factor = priors.with_slopes(factor), slope_factor * factor
    # Known ground that no image shows any more, as its rays have left, takes no part.
    shown = np.isin(control.point, observations.point[used])
    used_control = used_control & shown
    # A height alone contradicts nothing where no two rays show its point.
    _check_control(control, used_control | ~shown & ~control.known[:, :2].any(axis=1))
    of_points = np.full(n_points, -1)
    of_points[observations.point[used][::-1]] = gauge.group[observations.image[used][::-1]]
    carried_m2 = carried_covariances(solved.equations, solved.points, accuracy, of_points)
    intersected = (of_points >= 0) & np.isfinite(solved.points.inverse[:, 0, 0])
    relative_m2 = solved.points.inverse + carried_m2
    frames = [
        replace(frame, shared_m2=carried_m2[intersected & (of_points == group)].mean(axis=0))
        for group, frame in enumerate(earth_frames(accuracy, solved.system.priors, images, passes, tied))
    ]
    residual = problem.equations(state.values, state.lon_lat_h).residual
    lon_lat_h = state.lon_lat_h.copy()
    lon_lat_h[:, 0] -= 360.0 * np.round(lon_lat_h[:, 0] / 360.0)
    misfit_m = problem.control_misfit_m(state.values, state.lon_lat_h)
    n_images = len(images)
    return BlockAdjustment(
        models=tuple(
            image.corrected(found[: len(image.sigma)])
            for image, found in zip(images, state.values[:n_images], strict=True)
        ),
        values=state.values[:n_images],
        determined=determined.reshape(state.values.shape)[:n_images],
        accuracy=accuracy,
        slope_factor=slope_factor,
        lon_lat_h=np.where(intersected[:, None], lon_lat_h, np.nan),
        point_covariance_m2=np.where(intersected[:, None, None], relative_m2, np.nan),
        group=gauge.group[:n_images],
        known=_known(images, state.values, gauge.group, frames, of=(solved.system, accuracy)),
        frames=tuple(frames),
        residual_px=problem.image_rows(residual) * observations.sigma_px[:, None],
        active=used & intersected[observations.point],
        control_active=used_control,
        control_misfit_m=np.where(control.known, misfit_m, np.nan),
        sigma_px=scale,
        iterations=state.iterations,
    )


def _known(
    images: Sequence[AdjustableImage],
    values: Array,
    group: IntArray,
    frames: Sequence[Frame],
    *,
    of: tuple[ReducedSystem, BlockAccuracy],
) -> KnownImages | None:
    """The images of the first group with the covariance of all their parameters."""
    n, size = len(images), values.shape[1]
    rows = np.flatnonzero(group[:n] == 0)
    if values.size > DENSE_ROWS:
        return None
    own = max(len(images[row].sigma) for row in rows.tolist())
    inside = (rows[:, None] * size + np.arange(own)).ravel()
    relative = joint_relative(*of)[np.ix_(inside, inside)]
    members = [images[row] for row in rows.tolist()]
    return known_images(members, values[rows, :own], relative, frames[0])


def _determined(priors: BlockPriors, variance: Array) -> Array:
    """Share (K,) of every parameter that observations determine, the rest being its prior."""
    return np.clip(1.0 - variance * (priors.locating.diagonal() + priors.shape), 0.0, 1.0)


def _slope_factor(values: Array, priors: BlockPriors, determined: Array, so_far: float) -> float:
    """By how much the standard deviation of drifts and skews changes (MacKay's fixed point)."""
    slopes = priors.estimated & (priors.shape > 0.0)
    if not slopes.any():
        return 1.0
    stated = priors.shape[slopes] * so_far**2
    found = float((values[slopes] ** 2 * stated).sum())
    freedom = _SLOPE_OBSERVATIONS + float(determined[slopes].sum())
    # Few slopes tell their variance badly: regions of Student's law, relative to the normal law's.
    few = freedom * (0.1 ** (-2.0 / freedom) - 1.0) / (2.0 * np.log(10.0))
    return float(np.sqrt((_SLOPE_OBSERVATIONS + found) / freedom * few) / so_far)


def _check_heights(problem: BlockProblem) -> None:
    """Refuse a block of ortho-images alone where the common error of their heights is not stated."""
    control = problem.control
    stated = [np.isfinite(frame.covariance_m2[2, 2]) for frame in control.frames]
    known = control.known[:, 2] & np.array(stated, dtype=np.bool_)[control.source]
    if problem.flat.all() and control.known[:, 2].any() and not known.any():
        raise InputError(
            "the heights of ortho-images alone come from elevation models, whose common error is not "
            "stated: give it with --control-dem-frame-sigma-m HORIZONTAL,UP"
        )


def _check_control(control: ControlGround, active: BoolArray) -> None:
    if active.sum() * 2 < len(control):
        names = ", ".join(name for name, agrees in zip(control.names, active, strict=True) if not agrees)
        raise NoConsensus(
            f"{len(control) - active.sum()} of {len(control)} control points disagree with the block "
            f"and with each other: {names}. State larger sigmas or a larger frame, or "
            "remove wrong points"
        )
