"""Construction of the report of a registration, from its result and the surrounding facts."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from amers.services.imagery.scene import Scene, scene_footprint, scene_gsd_m
from amers.services.misfit.affine_fit import Order
from amers.services.misfit.displacement_components import BENDS, Component
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.quality.criteria import VERDICT_EXPLANATIONS, verdict_scope
from amers.services.quality.marks import MarksReport
from amers.services.registration.on_points import Registration
from amers.services.registration.options import RegistrationOptions
from amers.services.reports.figure_data import FigureData
from amers.services.reports.reasons import count_reasons
from amers.services.reports.report import (
    REPORT_FORMAT,
    BlockUsed,
    Check,
    CorrectionRecord,
    OrderScore,
    RefinedModelRecord,
    RegistrationReport,
    RunRecord,
    SceneRecord,
)
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import ControlPoints, Measures


def build_report(
    registration: Registration,
    scene: SceneRecord,
    run: RunRecord,
    refined_model: RefinedModelRecord,
    figure_data: FigureData,
    *,
    checks: tuple[Check, ...] = (),
    nearest_px: float | None = None,
) -> RegistrationReport:
    """The report of a registration.

    Args:
        registration: gives the figures.
        scene: what was registered.
        run: how and when.
        refined_model: the files that carry the correction.
        figure_data: what the figures of the page draw.
        checks: accuracy at points that had no part in the registration.
        nearest_px: largest distance of the correction from the adjusted rigorous model that it stands
            for; None where the correction is what was adjusted.
    """
    qualification = registration.qualification
    correction = _correction_record(registration.adjustment, run.options, scene.gsd_m)
    if nearest_px is not None:
        reason = (
            f"affine: the nearest to the adjusted rigorous model, {nearest_px:.2g} px off it at most"
        )
        correction = replace(correction, order_reason=reason)
    elif registration.marks is not None:
        correction = replace(correction, order_reason=_reason_of_marks(registration.marks, correction))
    return RegistrationReport(
        format=REPORT_FORMAT,
        run=run,
        verdict=qualification.verdict,
        verdict_scope=verdict_scope(qualification.criteria),
        verdict_explanation=VERDICT_EXPLANATIONS[qualification.verdict],
        relative_to_control_points=qualification.accuracy.relative_to_control_points,
        on_the_earth=qualification.accuracy.on_the_earth,
        criteria=qualification.criteria,
        scene=scene,
        correction=correction,
        refined_model=refined_model,
        search_stages=registration.search_stages,
        point_counts=qualification.point_counts,
        reasons=count_reasons(registration.measures),
        image_residuals_px=qualification.image_residuals_px,
        ground_residuals_m=qualification.ground_residuals_m,
        stability=qualification.stability,
        cell_stability=qualification.cell_stability,
        predicted=qualification.predicted,
        coverage=qualification.coverage,
        findings=qualification.findings,
        checks=checks,
        marks=registration.marks,
        figure_data=figure_data,
    )


def with_shares(
    blocks: Sequence[BlockUsed], points: ControlPoints, measures: Measures
) -> tuple[BlockUsed, ...]:
    """The blocks of control points with how many points each gave to a registration, and how accurate.

    Of a source whose points are not among these, such as marks of several scenes, nothing is counted.

    Args:
        blocks: in the order of the points' blocks.
        points: of all blocks.
        measures: of the registration.
    """
    shared = []
    for number, block in enumerate(blocks):
        ids = points.id[points.block == number]
        if len(ids) == 0:
            shared.append(block)
            continue
        active = np.isin(points.id, measures.point_id[measures.active]) & (points.block == number)
        variance_m2 = points.covariance_m2[active][:, [0, 1], [0, 1]].mean(axis=1)
        shared.append(
            replace(
                block,
                visible=int(np.isin(measures.point_id, ids).sum()),
                active=int(active.sum()),
                sigma_m=float(np.sqrt(np.median(variance_m2))) if active.any() else math.nan,
            )
        )
    return tuple(shared)


def scene_record(scene: Scene, name: str) -> SceneRecord:
    """The facts of a report about a scene, under a name for people."""
    lines, samples = scene.image.shape
    return SceneRecord(
        name=name,
        acquisition=scene.acquisition,
        lines=lines,
        samples=samples,
        gsd_m=scene_gsd_m(scene),
        model=_kind_of_model(scene),
        sigma_m=scene.sigma_m,
        footprint_lon_lat=scene_footprint(scene),
        pixel_findings=scene.pixel_findings or (),
    )


def _kind_of_model(scene: Scene) -> str:
    if isinstance(scene.model, OrthoModel):
        return "map grid"
    return f"rigorous, {scene.parameter_set.name}" if scene.parameter_set else "RPC"


def _correction_record(
    adjustment: SceneAdjustment, options: RegistrationOptions, gsd_m: float
) -> CorrectionRecord:
    """The correction with its precision."""
    correction = adjustment.correction
    shift_px = correction.parameters[:, 0]
    variance = np.clip(np.diagonal(adjustment.covariance), 0.0, None)
    return CorrectionRecord(
        order=adjustment.order,
        order_reason=_order_reason(adjustment, options.adjustment.order),
        order_scores=tuple(OrderScore(*score) for score in adjustment.validation_px),
        parameters_px=correction.parameters,
        std_px=np.sqrt(variance).reshape(2, 3),
        centre_px=correction.centre,
        half_size_px=correction.half_size,
        shift_px=shift_px,
        shift_m=float(np.hypot(*shift_px) * gsd_m),
        words=correction_in_words(adjustment, gsd_m),
        sigma0=adjustment.sigma0,
        local_sigma_px=adjustment.local_sigma_px,
    )


def _reason_of_marks(marks: MarksReport, correction: CorrectionRecord) -> str:
    """What of a correction the marks determine, as one sentence."""
    used = sum(mark.status != "rejected" for mark in marks.marks)
    determined = "all six parameters" if not marks.held else f"{6 - len(marks.held)} of six parameters"
    return (
        f"{correction.order}: {used} mark{'s' * (used != 1)} determine{'s' * (used == 1)} {determined}"
    )


def _order_reason(adjustment: SceneAdjustment, requested: Order | None) -> str:
    """The order of a correction and why it was chosen, as one sentence."""
    if requested is not None:
        return f"{adjustment.order}, as requested"
    if not adjustment.validation_px:
        return f"{adjustment.order}: the points of the scene alone choose none"
    if len(adjustment.validation_px) == 1:
        return f"{adjustment.order}: the points are too few or too close together for a higher order"
    scores = ", ".join(f"{order} {value_px:.2f} px" for order, value_px in adjustment.validation_px)
    return f"{adjustment.order}: rms residual of points left out of the fit: {scores}"


def correction_in_words(adjustment: SceneAdjustment, gsd_m: float) -> tuple[str, ...]:
    """One sentence for each part of the correction that was free.

    Args:
        adjustment: with the correction.
        gsd_m: ground sampling of the image; it converts pixels to metres.
    """
    parameters = adjustment.correction.parameters
    parts: tuple[tuple[str, float, float], ...] = (("shift", *parameters[:, 0]),)
    if adjustment.order == "drift":
        parts += (("drift at the last line and sample", parameters[0, 1], parameters[1, 2]),)
    elif adjustment.order == "affine":
        parts += (
            ("drift along the lines, at the last line", *parameters[:, 1]),
            ("drift along the samples, at the last sample", *parameters[:, 2]),
        )
    sentences = [
        f"{name}: {line:+.2f} px in line, {sample:+.2f} px in sample"
        f" ({np.hypot(line, sample) * gsd_m:.2f} m)"
        for name, line, sample in parts
    ]
    displacement = adjustment.correction.displacement
    if displacement is not None:
        line, sample = np.ptp(displacement.displacement_px, axis=(0, 1))
        kinds = [_component_in_words(one, adjustment) for one in adjustment.components]
        if any(one.kind in BENDS for one in adjustment.left_open):
            kinds.append("bends of the image, which points on a part of it leave open")
        if any(one.is_seam for one in adjustment.left_open):
            kinds.append("seams beyond the points, as many as between them")
        sentences.append(
            f"beyond the affine correction, {', '.join(kinds)}: within {line:.2f} px in line, "
            f"{sample:.2f} px in sample"
        )
    return tuple(sentences)


def _component_in_words(component: Component, adjustment: SceneAdjustment) -> str:
    """What a component of the displacement is."""
    if component.kind == "step":
        last = component.at_px + component.length_px
        return f"a step between the {component.along} {component.at_px:.0f} and {last:.0f}"
    if component.kind == "break":
        before = np.array([[component.at_px, adjustment.correction.centre[1]]])
        line = adjustment.correction.apply(before)[0, 0]
        return f"a step at about line {line:.0f}, where the pixels show lost or repeated lines"
    if component.kind == "period":
        return f"jitter with a period of {component.at_px:.0f} {component.along}"
    if component.along == "swath":
        return f"lines that turn or grow, changing over {component.length_px:.0f} lines"
    return f"a bend that changes over {component.length_px:.0f} {component.along}"
