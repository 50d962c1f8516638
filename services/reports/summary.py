"""What a report of a registration is made from."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from services.adjustment.image_correction import SceneAdjustment
from services.quality.accuracy import Accuracy, NormalisedError
from services.quality.qualification import (
    Qualification,
)
from services.quality.stability import ImageResiduals
from services.registration.search import SearchStage
from services.types import Acquisition, Array, ChipArray, FloatImage, Measures

Method = Literal["control points", "reference image"]
"""What a scene is registered on."""


@dataclass(frozen=True)
class BlockUsed:
    """A block whose points were used.

    Attributes:
        id, version: of the block.
    """

    id: str
    version: str


@dataclass(frozen=True)
class Quicklook:
    """The scene, reduced to a size that fits a page.

    Attributes:
        pixels: (h, w); NaN or 0 where there is no data.
        reduction: pixels of the scene for one of the quicklook.
    """

    pixels: FloatImage
    reduction: float


@dataclass(frozen=True)
class ChipPair:
    """A chip beside what was found in the scene, both in the chip's geometry.

    Attributes:
        point_id: of the control point.
        gsd_m: ground sampling of the chip.
        chip: (101, 101) as stored.
        found: (101, 101) the scene seen through the refined model, on the chip's grid.
        score: correlation; NaN when none was computed.
        residual_px: (2,) line and sample; NaN when not found.
        status: "active", or why the point is not.
    """

    point_id: int
    gsd_m: float
    chip: ChipArray
    found: ChipArray
    score: float
    residual_px: Array
    status: str


@dataclass(frozen=True)
class Check:
    """Accuracy against points that had no part in the registration.

    Attributes:
        against: what the points are, in words.
        accuracy: of the registered model there; a single scene gives no heights, hence no LE90.
        image_residuals_px: of the marks; x along samples, y along lines; None when not marked.
        normalised: the residuals in units of what model, marks and points state; None when unknown.
    """

    against: str
    accuracy: Accuracy
    image_residuals_px: ImageResiduals | None = None
    normalised: NormalisedError | None = None


@dataclass(frozen=True)
class RegistrationSummary:
    """All that a report is made from.

    Attributes:
        scene: name for people.
        acquisition: how the scene was taken.
        shape: lines and samples.
        gsd_m: ground sampling at the centre.
        model_kind: of the delivered model, "RPC" for one.
        sigma_m: a priori accuracy of the model, one standard deviation a coordinate.
        footprint: (m, 2) lon, lat outline of the scene, not closed.
        blocks: those whose points were used.
        options: the dataclass of options of the registration.
        passes: in the order they were run.
        order_reason: the order of the correction and why it was chosen, in words.
        measures: what was done with each point.
        adjustment: the final one.
        qualification: of the registration.
        quicklook: the scene reduced; None when there is none.
        gallery: chips beside what was found; the report picks the best, middle and worst scores.
        refit_error_px: largest difference between the corrected model and the one written; 0 when that
            carries the correction exactly, NaN when nothing was written.
        refined_note: which files carry the correction, and how well, in words.
        method: what the scene was registered on.
        software_version: of Amers.
        started_at, finished_at: UTC, given by the caller; None when unknown.
        checks: against independent points, if there are any.
    """

    scene: str
    acquisition: Acquisition
    shape: tuple[int, int]
    gsd_m: float
    model_kind: str
    sigma_m: float
    footprint: Array
    blocks: tuple[BlockUsed, ...]
    options: Any
    passes: tuple[SearchStage, ...]
    order_reason: str
    measures: Measures
    adjustment: SceneAdjustment
    qualification: Qualification
    quicklook: Quicklook | None
    gallery: tuple[ChipPair, ...]
    refit_error_px: float
    software_version: str
    started_at: datetime | None = None
    finished_at: datetime | None = None
    checks: tuple[Check, ...] = ()
    refined_note: str = ""
    method: Method = "control points"
