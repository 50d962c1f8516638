"""The report of a joint registration: all scenes side by side, and those that did not fit."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

import numpy as np

from amers.services.adjustment.parameter_figures import ParameterFigure
from amers.services.joint.registration import JointRegistration
from amers.services.joint.results import RigorousScene, ground_misfits_m
from amers.services.quality.accuracy import Statistics, statistics
from amers.services.quality.accuracy_statement import StatedAccuracy
from amers.services.quality.criteria import Verdict
from amers.services.quality.qualification import PointCounts
from amers.services.quality.stability import ImageResiduals, Stability
from amers.services.reports.published import (
    GROUND_COLUMNS,
    GROUND_WORDS,
    PublishedTable,
    published_tables,
)
from amers.services.reports.report import NOT_IN_JSON, BlockUsed, RegistrationReport
from amers.services.sensors.moving_pushbroom import AttitudeMotion
from amers.services.types import Array

JOINT_FORMAT = "amers-joint-registration/1"


@dataclass(frozen=True)
class JointSubject:
    """What a report of scenes registered together is on.

    Attributes:
        id: name of the folder of its results.
    """

    id: str


@dataclass(frozen=True)
class GroundMisfits:
    """Known minus adjusted ground of the active control points that two scenes or more show, metres.

    Attributes:
        east, north, up: in the frame of the point.
    """

    east: Statistics
    north: Statistics
    up: Statistics


@dataclass(frozen=True)
class RigorousRecord:
    """The adjusted rigorous model of a scene.

    Attributes:
        parameter_set: name of the set of its free parameters.
        parameters: with their standard deviations, in their units.
        held: names those that the observations do not determine, as a sentence; "" where they do all.
        heights_m: lowest and highest ground of the scene, over which its RPC is fitted.
        rpc_error_px: largest distance of that RPC from the adjusted model.
        rpc_words: the same as a sentence.
        correction_error_px: largest distance of the nearest correction from the adjusted model.
        attitude_words: how far the satellite turns beyond the parameters, as a sentence; "" for not.
    """

    parameter_set: str
    parameters: tuple[ParameterFigure, ...]
    held: str
    heights_m: tuple[float, float]
    rpc_error_px: float
    rpc_words: str
    correction_error_px: float
    attitude_words: str


@dataclass(frozen=True)
class JointScene:
    """One scene of the block.

    Attributes:
        name: of the scene, and of the folder of its own report.
        verdict: on its registration.
        relative_to_control_points, on_the_earth: its accuracy.
        point_counts: control points visible, matched and active.
        tie_points, active_tie_points: seen in the scene, and those of them that agree.
        normalised_residual: residuals that agree, in units of their stated sigmas, root mean square.
        gsd_m: ground sampling at its centre.
        incidence_deg: of its view.
        image_residuals_px: of the active control points, at their known ground.
        ground_misfits_m: of its control points, where the block moves them.
        stability: the block adjusted without a part of its control points.
        rigorous: what was found of its rigorous model; null for a correction in the image.
    """

    name: str
    verdict: Verdict
    relative_to_control_points: StatedAccuracy
    on_the_earth: StatedAccuracy
    point_counts: PointCounts
    tie_points: int
    active_tie_points: int
    normalised_residual: float
    gsd_m: float
    incidence_deg: float
    image_residuals_px: ImageResiduals
    ground_misfits_m: GroundMisfits
    stability: Stability
    rigorous: RigorousRecord | None


@dataclass(frozen=True)
class LeftScene:
    """A scene that did not fit the block.

    Attributes:
        name: of the scene, and of the folder of its own report.
        reason: why it left.
    """

    name: str
    reason: str


@dataclass(frozen=True)
class JointReport:
    """The report of scenes registered together.

    Attributes:
        format: of the document, with its version.
        block: what it is on.
        verdict: the worst on a scene; "incomplete" when one has left.
        verdict_words: how many scenes have which verdict.
        scenes: that fit.
        left: scenes that do not.
        joined: scenes that were adjusted before, and have stayed as they were.
        blocks: the blocks whose points were used.
        control_points: number of those found.
        active_control_points: number of those that agree.
        tie_points: number of tie points.
        tie_sigma: factor of the stated precision of tie points, by their residuals.
        slope_factor: drifts and skews found, over those expected.
        software_version: of Amers.
        finished_at: UTC.
        reports: of the scenes; not part of the document.
        misfits: (n, 5) lon, lat of active control points, and their misfits east, north, up; not part of
            the document.
    """

    format: str
    block: JointSubject
    verdict: Literal["good", "usable", "failed", "incomplete"]
    verdict_words: str
    scenes: tuple[JointScene, ...]
    left: tuple[LeftScene, ...]
    joined: tuple[str, ...]
    blocks: tuple[BlockUsed, ...]
    control_points: int
    active_control_points: int
    tie_points: int
    tie_sigma: float
    slope_factor: float
    software_version: str
    finished_at: datetime
    reports: tuple[RegistrationReport, ...] = field(metadata=NOT_IN_JSON)
    misfits: Array = field(metadata=NOT_IN_JSON)

    @property
    def heading(self) -> str:
        """The verdict with the accuracy that it speaks of."""
        delivered = self.verdict in ("good", "usable")
        return f"{self.verdict}, {self.reports[0].verdict_scope}" if delivered else self.verdict

    @property
    def accuracy_lines(self) -> tuple[str, str]:
        """The smallest and the largest of both accuracies, each with its label."""
        return (
            _range_words([scene.relative_to_control_points for scene in self.scenes]),
            _range_words([scene.on_the_earth for scene in self.scenes]),
        )


def _range_words(stated: Sequence[StatedAccuracy]) -> str:
    ce90_m = np.array([one.ce90_m for one in stated])
    unknown = int(np.isnan(ce90_m).sum())
    if unknown == len(stated):
        return f"{stated[0].label}: unknown"
    words = (
        f"{stated[0].label}: CE90 {np.nanmin(ce90_m):.2f} to {np.nanmax(ce90_m):.2f} m at the worst "
        "places of the scenes"
    )
    return f"{words}, unknown for {unknown} of them" if unknown else words


def joint_report(
    result: JointRegistration,
    reports: Sequence[RegistrationReport],
    left: Sequence[str],
    *,
    name: str,
    finished_at: datetime,
) -> JointReport:
    """The report of a block.

    Args:
        result: of the registration.
        reports: of its registrations, in their order.
        left: names of the scenes that have left, in their order.
        name: of the folder of the results.
        finished_at: UTC.
    """
    block, adjustment = result.block, result.block.adjustment
    scenes = tuple(_joint_scene(result, number, report) for number, report in enumerate(reports))
    gone = tuple(LeftScene(each, str(one.error)) for each, one in zip(left, result.left, strict=True))
    order = ("failed", "usable", "good")
    verdicts = [scene.verdict for scene in scenes]
    worst = next(verdict for verdict in order if verdict in verdicts)
    counts = [
        f"{verdicts.count(verdict)} {verdict}" for verdict in reversed(order) if verdict in verdicts
    ]
    if gone:
        counts.append(f"{len(gone)} left the block: {', '.join(one.name for one in gone)}")
    misfit_m = adjustment.control_misfit_m
    active = adjustment.control_active
    return JointReport(
        format=JOINT_FORMAT,
        block=JointSubject(name),
        verdict="incomplete" if gone else worst,
        verdict_words=f"{len(scenes) + len(gone)} scenes: {', '.join(counts)}.",
        scenes=scenes,
        left=gone,
        joined=tuple(one.name for k, one in enumerate(block.scenes) if k not in result.numbers),
        blocks=tuple(BlockUsed(one.id, one.version) for one in reports[0].run.blocks),
        control_points=len(block.control),
        active_control_points=int(active.sum()),
        tie_points=len(np.unique(block.ties.point)),
        tie_sigma=block.tie_sigma,
        slope_factor=adjustment.slope_factor,
        software_version=reports[0].run.software_version,
        finished_at=finished_at,
        reports=tuple(reports),
        misfits=np.column_stack([block.control.lon_lat_h[active, :2], misfit_m[active]]),
    )


def _joint_scene(result: JointRegistration, number: int, report: RegistrationReport) -> JointScene:
    fit, misfit_m = result.fits[number], ground_misfits_m(result.block, result.numbers[number])
    return JointScene(
        name=report.scene.name,
        verdict=report.verdict,
        relative_to_control_points=report.relative_to_control_points,
        on_the_earth=report.on_the_earth,
        point_counts=report.point_counts,
        tie_points=fit.ties,
        active_tie_points=fit.used_ties,
        normalised_residual=fit.normalised,
        gsd_m=report.scene.gsd_m,
        incidence_deg=report.scene.acquisition.incidence_deg,
        image_residuals_px=report.image_residuals_px,
        ground_misfits_m=GroundMisfits(*(statistics(axis) for axis in misfit_m.T)),
        stability=report.stability,
        rigorous=_rigorous_record(result.rigorous[number], report),
    )


def _rigorous_record(found: RigorousScene | None, report: RegistrationReport) -> RigorousRecord | None:
    if found is None:
        return None
    return RigorousRecord(
        parameter_set=found.parameter_set,
        parameters=found.parameters,
        held=found.held,
        heights_m=found.heights_m,
        rpc_error_px=report.refined_model.max_error_px,
        rpc_words=report.refined_model.note,
        correction_error_px=found.correction_error_px,
        attitude_words=_attitude_words(found.attitude),
    )


def _attitude_words(motion: AttitudeMotion | None) -> str:
    if motion is None:
        return ""
    roll, pitch = 1e6 * np.abs(motion.roll_pitch_rad).max(axis=0)
    return (
        f"The satellite turns while it scans, by up to {roll:.2g} μrad of roll and {pitch:.2g} μrad of "
        "pitch beyond these parameters: attitude.csv"
    )


@dataclass(frozen=True)
class BlockTable:
    """A published table with a row for each scene.

    Attributes:
        table: title, columns, decimals and note; the values are those of the first scene.
        rows: name of the scene, and its values; NaN where there is none.
    """

    table: PublishedTable
    rows: tuple[tuple[str, tuple[float, ...]], ...]


def block_tables(report: JointReport) -> tuple[BlockTable, ...]:
    """The published tables of all scenes, in the same columns."""
    of_scenes = [published_tables(one) for one in report.reports]
    out = []
    for kind in range(len(of_scenes[0])):
        values = [tables[kind].values for tables in of_scenes]
        table = of_scenes[0][kind]
        if table.columns[0] == "dx_amer":
            table, values = _ground_table(report)
        names = [scene.name for scene in report.scenes]
        out.append(BlockTable(table, tuple(zip(names, values, strict=True))))
    return tuple(out)


def _ground_table(report: JointReport) -> tuple[PublishedTable, list[tuple[float, ...]]]:
    """The ground residuals, with those of heights: control points move within a block."""
    rows: list[tuple[float, ...]] = []
    for scene in report.scenes:
        east, north, up = (getattr(scene.ground_misfits_m, axis) for axis in ("east", "north", "up"))
        rows.append((-east.mean, -north.mean, east.std, north.std, -up.mean, up.std))
    table = PublishedTable(
        "Ground residuals, m",
        GROUND_WORDS,
        GROUND_COLUMNS,
        rows[0],
        (2,) * 6,
        "Adjusted minus known position of the active control points that two scenes or more show: east, "
        "north and up. Each point is weighted by the accuracy of its known position.",
    )
    return table, rows
