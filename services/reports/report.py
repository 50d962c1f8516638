"""The report of a registration: one tree of dataclasses.

`report.json`, its JSON Schema, the HTML page and the tables are all made from `RegistrationReport`. A
field of these dataclasses is a member of report.json under the same name, except where the field is
marked `NOT_IN_JSON`. A reader needs no other source for words: criteria carry label, unit, decimals and
calculation, reasons carry a label, the verdict has its explanation, and the correction its sentences.
"""

import math
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

from amers.services.imagery.pixel_checks import PixelFinding
from amers.services.quality.accuracy import Accuracy, NormalisedError
from amers.services.quality.accuracy_statement import AccuracyStatement, StatedAccuracy
from amers.services.quality.cell_stability import CellStability
from amers.services.quality.criteria import Criterion, Verdict
from amers.services.quality.finding import Finding
from amers.services.quality.marks import MarksReport
from amers.services.quality.predicted import PredictedAccuracy
from amers.services.quality.qualification import Coverage, GroundResiduals, PointCounts
from amers.services.quality.stability import ImageResiduals, Stability
from amers.services.registration.context import SearchStage
from amers.services.registration.options import RegistrationOptions
from amers.services.reports.figure_data import FigureData
from amers.services.reports.reasons import ReasonCount
from amers.services.statements import Statements
from amers.services.types import Acquisition, Array

REPORT_FORMAT = "amers-registration-report/4"
NOT_IN_JSON = {"json": False}
"""Metadata of a field that report.json leaves out."""

Method = Literal["control points", "reference image"]
"""What a scene is registered on."""


@dataclass(frozen=True)
class BlockUsed:
    """A block whose points were used.

    Attributes:
        id, version: of the block.
        visible, active: numbers of its points that the scene could show, and that the correction uses;
            null where no registration counted them.
        sigma_m: median standard deviation of a horizontal coordinate of the active ones, relative to the
            frame of the block, metres.
    """

    id: str
    version: str
    visible: int | None = None
    active: int | None = None
    sigma_m: float = math.nan


@dataclass(frozen=True)
class RunRecord:
    """How and when a registration was run.

    Attributes:
        software_version: of Amers.
        started_at, finished_at: UTC; None when unknown.
        method: whether on control points or on a reference image.
        blocks: the blocks whose points were used, or the reference image.
        options: of the registration.
        statements: of the files that were read, and what became of each.
    """

    software_version: str
    started_at: datetime | None
    finished_at: datetime | None
    method: Method
    blocks: tuple[BlockUsed, ...]
    options: RegistrationOptions
    statements: Statements = ()


