"""The report of a registration that failed: what was tried and where, and what to try next."""

import math
import shlex
from dataclasses import dataclass, field
from typing import Literal

from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.errors import (
    AmersError,
    BrokenImage,
    CoverageError,
    NoConsensus,
    NotEnoughPoints,
    OtherGround,
    RescaledImage,
    TurnedImage,
)
from amers.services.quality.accuracy_statement import AccuracyStatement, StatedAccuracy, no_accuracy
from amers.services.registration.context import SearchStage
from amers.services.registration.search import larger_sigma_m
from amers.services.reports.numbers import number
from amers.services.reports.report import NOT_IN_JSON, RunRecord, SceneRecord
from amers.services.types import Array

FAILURE_FORMAT = "amers-registration-failure/1"
NOT_REGISTERED: Literal["not registered"] = "not registered"
"""Verdict on a scene whose registration ended with an error."""

NO_ACCURACY = no_accuracy("the scene is not registered")
"""The accuracy of such a scene, as every place states it."""
EXPLANATION = "There is no refined model. The delivered model is as it was."


@dataclass(frozen=True)
class UnreadScene:
    """A scene whose files could not be used.

    Attributes:
        name: for people.
    """

    name: str


@dataclass(frozen=True)
class NextStep:
    """Something to try.

    Attributes:
        text: what to do, and why.
        command: that does it; "" when it is no command.
    """

    text: str
    command: str


@dataclass(frozen=True)
class FailureReport:
    """The report of a registration that failed.

    Attributes:
        format: of the document, with its version.
        run: how and when the registration was run.
        verdict: always "not registered".
        verdict_explanation: what the verdict means, for people.
        relative_to_control_points, on_the_earth: none.
        error: kind of the error.
        reason: the error, for people.
        scene: what was to be registered; only its name when its files could not be used.
        visible: number of control points that the scene may show; null when none was looked for.
        search_stages: the searches that were made, in order; the last one was refused.
        next_steps: what to try, the most promising first.
        ground: (n, 2) lon, lat of the control points around the scene; not part of report.json.
    """

    format: str
    run: RunRecord
    verdict: Literal["not registered"]
    verdict_explanation: str
    relative_to_control_points: StatedAccuracy
    on_the_earth: StatedAccuracy
    error: str
    reason: str
    scene: SceneRecord | UnreadScene
    visible: int | None
    search_stages: tuple[SearchStage, ...]
    next_steps: tuple[NextStep, ...]
    ground: Array = field(metadata=NOT_IN_JSON)

    @property
    def accuracy_lines(self) -> tuple[str, ...]:
        """The two accuracies, as every place states them."""
        return AccuracyStatement(self.relative_to_control_points, self.on_the_earth).lines


def next_steps(
    error: Exception, scene: SceneRecord | UnreadScene, stages: tuple[SearchStage, ...], command: str
) -> tuple[NextStep, ...]:
    """What to try after a registration that failed, the most promising first.

    Args:
        error: that ended it.
        scene: that was to be registered.
        stages: the searches that were made; the last one was refused.
        command: that ran it, without the accuracy of the model.
    """
    if not isinstance(error, AmersError):
        text = "Report this error of Amers, with the lines that the command prints in this way."
        return (NextStep(text, f"AMERS_LOG_LEVEL=debug {command}"),)
    if isinstance(scene, UnreadScene) or not isinstance(
        error, (CoverageError, NoConsensus, NotEnoughPoints)
    ):
        return (NextStep("Correct what the reason names, and run the registration again.", command),)
    if isinstance(error, OtherGround):
        return _find_control(scene, command)
    if isinstance(error, TurnedImage):
        text = "Turn the image or its model as the reason says, and run the registration again."
        return (NextStep(text, command),)
    if isinstance(error, RescaledImage):
        text = "Give the model of this image, or the image of this model, and register again."
        return (NextStep(text, f"{command} --model FILE"),)
    if isinstance(error, BrokenImage):
        text = (
            "Have the image delivered without lost or repeated lines, or cut it at the lines that the "
            "reason names and register the parts that show enough points."
        )
        return NextStep(text, ""), *_search_otherwise(scene, stages, command)
    return _search_otherwise(scene, stages, command)


