"""Bundle adjustment: the parameters of all images of a block, from tie points and control."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amers.services.adjustment.block_accuracy import (
    BlockAccuracy,
    earth_frames,
    joint_relative,
)
from amers.services.adjustment.block_parts import Parts, block_parts
from amers.services.adjustment.block_problem import BlockOptions, BlockProblem
from amers.services.adjustment.block_solution import point_covariances
from amers.services.adjustment.control_check import check_place_of_control
from amers.services.adjustment.control_ground import NO_CONTROL, ControlGround
from amers.services.adjustment.known_images import KnownImages, known_images, tie
from amers.services.adjustment.parameters import AdjustableImage, BlockPriors, block_priors
from amers.services.adjustment.reduced_system import DENSE_ROWS, ReducedSystem
from amers.services.adjustment.robust_start import robust_start, started
from amers.services.adjustment.settled_block import Round, Weighing, settled
from amers.services.errors import InputError, NoConsensus, UndeterminedCorrection
from amers.services.sensors.base import SensorModel
from amers.services.tasks import Work
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
        point_shared_m2: (p, 3, 3) these errors alone, which neighbouring points share: bends and tilts
            of the whole block.
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
    point_shared_m2: Array
    group: IntArray
    known: KnownImages | None
    frames: tuple[Frame, ...]
    residual_px: Array
    active: BoolArray
    control_active: BoolArray
    control_misfit_m: Array
    sigma_px: float
    iterations: int


def adjust_block(
    images: Sequence[AdjustableImage],
    observations: Observations,
    *,
    control: ControlGround = NO_CONTROL,
    neighbour: KnownImages | None = None,
    passes: Sequence[BoolArray] = (),
    options: BlockOptions = BlockOptions(),
    like: BlockAdjustment | None = None,
    work: Work | None = None,
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
        work: computes the parts of a large block (`block_parts`); by default in this process.

    Raises:
        InputError: the neighbour has no image of the block, or one with another model; control points
            are of another scene; the common error of the heights of ortho-images alone is not stated.
        NotEnoughPoints: too few points can be intersected.
        NoConsensus: the residuals are too large for the sigmas of the observations, or most control
            points disagree.
        DisconnectedBlock: groups of images without common points, and without control of each.
        NoConvergence: the parameters still change after the last iteration.
        UndeterminedCorrection: nothing determines the place of the block, such as one image on control
            points whose frame is unknown.
    """
    tied = None if neighbour is None else tie(images, neighbour)
    common = np.zeros(len(images), dtype=np.bool_) if tied is None else tied.members(len(images))
    apart = [members & ~common for members in passes if (members & ~common).any()]
    priors = block_priors(images, apart, control.frame_covariances())
    n_points = int(observations.point[-1]) + 1 if len(observations) else 0
    problem = BlockProblem(images, observations, control, options, n_points, priors.size, tied)
    _check_heights(problem)
    parts = block_parts(problem, work, (priors.apart.data, priors.shared.data, priors.mean))
    try:
        start = _start(parts, priors, like)
        _check_control(control, start.control_active)
        return _stated(parts, settled(parts, start, once=like is not None), passes)
    except np.linalg.LinAlgError:
        raise UndeterminedCorrection(
            f"{len(images)} images and {len(control)} control points leave the place of the block open: "
            "state the common error of the control points on the Earth (--control-frame-sigma-m), or "
            "add images or control points"
        ) from None


def _start(parts: Parts, priors: BlockPriors, like: BlockAdjustment | None) -> Weighing:
    """A robust solution, or all observations on what an adjustment of more of them has found."""
    problem = parts.problem
    if like is None:
        check_place_of_control(problem, problem.start_values())
        state, scale, active, control_active = robust_start(parts, priors)
        return Weighing(state, priors, scale, 1.0, active, control_active)
    return Weighing(
        started(parts, like.values),
        priors.with_slopes(like.slope_factor),
        like.sigma_px,
        like.slope_factor,
        np.ones(len(problem.observations), dtype=np.bool_),
        np.ones(len(problem.control), dtype=np.bool_),
    )


def _stated(parts: Parts, last: Round, passes: Sequence[BoolArray]) -> BlockAdjustment:
    """What the last least squares state of images, points and frames."""
    problem = parts.problem
    images, observations, control = problem.images, problem.observations, problem.control
    solved, state, accuracy, group = last.solved, last.solved.state, last.accuracy, last.gauge.group
    used = last.before.active
    control_active = _shown_control(control, observations.point[used], last.before.control_active)
    of_points = np.full(problem.n_points, -1)
    of_points[observations.point[used][::-1]] = group[observations.image[used][::-1]]
    carried_m2, relative_m2, residual_px = point_covariances(
        parts, solved.normals, state.place, accuracy, of_points
    )
    residual_px *= observations.sigma_px[:, None]
    intersected = (of_points >= 0) & solved.normals.determined
    on_earth = earth_frames(accuracy, solved.system.priors, images, passes, problem.tie)
    frames = tuple(
        replace(frame, shared_m2=carried_m2[intersected & (of_points == number)].mean(axis=0))
        for number, frame in enumerate(on_earth)
    )
    lon_lat_h = state.lon_lat_h.copy()
    lon_lat_h[:, 0] -= 360.0 * np.round(lon_lat_h[:, 0] / 360.0)
    for of_point in (lon_lat_h, carried_m2, relative_m2):
        of_point[~intersected] = np.nan
    of_control_m = problem.control_misfit_m(state.values, state.lon_lat_h)
    return BlockAdjustment(
        models=tuple(
            image.corrected(found[: len(image.sigma)])
            for image, found in zip(images, state.values[: len(images)], strict=True)
        ),
        values=state.values[: len(images)],
        determined=last.determined.reshape(state.values.shape)[: len(images)],
        accuracy=accuracy,
        slope_factor=last.before.slope_factor,
        lon_lat_h=lon_lat_h,
        point_covariance_m2=relative_m2,
        point_shared_m2=carried_m2,
        group=group[: len(images)],
        known=_known(images, state.values, group, frames, of=(solved.system, accuracy)),
        frames=frames,
        residual_px=residual_px,
        active=used & intersected[observations.point],
        control_active=control_active,
        control_misfit_m=np.where(control.known, of_control_m, np.nan),
        sigma_px=last.after.scale,
        iterations=state.iterations,
    )


def _shown_control(control: ControlGround, seen: IntArray, active: BoolArray) -> BoolArray:
    """Active control (c,) whose points are `seen`: what no image shows any more takes no part."""
    shown = np.isin(control.point, seen)
    # A height alone contradicts nothing where no two rays show its point.
    _check_control(control, active & shown | ~shown & ~control.known[:, :2].any(axis=1))
    return active & shown


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
            f"and with each other: {names}. State larger sigmas or a larger common error, or "
            "remove wrong points"
        )