@dataclass(frozen=True)
class SceneRecord:
    """The scene that was registered.

    Attributes:
        name: for people.
        acquisition: how it was taken.
        lines, samples: size of the image, pixels.
        gsd_m: ground sampling at the centre, metres.
        model: kind of the delivered model, such as "RPC".
        sigma_m: accuracy of the model before registration, one standard deviation a coordinate, metres.
        footprint_lon_lat: outline on the ground, degrees, not closed.
        pixel_findings: what is wrong with its pixels; none in a clean image.
    """

    name: str
    acquisition: Acquisition
    lines: int
    samples: int
    gsd_m: float
    model: str
    sigma_m: float
    footprint_lon_lat: Array
    pixel_findings: tuple[PixelFinding, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.lines, self.samples


@dataclass(frozen=True)
class OrderScore:
    """How well an order of the correction predicts points that it was not fitted to.

    Attributes:
        order: "shift", "drift" or "affine".
        left_out_px: distance of the points left out of the fit from their predicted positions, rms,
            pixels.
    """

    order: str
    left_out_px: float


@dataclass(frozen=True)
class CorrectionRecord:
    """The correction of the model: from image positions by the delivered model to true positions.

    Attributes:
        order: "shift", "drift" or "affine".
        order_reason: the order and why it was chosen, as a sentence.
        order_scores: of the orders that were compared.
        parameters_px: rows line and sample; constant, along lines, along samples (at the image's edge).
        std_px: one standard deviation of each parameter.
        centre_px, half_size_px: line and sample that the parameters refer to.
        shift_px: displacement at the centre, line and sample.
        shift_m: length of that displacement on the ground, by the ground sampling of the image.
        words: the parameters as sentences.
        sigma0: a posteriori standard deviation of unit weight.
        local_sigma_px: line and sample, one standard deviation of what parts of the image are off by
            beyond the correction.
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
    local_sigma_px: Array


@dataclass(frozen=True)
class RefinedModelRecord:
    """The files of the refined model.

    Attributes:
        max_error_px: largest difference between the corrected model and the model in the files; 0 when
            they carry the correction exactly, null when no model was written.
        note: which files carry the correction, and how well, as a sentence.
    """

    max_error_px: float
    note: str


@dataclass(frozen=True)
class Check:
    """Accuracy at points that had no part in the registration.

    Attributes:
        against: what the points are, for people.
        accuracy: of the registered model; a single scene gives no heights, hence no LE90.
        image_residuals_px: of the marks; x along samples, y along lines; null when there are no marks.
        normalised: the residuals in units of the stated precision of model, marks and points; null when
            unknown.
    """

    against: str
    accuracy: Accuracy
    image_residuals_px: ImageResiduals | None = None
    normalised: NormalisedError | None = None


@dataclass(frozen=True)
class RegistrationReport:
    """The report of one registration.

    Attributes:
        format: of the document, with its version.
        run: how and when the registration was run.
        verdict: "good", "usable" or "failed"; follows from the criteria alone.
        verdict_scope: the accuracy that the verdict speaks of, "relative to the control points" or
            "relative to the control points and on the Earth".
        verdict_explanation: what the verdict means, for people.
        relative_to_control_points: accuracy without the frame of the control points.
        on_the_earth: accuracy with it, unknown where it is not stated.
        criteria: every figure that has a limit.
        scene: what was registered.
        correction: of the model of the scene.
        refined_model: the files that carry the correction.
        search_stages: the searches of the points, in order.
        point_counts: points visible, matched and active.
        reasons: why points are not active, commonest first.
        image_residuals_px: of the active points; x along samples, y along lines.
        ground_residuals_m: of the active points; no heights, which a single scene does not give.
        stability: the adjustment repeated without a part of its points, drawn at random; not absolute
            accuracy.
        cell_stability: the same without the points of one cell at a time: shows errors that neighbours
            share, not those that all points share.
        predicted: accuracy by the covariance of the correction.
        coverage: the part of the image that active points support; accuracy is stated for it.
        findings: what the correction does not follow, most harmful first; the accuracy includes them.
        checks: accuracy at points that had no part in the registration.
        marks: what became of marks of a person; null without any.
        figure_data: what the figures of the page draw; not part of report.json.
    """

    format: str
    run: RunRecord
    verdict: Verdict
    verdict_scope: str
    verdict_explanation: str
    relative_to_control_points: StatedAccuracy
    on_the_earth: StatedAccuracy
    criteria: tuple[Criterion, ...]
    scene: SceneRecord
    correction: CorrectionRecord
    refined_model: RefinedModelRecord
    search_stages: tuple[SearchStage, ...]
    point_counts: PointCounts
    reasons: tuple[ReasonCount, ...]
    image_residuals_px: ImageResiduals
    ground_residuals_m: GroundResiduals
    stability: Stability
    cell_stability: CellStability
    predicted: PredictedAccuracy
    coverage: Coverage
    findings: tuple[Finding, ...]
    checks: tuple[Check, ...]
    marks: MarksReport | None
    figure_data: FigureData = field(metadata=NOT_IN_JSON)

    @property
    def verdict_line(self) -> str:
        """The verdict and the accuracy that it speaks of."""
        return f"Verdict: {self.verdict}, {self.verdict_scope}"

    @property
    def accuracy_lines(self) -> tuple[str, ...]:
        """The two accuracies, as every place states them."""
        return AccuracyStatement(self.relative_to_control_points, self.on_the_earth).lines