def _search_otherwise(
    scene: SceneRecord, stages: tuple[SearchStage, ...], command: str
) -> tuple[NextStep, ...]:
    """What to try where the searches of a scene, if any was made, did not find enough points."""
    if not stages:
        return (*_find_control(scene, command), _state_larger(scene, command))
    last = stages[-1]
    check = NextStep(
        "Check that the model belongs to this image, and that the points show this ground: the reasons "
        "in the table say why points were not found.",
        "",
    )
    if last.limited:
        smaller = f"--sigma-m {last.search_radius_m / MAX_ERROR_SIGMAS:.2g}"
        text = (
            f"The search reached {number(last.search_radius_m, 0)} m of the "
            f"{number(last.needed_radius_m, 0)} m that the accuracy of the model asks for. State a "
            "smaller error where it is known, or give points with coarser chips."
        )
        return NextStep(text, f"{command} {smaller}"), check
    larger = _state_larger(scene, command, last)
    if math.isfinite(last.middle_m):
        text = (
            f"Only the middle {number(last.middle_m / 1000.0, 1)} km of the scene, which is larger, was "
            "searched. Give points with coarser chips, with which all of it is searched, or points that "
            "show its middle."
        )
        return NextStep(text, command), larger, check
    if 2 * last.at_border > last.tried:
        return larger, check
    if 2 * last.matched > last.tried or any(one.points > 2 for one in last.candidates):
        return check, larger
    look = NextStep(
        "The points do not look like the scene there. Register on points or on an ortho-image of a "
        "similar season, sun and ground sampling.",
        f"{command} --reference ORTHO.tif --dem DEM.tif --vertical DATUM",
    )
    return (larger, check, look) if len(stages) == 1 else (check, look, larger)


def _state_larger(scene: SceneRecord, command: str, stage: SearchStage | None = None) -> NextStep:
    """Search further out: the model may be further off than stated."""
    larger_m = larger_sigma_m(stage, scene.sigma_m)
    why = "When the model may be further off"
    if stage is not None and 2 * stage.at_border > stage.tried:
        why = f"{stage.at_border} of {stage.tried} best peaks lie at the border of the search"
    text = (
        f"{why}: search further. The model was taken to be accurate to {scene.sigma_m:g} m (one "
        "standard deviation a coordinate); state a larger value."
    )
    return NextStep(text, f"{command} --sigma-m {larger_m:g}")


def _find_control(scene: SceneRecord, command: str) -> tuple[NextStep, ...]:
    """Look for points of the ground, or register on something else; not in a block that has none."""
    words = shlex.split(command)
    if "--block" in words:
        at = words.index("--block")
        command = shlex.join(words[:at] + words[at + 2 :])
    west, south = scene.footprint_lon_lat.min(axis=0)
    east, north = scene.footprint_lon_lat.max(axis=0)
    return (
        NextStep(
            "Look whether published points cover the ground of the scene.",
            f"amers points query --bbox {west:.4f},{south:.4f},{east:.4f},{north:.4f}",
        ),
        NextStep(
            "Where there are no points, register on an ortho-image of this ground.",
            f"{command} --reference ORTHO.tif --dem DEM.tif --vertical DATUM",
        ),
    )


def significance_words(false_alarms: float) -> str:
    """How likely chance alone makes a group of matches that agree, in words."""
    if not false_alarms < 1.0:
        return "no more than chance gives"
    if false_alarms > 1e-4:
        return f"chance gives one in {1.0 / false_alarms:.0f} searches: not enough to trust it"
    return "beyond chance"
