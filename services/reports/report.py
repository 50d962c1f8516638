"""What a report of a registration says: its record, as `report.json` holds it."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from services.adjustment.image_correction import SceneAdjustment
from services.quality.qualification import (
    Coverage,
    Criterion,
    GroundResiduals,
    PointCounts,
    Verdict,
)
from services.quality.stability import ImageResiduals, PredictedAccuracy, Stability
from services.registration.search import SearchStage
from services.reports.summary import BlockUsed, Check, Method, RegistrationSummary
from services.types import Acquisition, Array, Measures

REPORT_FORMAT = "amers-registration-report/1"


@dataclass(frozen=True)
class OrderScore:
    """How well an order of the correction predicts points that it was not fitted to.

    Attributes:
        order: "shift", "drift" or "affine".
        left_out_px: distance of left-out points from where the others expect them, rms, pixels.
    """

    order: str
    left_out_px: float


@dataclass(frozen=True)
class SceneRecord:
    """The scene that was registered.

    Attributes:
        name: for people.
        acquisition: how it was taken.
        lines, samples: size of the image, pixels.
        gsd_m: ground sampling at the centre, metres.
        model: kind of the delivered model.
        sigma_m: accuracy of the model before registration, one standard deviation a coordinate, metres.
        footprint_lon_lat: outline on the ground, degrees, not closed.
    """

    name: str
    acquisition: Acquisition
    lines: int
    samples: int
    gsd_m: float
    model: str
    sigma_m: float
    footprint_lon_lat: Array


@dataclass(frozen=True)
class CorrectionRecord:
    """The correction that was found, from positions by the delivered model to true ones.

    Attributes:
        order: "shift", "drift" or "affine".
        order_reason: the order and why it was chosen, in words.
        order_scores: of the orders that were compared.
        parameters_px: rows line and sample; constant, along lines, along samples (at the image's edge).
        std_px: one standard deviation of each parameter.
        centre_px, half_size_px: line and sample that the parameters refer to.
        shift_px: displacement at the centre, line and sample.
        shift_m: length of that displacement on the ground, by the ground sampling of the image.
        words: the parameters as sentences.
        sigma0: a posteriori standard deviation of unit weight.
        refit_error_px: largest difference between the corrected model and the one written; 0 when that
            carries the correction exactly.
        refined_note: which files carry the correction, and how well, in words.
    """

    order: str
    order_reason: str
    order_scores: tuple[OrderScore, ...]
    parameters_px: Array
    std_px: Array
    centre_px: Array
    half_size_px: Array
    shift_px: Array
    shift_m: float
    words: tuple[str, ...]
    sigma0: float
    refit_error_px: float
    refined_note: str


@dataclass(frozen=True)
class ReasonCount:
    """How many points left for one reason.

    Attributes:
        stage: "not matched", or "deactivated" after a match.
        reason: as given by the matching or the adjustment.
        count: points.
    """

    stage: str
    reason: str
    count: int


@dataclass(frozen=True)
class RegistrationReport:
    """The record of one registration, as `report.json` holds it.

    Attributes:
        format: of the document, with its version.
        software_version: of Amers.
        started_at, finished_at: UTC.
        verdict: "good", "usable" or "failed"; follows from the criteria alone.
        criteria: every threshold with the value held against it.
        scene: what was registered.
        method: whether on control points or on a reference image.
        blocks: whose points were used; the reference image, where that was.
        correction: what was found.
        passes: rounds of matching, in order.
        equipment: points visible, matched and active.
        reasons: why points are not active, commonest first.
        image_residuals_px: of the active points; x along samples, y along lines.
        ground_residuals_m: of the active points; no heights, which a single scene does not give.
        stability: the adjustment redone without a part of its points; not absolute accuracy.
        predicted: accuracy by the covariance of the correction.
        coverage: of the image by active points.
        checks: against points that had no part in the registration.
        options: of the registration, as it was run.
    """

    format: str
    software_version: str
    started_at: datetime | None
    finished_at: datetime | None
    verdict: Verdict
    criteria: tuple[Criterion, ...]
    scene: SceneRecord
    method: Method
    blocks: tuple[BlockUsed, ...]
    correction: CorrectionRecord
    passes: tuple[SearchStage, ...]
    equipment: PointCounts
    reasons: tuple[ReasonCount, ...]
    image_residuals_px: ImageResiduals
    ground_residuals_m: GroundResiduals
    stability: Stability
    predicted: PredictedAccuracy
    coverage: Coverage
    checks: tuple[Check, ...]
    options: Any


def build_report(summary: RegistrationSummary) -> RegistrationReport:
    """The report of a registration."""
    found = summary.qualification
    return RegistrationReport(
        format=REPORT_FORMAT,
        software_version=summary.software_version,
        started_at=summary.started_at,
        finished_at=summary.finished_at,
        verdict=found.verdict,
        criteria=found.criteria,
        scene=SceneRecord(
            name=summary.scene,
            acquisition=summary.acquisition,
            lines=summary.shape[0],
            samples=summary.shape[1],
            gsd_m=summary.gsd_m,
            model=summary.model_kind,
            sigma_m=summary.sigma_m,
            footprint_lon_lat=summary.footprint,
        ),
        method=summary.method,
        blocks=summary.blocks,
        correction=_correction_record(summary),
        passes=summary.passes,
        equipment=found.equipment,
        reasons=count_reasons(summary.measures),
        image_residuals_px=found.image_residuals_px,
        ground_residuals_m=found.ground_residuals_m,
        stability=found.stability,
        predicted=found.predicted,
        coverage=found.coverage,
        checks=summary.checks,
        options=summary.options,
    )


def _correction_record(summary: RegistrationSummary) -> CorrectionRecord:
    """The correction with its precision."""
    adjustment = summary.adjustment
    correction = adjustment.correction
    shift_px = correction.parameters[:, 0]
    variance = np.clip(np.diagonal(adjustment.covariance), 0.0, None)
    return CorrectionRecord(
        order=adjustment.order,
        order_reason=summary.order_reason,
        order_scores=tuple(OrderScore(*score) for score in adjustment.validation_px),
        parameters_px=correction.parameters,
        std_px=np.sqrt(variance).reshape(2, 3),
        centre_px=correction.centre,
        half_size_px=correction.half_size,
        shift_px=shift_px,
        shift_m=float(np.hypot(*shift_px) * summary.gsd_m),
        words=correction_in_words(adjustment, summary.gsd_m),
        sigma0=adjustment.sigma0,
        refit_error_px=summary.refit_error_px,
        refined_note=summary.refined_note,
    )


def correction_in_words(adjustment: SceneAdjustment, gsd_m: float) -> tuple[str, ...]:
    """One sentence for each part of the correction that was free.

    Args:
        adjustment: with the correction.
        gsd_m: ground sampling of the image, turns pixels into metres.
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
    return tuple(
        f"{name}: {line:+.2f} px in line, {sample:+.2f} px in sample"
        f" ({np.hypot(line, sample) * gsd_m:.2f} m)"
        for name, line, sample in parts
    )


def count_reasons(measures: Measures) -> tuple[ReasonCount, ...]:
    """Why points are not active: first those that were not matched, the commonest reason first."""
    counts = []
    for stage, left in (
        ("not matched", ~measures.matched),
        ("deactivated", measures.matched & ~measures.active),
    ):
        names, numbers = np.unique(measures.reason[left], return_counts=True)
        for k in np.argsort(-numbers, kind="stable"):
            counts.append(ReasonCount(stage, str(names[k]) or "no reason given", int(numbers[k])))
    return tuple(counts)
