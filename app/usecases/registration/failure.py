"""The report of a registration that failed, written where its outputs would have been."""

from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from amers.app.errors import is_no_memory, is_no_room
from amers.app.outages import outage_of
from amers.app.usecases.registration.control_sources import ControlSet
from amers.app.usecases.report_files import write_report
from amers.services.errors import AmersError, CoverageError, FormatError
from amers.services.formats.images.band_registration import visible_bands
from amers.services.formats.images.scenes import scene_name
from amers.services.imagery.pixel_checks import PixelFinding, pixel_findings
from amers.services.imagery.scene import Scene
from amers.services.registration.context import SearchStage
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.point_selection import visible_points
from amers.services.reports.build import scene_record
from amers.services.reports.failure import (
    EXPLANATION,
    FAILURE_FORMAT,
    NO_ACCURACY,
    NOT_REGISTERED,
    FailureReport,
    UnreadScene,
    next_steps,
)
from amers.services.reports.failure_pages import FAILURE_PAGE
from amers.services.reports.report import BlockUsed, RunRecord, SceneRecord
from amers.services.statements import Statement, gathered
from amers.services.types import Array


@dataclass
class Attempt:
    """What a registration has done so far; it is filled while the work goes on.

    Attributes:
        image: of the scene.
        command: that repeats the registration, without the accuracy of the model.
        options: of the registration.
        started_at: UTC.
        scene: once it was read.
        control: points around the scene, once they were looked for.
        reference: name of the reference image, once it was chosen; "" before.
        marks: names of the files of marks; "" for none.
        stages: summaries of the searches, also of one that was refused.
        statements: of the files read, but for those of the scene.
    """

    image: Path
    command: str
    options: RegistrationOptions
    started_at: datetime = field(default_factory=lambda: datetime.now(UTC))
    scene: Scene | None = None
    control: ControlSet | None = None
    reference: str = ""
    marks: str = ""
    stages: list[SearchStage] = field(default_factory=list)
    statements: list[Statement] = field(default_factory=list)

    def with_scene(self, scene: Scene) -> Scene:
        """Note the scene, and what is wrong with its pixels, which it is returned with.

        An image that cannot be read everywhere has no findings: what reads it next says why.
        """
        found: tuple[PixelFinding, ...] = ()
        with suppress(FormatError):
            found = pixel_findings(scene.image, visible_bands(scene.image)).findings
        self.scene = replace(scene, pixel_findings=found)
        return self.scene

    def scene_record(self) -> SceneRecord | UnreadScene:
        """The facts about the scene; only its name where it was not read."""
        name = scene_name(self.image)
        if self.scene is None:
            return UnreadScene(name)
        return scene_record(self.scene, name)

    def run_record(self) -> RunRecord:
        """How and when the registration was run; it ends now."""
        blocks = () if self.control is None else self.control.blocks
        if self.reference:
            blocks = (BlockUsed(self.reference, "reference image"),)
        if self.marks:
            blocks = (*blocks, BlockUsed(self.marks, "marks"))
        of_scene = () if self.scene is None else self.scene.statements
        return RunRecord(
            software_version=version("amers"),
            started_at=self.started_at,
            finished_at=datetime.now(UTC),
            method="reference image" if self.reference else "control points",
            blocks=blocks,
            options=self.options,
            statements=gathered([*of_scene, *self.statements]),
        )


def has_report(error: Exception) -> bool:
    """Whether a registration that an error has ended leaves a report: all but outages, which end."""
    if isinstance(error, AmersError):
        return True
    return not (outage_of(error) or is_no_room(error) or is_no_memory(error))


def write_failure(folder: Path, attempt: Attempt, error: Exception) -> None:
    """Write the report of an attempt that an error has ended into a folder, created when missing."""
    write_report(folder, FAILURE_PAGE, _failure_report(attempt, error))


def _failure_report(attempt: Attempt, error: Exception) -> FailureReport:
    record = attempt.scene_record()
    stages, reason = tuple(attempt.stages), str(error)
    if not isinstance(error, AmersError):
        reason = f"an error that should not happen: {type(error).__name__}: {error}"
    return FailureReport(
        format=FAILURE_FORMAT,
        run=attempt.run_record(),
        verdict=NOT_REGISTERED,
        verdict_explanation=EXPLANATION,
        relative_to_control_points=NO_ACCURACY.relative_to_control_points,
        on_the_earth=NO_ACCURACY.on_the_earth,
        error=type(error).__name__,
        # The folder of the image may be that of a job on a service.
        reason=reason.replace(f"{attempt.image.parent}/", ""),
        scene=record,
        visible=_visible(attempt),
        search_stages=stages,
        next_steps=next_steps(error, record, stages, attempt.command),
        ground=_ground(attempt),
    )


def _visible(attempt: Attempt) -> int | None:
    """Number of control points that the scene may show; None when none was looked for."""
    if attempt.scene is None or attempt.control is None or attempt.reference:
        return None
    try:
        return len(visible_points(attempt.scene, attempt.control.points))
    except CoverageError:
        return 0


def _ground(attempt: Attempt) -> Array:
    """The control points around the scene (n, 2), lon and lat."""
    return np.zeros((0, 2)) if attempt.control is None else attempt.control.points.lon_lat_h[:, :2]
