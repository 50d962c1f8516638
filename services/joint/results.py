"""The result of each scene of a block: its correction with covariance, its measures, its quality."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amers.services.adjustment.parameter_figures import (
    ParameterFigure,
    held_parameters,
    parameter_figures,
)
from amers.services.adjustment.rigorous_parameters import RigorousParameters
from amers.services.conventions import CHIP_SIZE
from amers.services.imagery.scene import scene_gsd_m
from amers.services.joint.block import JointBlock
from amers.services.joint.model_errors import of_left_out_terms, of_rpc
from amers.services.joint.nearest import nearest_correction, scene_heights_m
from amers.services.misfit.control_observations import declared_fit
from amers.services.misfit.image_correction import deformation_covariance
from amers.services.misfit.placed_measures import PlacedMeasures
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.misfit.shared_errors import SharedErrors
from amers.services.misfit.structure import unfollowed_variance_px2
from amers.services.quality.cell_stability import cell_stability_of, cells_of
from amers.services.quality.findings import with_findings
from amers.services.quality.frames import shared_frame, weighted_frame
from amers.services.quality.marks import marks_beside_points
from amers.services.quality.qualification import QualificationOptions, qualify_repeated
from amers.services.quality.stability import AdjustedScene, Repetition, stability_of
from amers.services.registration.on_points import Registration
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.point_results import point_results
from amers.services.registration.search import shears_of_active
from amers.services.sensors.moving_pushbroom import AttitudeMotion, attitude_motion
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.refined import CARRIED_PX, RefinedRpc, refined_rpc
from amers.services.types import Array, BoolArray, IntArray, Measures

_INDEPENDENT = SharedErrors(1.0, np.zeros(3), 0.0)


def scene_adjustment(block: JointBlock, number: int, options: RegistrationOptions) -> SceneAdjustment:
    """The correction of one scene of a block, as that of a scene alone is stated.

    That of a rigorous model is the nearest to it; residuals are those of the adjusted model itself, at
    the known ground. The covariance is that of the block, with the errors that
    the measures of the scene share, and with what the points are deformed by.
    """
    measured, nearest = block.scenes[number], nearest_correction(block, number)
    corrected = block.model(number)
    correction, alone = nearest.correction, measured.alone
    rigorous = isinstance(corrected, PushbroomModel)
    active = block.active(number)
    seen = measured.observations()
    covariance = nearest.covariance
    if active.any() and seen.common_covariance_px2 is not None:
        covariance[np.ix_([0, 3], [0, 3])] += seen.common_covariance_px2
    deformation = np.zeros((6, 6))
    if active.any() and seen.deformation_px2 is not None:
        deformation = deformation_covariance(seen.deformation_px2, correction)
    residual_px = measured.line_sample() - corrected.project(seen.lon_lat_h)
    derivative = measured.scene.model.project_derivative(seen.lon_lat_h)
    projected = derivative @ seen.covariance_m2 @ derivative.transpose(0, 2, 1)
    of_points = np.diagonal(projected, 0, 1, 2)
    normalised = residual_px**2 / (seen.sigma_px[:, None] ** 2 + of_points)
    return SceneAdjustment(
        correction=correction,
        order=options.adjustment.order or (alone.order if alone and not rigorous else "affine"),
        validation_px=alone.validation_px if alone and not rigorous else (),
        slope_px=alone.slope_px if alone else options.adjustment.prior_slope_sigma_px,
        covariance=covariance + deformation,
        deformation=deformation,
        local_sigma_px=np.hypot(alone.local_sigma_px if alone else 0.0, nearest.local_px),
        shared=alone.shared if alone else _INDEPENDENT,
        apart_px=alone.apart_px if alone else 0.0,
        residual_px=np.where(measured.usable[:, None], residual_px, np.nan),
        active=active,
        sigma0=float(np.sqrt(normalised[active].mean())) if active.any() else 1.0,
        point_sigma_px=np.sqrt(of_points[active].mean(axis=0)) if active.any() else np.zeros(2),
        components=alone.components if alone and measured.motion else (),
    )


def _with_structures(block: JointBlock, number: int, adjustment: SceneAdjustment) -> SceneAdjustment:
    """The adjustment of a scene, with what the residuals of its control points still depend on.

    Nothing of a block follows that: it is part of the accuracy of every place.
    """
    measured, adjusted = block.scenes[number], block.model(number)
    if not adjustment.active.any():
        return adjustment
    # Components lie where the delivered model places the lines; the affine part is projected out.
    model = adjusted if isinstance(adjusted, PushbroomModel) else measured.scene.model
    seen, shape = measured.observations(), measured.scene.image.shape
    fit, _, of_points = declared_fit(model, shape, seen)
    placed = PlacedMeasures.of(model, shape, seen, fit=fit, of_points=of_points)
    tested = placed.structures(fit, adjustment.active, adjustment.components, adjustment.shared)
    of_image = np.median((1.0 - of_points / fit.variance)[adjustment.active], axis=0)
    unfollowed = unfollowed_variance_px2(tested, of_image)
    return replace(
        adjustment,
        structures=tested,
        local_sigma_px=np.sqrt(np.maximum(adjustment.local_sigma_px**2, unfollowed)),
    )


@dataclass(frozen=True)
class RigorousScene:
    """What a block has found of a scene with a rigorous model.

    Attributes:
        parameter_set: name of the set of its parameters.
        parameters: with their standard deviations, in their units.
        held: a sentence that names those that the observations do not determine; "" where they do all.
        heights_m: lowest and highest ground of the scene, which fitted models are compared over.
        correction_error_px: largest distance of the nearest correction from the adjusted model.
        rpc: fitted to the adjusted model.
        attitude: how the satellite turns beyond the parameters; None where it does not.
    """

    parameter_set: str
    parameters: tuple[ParameterFigure, ...]
    held: str
    heights_m: tuple[float, float]
    correction_error_px: float
    rpc: RefinedRpc
    attitude: AttitudeMotion | None = None

    def is_carried(self, stated_px: float) -> bool:
        """Whether the RPC is close enough to the model, beside the CE90 stated for its worst place."""
        return self.rpc.model is not None and self.rpc.max_error_px <= max(stated_px, CARRIED_PX)


def rigorous_scene(block: JointBlock, number: int) -> RigorousScene | None:
    """What a block has found of a scene; None for a correction in the image."""
    image, measured = block.images[number], block.scenes[number]
    parameter_set = measured.scene.parameter_set
    if parameter_set is None or not isinstance(image, RigorousParameters):
        return None
    name, motion = image.name, measured.motion
    own = [each for each in parameter_figures(block.images, block.adjustment) if each.image == name]
    heights_m = scene_heights_m(block, number)
    return RigorousScene(
        parameter_set.name,
        tuple(own),
        "".join(held_parameters(own)),
        heights_m,
        nearest_correction(block, number).max_error_px,
        refined_rpc(block.model(number), measured.scene.image.shape, heights_m),
        attitude_motion(image.model, motion) if motion and image.displacement else None,
    )


def scene_measures(block: JointBlock, number: int, options: RegistrationOptions) -> Measures:
    """What became of the control points that a scene may show."""
    measured = block.scenes[number]
    adjustment = scene_adjustment(block, number, options)
    return point_results(measured.scene, measured.points, measured.search, adjustment)


def held_cells(measures: Sequence[Measures]) -> list[list[IntArray]]:
    """For every repetition, the measures of each scene that are held out: those of one of its cells."""
    cells = [cells_of(of_scene) for of_scene in measures]
    none = np.zeros(0, dtype=np.int64)
    most = max(map(len, cells), default=0)
    return [[own[k] if k < len(own) > 1 else none for own in cells] for k in range(most)]


def held_draws(
    measures: Sequence[Measures], draws: int, kept_share: float, rng: np.random.Generator
) -> list[list[IntArray]]:
    """For every repetition, the measures of each scene that are held out: of control points drawn once.

    A point is held out of all scenes that show it, as in the published tables.
    """
    used = np.unique(np.concatenate([of_scene.point_id[of_scene.active] for of_scene in measures]))
    count = len(used) - round(kept_share * len(used))
    out = []
    for _ in range(draws if count else 0):
        drawn = rng.permutation(used)[:count]
        out.append([np.flatnonzero(one.active & np.isin(one.point_id, drawn)) for one in measures])
    return out


def registered_scene(
    block: JointBlock,
    number: int,
    options: RegistrationOptions,
    *,
    drawn: Sequence[tuple[Sequence[IntArray], JointBlock | None]],
    cells: Sequence[tuple[Sequence[IntArray], JointBlock | None]],
    complete: JointBlock | None = None,
) -> Registration:
    """The registration of one scene of a block.

    Args:
        block: adjusted.
        number: of the scene.
        options: of the registration.
        drawn, cells: measures of each scene that were held out, and the block without them; None where
            there was no solution.
        complete: the block with every term of its rigorous models free; None where it has none.
    """
    measured = block.scenes[number]
    adjustment = _with_structures(block, number, scene_adjustment(block, number, options))
    measures = point_results(measured.scene, measured.points, measured.search, adjustment)
    scene = _with_model_findings(
        _adjusted_scene(block, number, measures, adjustment), block, number, complete
    )

    def of_scene(
        repetitions: Sequence[tuple[Sequence[IntArray], JointBlock | None]],
    ) -> list[Repetition]:
        return [
            (held[number], None if without is None else scene_adjustment(without, number, options))
            for held, without in repetitions
        ]

    of_cells = [one for one in of_scene(cells) if len(one[0])]
    qualification = qualify_repeated(
        scene,
        _held_by_ties(options.qualification),
        stability_of(scene, options.qualification.kept_share, of_scene(drawn)),
        cell_stability_of(scene, of_cells),
        tie_residual_px=tie_residual_px(block, number),
    )
    views, marks = measured.search.matches.view_measures, measured.marks
    return Registration(
        scene.model,
        scene.adjustment,
        measures,
        replace(views, point=measured.search.rows[views.point]),
        measured.stages,
        scene.frame,
        qualification,
        None
        if marks is None or not len(marks)
        else marks_beside_points(scene, marks.names, marks.sigma_m),
    )


def _adjusted_scene(
    block: JointBlock, number: int, measures: Measures, adjustment: SceneAdjustment
) -> AdjustedScene:
    """A scene of a block as it is qualified."""
    measured = block.scenes[number]
    frame = shared_frame(measured.points, measures.active)
    if not measures.active.any():
        # Its neighbours hold it: in the frame of their points.
        sources = block.control.source[block.adjustment.control_active]
        shares = np.bincount(sources, minlength=len(measured.points.frames))
        frame = weighted_frame(measured.points.frames, shares.astype(np.float64))
    return AdjustedScene(
        block.model(number),
        measures,
        adjustment,
        measured.scene.image.shape,
        scene_gsd_m(measured.scene),
        frame,
        elsewhere=measured.elsewhere,
        control_gsd_m=measured.search.chip_side_m / CHIP_SIZE,
        breaks=measured.search.breaks,
        shears=shears_of_active(measured.scene, measured.search, measures.active),
        pixel_findings=measured.scene.pixel_findings or (),
        tie_places=_tie_places(block, number),
    )


def _with_model_findings(
    scene: AdjustedScene, block: JointBlock, number: int, complete: JointBlock | None
) -> AdjustedScene:
    """A scene with its findings, those of its rigorous model included.

    An RPC that is too far from the model is not written, and does no harm.
    """
    left_out = of_left_out_terms(block, complete, number)
    scene = replace(scene, model_findings=() if left_out is None else (left_out,))
    found = with_findings(scene)
    rigorous = rigorous_scene(block, number)
    if rigorous is None or not rigorous.is_carried(found.worst_ce90_px):
        return found
    carried = of_rpc(scene.model, rigorous.rpc, scene.shape, rigorous.heights_m)
    if carried is None:
        return found
    return with_findings(replace(scene, model_findings=(*scene.model_findings, carried)))


def _tie_places(block: JointBlock, number: int) -> Array:
    """Line and sample (k, 2) of the active tie points of a scene."""
    rows = block.of_ties(number)
    return block.ties.line_sample[rows[block.adjustment.active[rows]]]


def _held_by_ties(options: QualificationOptions) -> QualificationOptions:
    """The thresholds for a scene that others hold as well: it may have few control points of its own."""
    return replace(options, usable_active_points=0, usable_active_of_few=0.0)


def tie_residual_px(block: JointBlock, number: int) -> float:
    """Standard deviation of the residuals of tie points in a scene, of the worse coordinate, pixels."""
    rows = block.of_ties(number)
    rows = rows[block.adjustment.active[rows]]
    if len(rows) < 2:
        return float("nan")
    return float(block.adjustment.residual_px[rows].std(axis=0, ddof=1).max())


def ground_misfits_m(block: JointBlock, number: int) -> Array:
    """Known minus adjusted ground (k, 3) of the active control points of a scene, east, north, up.

    Of points that two scenes or more show: the ground of the others is not measured.
    """
    adjustment = block.adjustment
    rays = np.bincount(
        np.concatenate(block.held_by),
        np.concatenate([adjustment.active[own] for own in block.at]),
        len(block.control),
    )
    agrees: BoolArray = adjustment.active[block.at[number]]
    own = block.held_by[number][agrees]
    own = own[adjustment.control_active[own] & (rays[own] >= 2)]
    return np.asarray(adjustment.control_misfit_m[own])
