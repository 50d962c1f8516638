"""Least squares of scenes adjusted together, on tie points between them and control points."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amers.services.adjustment.block_problem import BlockOptions
from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.known_images import KnownImages
from amers.services.adjustment.parameters import AdjustableImage, ImageParameters, image_parameters
from amers.services.adjustment.rigorous_parameters import rigorous_parameters
from amers.services.imagery.scene import scene_gsd_m
from amers.services.joint.measured import MeasuredScene
from amers.services.quality.frames import why_unknown
from amers.services.registration.options import RegistrationOptions
from amers.services.sensors.base import SensorModel
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.sensors.parameter_sets import ParameterSet
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.types import (
    Array,
    BoolArray,
    Frame,
    IntArray,
    Observations,
    joined_observations,
)

_FREE_SLOPE_PX = 1000.0
"""A priori standard deviation of drift and skew where their order is given."""
_ALIKE = 4
"""Nodes of a displacement, on each side of a place, over which it errs alike: half of its length."""
_GRID = 5
"""Places a side of an image at which covariances are compared."""


@dataclass(frozen=True)
class JointBlock:
    """Scenes with all that they observe, and their adjustment.

    Attributes:
        scenes: the n scenes.
        images: what may move.
        shared: (n,) variance of the control of every scene over what is stated; see `_shared_factor`.
        ties: m observations of tie points, with sigmas as the residuals show them.
        rows: for every scene, the points (k,) of its search that are observed.
        at: for every scene, rows (k,) of these among all observations.
        control: the known ground of all observed control points.
        held_by: for every scene, rows (k,) of its points among `control`.
        adjustment: of all observations: those of ties, then those of control points.
        tie_sigma: factor of the stated sigmas of tie points.
    """

    scenes: tuple[MeasuredScene, ...]
    images: tuple[AdjustableImage, ...]
    shared: Array
    ties: Observations
    rows: tuple[IntArray, ...]
    at: tuple[IntArray, ...]
    control: ControlGround
    held_by: tuple[IntArray, ...]
    adjustment: BlockAdjustment
    tie_sigma: float = 1.0

    def values(self, scene: int) -> Array:
        """The parameters (k,) of a scene."""
        return self.adjustment.values[scene, : len(self.images[scene].sigma)]

    def model(self, scene: int) -> SensorModel:
        """The adjusted model of a scene."""
        return self.images[scene].corrected(self.values(scene))

    def active(self, scene: int) -> BoolArray:
        """Points (k,) of the search of a scene that the adjustment uses."""
        active = np.zeros(len(self.scenes[scene].search.points), dtype=np.bool_)
        agrees = self.adjustment.active[self.at[scene]]
        agrees &= self.adjustment.control_active[self.held_by[scene]]
        active[self.rows[scene]] = agrees
        return active

    def of_ties(self, scene: int) -> IntArray:
        """Rows of the observations of tie points in a scene."""
        return np.flatnonzero(self.ties.image == scene)

    def covariance(self, scene: int) -> Array:
        """Covariance (k, k) of the parameters of a scene, relative to the control points."""
        accuracy, k = self.adjustment.accuracy, len(self.images[scene].sigma)
        own = accuracy.covariance()[accuracy.pairs.start[scene]]
        return np.asarray(own[:k, :k])


def adjust_together(
    scenes: Sequence[MeasuredScene],
    ties: Observations,
    options: RegistrationOptions = RegistrationOptions(),
    *,
    neighbour: KnownImages | None = None,
) -> JointBlock:
    """The block of scenes on their control points and tie points.

    The block lies in the frame of the control points: their own errors are errors of the result, that of
    their frame is not. It is adjusted twice: the first residuals show how precise tie points are.

    Args:
        scenes: with their control points.
        ties: of the scenes, by their order.
        options: of the correction.
        neighbour: scenes that were adjusted before, some of which are among these.

    Raises:
        ComputationError: the observations do not allow a solution.
    """
    known = [neighbour.displacement(one.name) if neighbour else None for one in scenes]
    images = tuple(
        _image(one, one.displacement or before, options)
        for one, before in zip(scenes, known, strict=True)
    )
    rows = [np.flatnonzero(measured.usable) for measured in scenes]
    shared = np.array([_shared_factor(one, _correction(one, None, options)) for one in scenes])
    ties = _with_displacements([image.displacement for image in images], ties)
    block = _adjusted(scenes, images, shared, ties, neighbour, rows=rows)
    if not len(ties):
        return block
    factor = block.adjustment.sigma_px
    shown = replace(ties, sigma_px=ties.sigma_px * factor)
    again = _adjusted(scenes, images, shared, shown, neighbour, rows=rows)
    return replace(again, tie_sigma=factor)


def repeated(block: JointBlock, held: Sequence[IntArray], neighbour: KnownImages | None) -> JointBlock:
    """The block adjusted without some control points of its scenes, on what agrees of the others.

    Args:
        block: adjusted.
        held: for every scene, those of its control points that are held out.
        neighbour: see `adjust_together`.
    """
    ties = block.ties.take(np.flatnonzero(block.adjustment.active[: len(block.ties)]))
    ties = replace(ties, point=np.unique(ties.point, return_inverse=True)[1].astype(np.int64))
    rows = [
        np.flatnonzero(block.active(number) & ~np.isin(measured.search.rows, held[number]))
        for number, measured in enumerate(block.scenes)
    ]
    return _adjusted(
        block.scenes, block.images, block.shared, ties, neighbour, rows=rows, like=block.adjustment
    )


def with_parameter_sets(
    block: JointBlock,
    sets: Sequence[ParameterSet | None],
    options: RegistrationOptions,
    neighbour: KnownImages | None,
) -> JointBlock:
    """The block adjusted again with other terms of rigorous models free, on the same observations.

    Args:
        block: adjusted.
        sets: for every scene; None for one with a correction in the image.
        options, neighbour: see `adjust_together`.

    Raises:
        ComputationError: the observations do not allow a solution.
    """
    scenes = [
        replace(measured, scene=replace(measured.scene, parameter_set=own))
        for measured, own in zip(block.scenes, sets, strict=True)
    ]
    images = tuple(
        _image(measured, image.displacement, options)
        for measured, image in zip(scenes, block.images, strict=True)
    )
    return _adjusted(scenes, images, block.shared, block.ties, neighbour, rows=block.rows)


def _adjusted(
    scenes: Sequence[MeasuredScene],
    images: tuple[AdjustableImage, ...],
    shared: Array,
    ties: Observations,
    neighbour: KnownImages | None,
    *,
    rows: Sequence[IntArray],
    like: BlockAdjustment | None = None,
) -> JointBlock:
    """The block of some of the control points (`rows` of the search of every scene) and tie points."""
    first = int(ties.point.max(initial=-1)) + 1
    found, control, place = _control(scenes, shared, rows, first)
    common = neighbour and not set(neighbour.names).isdisjoint(image.name for image in images)
    adjustment = adjust_block(
        images,
        joined_observations([ties, found]),
        control=control,
        neighbour=neighbour if common else None,
        options=BlockOptions(min_points=1),
        like=like,
    )
    order = np.argsort(place, kind="stable")
    ends = np.cumsum([len(own) for own in rows])[:-1]
    at = np.split(len(ties) + np.argsort(order, kind="stable"), ends)
    held_by = np.split(place, ends)
    return JointBlock(
        tuple(scenes), images, shared, ties, tuple(rows), tuple(at), control, tuple(held_by), adjustment
    )


def _image(
    measured: MeasuredScene, displacement: DisplacementGrid | None, options: RegistrationOptions
) -> AdjustableImage:
    """What may move in a scene: by what it is stated to be off, and by what its own points show."""
    scene, correction = measured.scene, _correction(measured, displacement, options)
    if scene.parameter_set is None or not isinstance(scene.model, PushbroomModel):
        return correction
    sigma_m = float(correction.prior_px[0, 0]) * scene_gsd_m(scene)
    return rigorous_parameters(
        measured.name, scene.model, scene.parameter_set, sigma_m=sigma_m, motion=measured.motion
    )


def _correction(
    measured: MeasuredScene, displacement: DisplacementGrid | None, options: RegistrationOptions
) -> ImageParameters:
    """What may move in a scene that has a correction in the image."""
    scene, alone = measured.scene, measured.alone
    shift_px, slope_px = scene.sigma_m / scene_gsd_m(scene), options.adjustment.prior_slope_sigma_px
    if alone is not None:
        shift_px = float(np.hypot(shift_px, np.abs(alone.correction.parameters[:, 0]).max()))
        slope_px = alone.slope_px
    order = options.adjustment.order
    return image_parameters(
        measured.name,
        scene.model,
        scene.image.shape,
        shift_px=shift_px,
        slope_px=_FREE_SLOPE_PX if order else slope_px,
        order=order or "affine",
        displacement=displacement,
    )


def _with_displacements(
    displacements: Sequence[DisplacementGrid | None], ties: Observations
) -> Observations:
    """Tie points, as uncertain as the displacements of their scenes make them.

    Tie points on the same lines share the error of the displacement: together they tell no more than one
    of them.
    """
    variance_px2 = ties.sigma_px**2
    for number, displacement in enumerate(displacements):
        if displacement is not None:
            own = ties.image == number
            place = ties.line_sample[own]
            error_px2 = displacement.variance_at(place).mean(axis=1)
            variance_px2[own] += error_px2 * _sharing(displacement, place)
    return replace(ties, sigma_px=np.sqrt(variance_px2))


def _sharing(displacement: DisplacementGrid, place: Array) -> Array:
    """How many of positions (n, 2) lie so near to each that a displacement errs alike there."""
    count = np.ones(len(place))
    for at, nodes in zip(place.T, (displacement.line, displacement.sample), strict=True):
        if len(nodes) > 2:
            ordered, reach = np.sort(at), _ALIKE * (nodes[-1] - nodes[0]) / (len(nodes) - 1)
            near = np.searchsorted(ordered, at + reach) - np.searchsorted(ordered, at - reach)
            count = np.maximum(count, near)
    return count


def _control(
    scenes: Sequence[MeasuredScene],
    factor: Array,
    rows: Sequence[IntArray],
    first: int,
) -> tuple[Observations, ControlGround, IntArray]:
    """Observations of control points, by point, their known ground, and its row for every one of `rows`.

    A control point that several scenes show is one point, whose error they share.
    """
    parts = [measured.search.points.take(own) for measured, own in zip(scenes, rows, strict=True)]
    identity = np.concatenate([part.id for part in parts])
    _, index, place = np.unique(identity, return_index=True, return_inverse=True)
    image = np.repeat(np.arange(len(scenes)), [len(own) for own in rows])
    counts = np.bincount(place, minlength=len(index))
    of_point = np.bincount(place, factor[image], len(index)) / np.maximum(counts, 1)
    line_sample = np.concatenate([m.line_sample()[own] for m, own in zip(scenes, rows, strict=True)])
    sigma_px = np.concatenate(
        [m.search.matches.sigma_px[own] for m, own in zip(scenes, rows, strict=True)]
    )
    order = np.argsort(place, kind="stable")
    block = np.concatenate([part.block for part in parts])[index]
    covariance_m2 = np.concatenate([part.covariance_m2 for part in parts])[index]
    control = ControlGround(
        point=first + np.arange(len(index)),
        lon_lat_h=np.concatenate([part.lon_lat_h for part in parts])[index],
        covariance_m2=covariance_m2 * of_point[:, None, None],
        source=block,
        frames=_frames(scenes, block),
        names=tuple(str(one) for one in identity[index]),
        by_hand=identity[index] < 0,
    )
    found = Observations(
        first + place[order],
        image[order],
        line_sample[order],
        (sigma_px * np.sqrt(factor[image]))[order],
    )
    return found, control, place.astype(np.int64)


def _frames(scenes: Sequence[MeasuredScene], block: IntArray) -> tuple[Frame, ...]:
    """The frames of blocks of control points, as seen from the block of most of them.

    What the block of most points is off by is not seen. Another one lies apart by the errors of both;
    where these are not stated, by a pixel, as for one scene alone.
    """
    stated = scenes[0].points.frames
    if not len(block):
        return ()
    counts = np.bincount(block, minlength=len(stated))
    most = int(counts.argmax())
    datum = stated[most]
    pixel_m = float(np.median([scene_gsd_m(measured.scene) for measured in scenes]))
    unstated = Frame.from_sigmas(pixel_m, pixel_m)
    frames = []
    for number, frame in enumerate(stated):
        if number == most:
            frames.append(Frame(np.zeros((3, 3))))
        elif why_unknown(frame) or why_unknown(datum):
            frames.append(unstated)
        else:
            frames.append(
                Frame(frame.covariance_m2 + datum.covariance_m2, assumed=frame.assumed or datum.assumed)
            )
    return tuple(frames)


def _shared_factor(measured: MeasuredScene, image: ImageParameters) -> float:
    """Variance of the control of a scene over what is stated, for errors taken to be independent.

    Errors that neighbouring points share do not average out. The adjustment of the scene alone knows
    them; that of the block takes all errors to be independent, and larger, so that both state the same.
    """
    alone = measured.alone
    if alone is None:
        return 1.0
    if alone.apart_px > 0.0:
        return alone.shared.factor
    seen = measured.observations()
    rows = np.flatnonzero(alone.active)
    derivative = measured.scene.model.project_derivative(seen.lon_lat_h[rows])
    of_points = derivative @ seen.covariance_m2[rows] @ derivative.transpose(0, 2, 1)
    variance = seen.sigma_px[rows, None] ** 2 + np.diagonal(of_points, 0, 1, 2)
    design = image.design(measured.scene.model.project(seen.lon_lat_h[rows]))
    normal = np.einsum("nck,nc,ncl->kl", design, 1.0 / variance, design) + np.diag(image.sigma**-2.0)
    side = np.linspace(-1.0, 1.0, _GRID)
    t = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    at = image.design(image.zero.centre + t * image.zero.half_size)
    free = image.free.ravel()
    known = (alone.covariance - alone.deformation)[np.ix_(free, free)]
    if seen.common_covariance_px2 is not None:
        shifts = np.flatnonzero(image.locating)
        known[np.ix_(shifts, shifts)] -= seen.common_covariance_px2
    stated = np.einsum("nck,kl,ncl->", at, np.linalg.inv(normal), at)
    return float(max(1.0, np.einsum("nck,kl,ncl->", at, known, at) / stated))
