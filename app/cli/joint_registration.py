"""Registration of the scenes of a command together, in one adjustment."""

import shlex
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer

from amers.app.cli.progress import shown_progress
from amers.app.cli.scene_registration import Outcome, SceneRequest, failed_outcome, registered_outcome
from amers.app.config import read_settings
from amers.app.db import engine
from amers.app.db.engine import Database
from amers.app.errors import AmersError, ComputationError, InputError
from amers.app.usecases import storage_identity
from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.registration.control_marks import MarkFiles
from amers.app.usecases.registration.control_sources import (
    FindPoints,
    no_points,
    points_of_block,
    points_of_store,
)
from amers.app.usecases.registration.joined_scenes import read_joined
from amers.app.usecases.registration.register import SceneFiles, image_key, record_registration
from amers.app.usecases.registration.result_folder import older_result, replacing
from amers.app.usecases.registration.together import (
    BLOCK_FOLDER,
    JointOutcome,
    JointPlace,
    run_joint_registration,
)
from amers.services.formats.images.scenes import scene_name
from amers.services.quality.qualification import QualificationOptions
from amers.services.registration.options import RegistrationOptions
from amers.services.reports.document import report_document


@dataclass(frozen=True)
class JointRequest:
    """The scenes of a command that are registered together.

    Attributes:
        files: of the scenes.
        output: folder of the folders of the results.
        block: folder of a block of control points; None for the store, or for marks alone.
        marks: of a person in the scenes; None for none.
        joined: folder of results that these scenes join.
        copy_image: also copy GeoTIFFs, with the refined models in their tags.
        max_ce90_on_earth_m: see `QualificationOptions`.
        jobs: processes at once.
        words: of a command line that asks for the same, but for the scenes and the output.
    """

    files: Sequence[SceneFiles]
    output: Path
    block: Path | None
    marks: MarkFiles | None
    joined: Path | None
    copy_image: bool
    max_ce90_on_earth_m: float | None
    jobs: int
    words: Sequence[str] = ()

    @property
    def options(self) -> RegistrationOptions:
        """Of the registration."""
        limits = QualificationOptions(max_ce90_on_earth_m=self.max_ce90_on_earth_m)
        return RegistrationOptions(qualification=limits)

    @property
    def command(self) -> str:
        """The command that registers the scenes again, without the accuracy of their models."""
        images = [str(one.image) for one in self.files]
        words = [*images, *self.words, "-o", str(self.output)]
        return shlex.join(["amers", "scene", "register-many", *words])

    def scene(self, files: SceneFiles) -> SceneRequest:
        """One of the scenes, as it is asked for alone."""
        folder = self.output / scene_name(files.image)
        return SceneRequest(files, folder, self.copy_image, self.command, self.max_ce90_on_earth_m)


def register_together(request: JointRequest) -> tuple[list[Outcome], dict[str, Any]]:
    """The outcomes of all scenes, in their order, and figures of all of them; none without a result.

    Raises:
        InputError: a folder cannot be written, or nothing could be begun.
    """
    names = [scene_name(one.image) for one in request.files]
    if BLOCK_FOLDER in names:
        raise InputError(
            f"{BLOCK_FOLDER}: an image has this name, but the output folder of this name contains the "
            "report on all scenes; rename the image"
        )
    for name in (*names, BLOCK_FOLDER):
        older = older_result(request.output / name)
        if older is not None:
            typer.echo(
                f"amers: {request.output / name}: replaces the result of {older.scene} of "
                f"{older.written_at:%Y-%m-%d %H:%M} UTC, verdict {older.verdict}",
                err=True,
            )
    started = time.monotonic()
    with _control(request) as (find_points, database), ExitStack() as stack:
        new = {name: stack.enter_context(replacing(request.output / name)) for name in names}
        try:
            with replacing(request.output / BLOCK_FOLDER) as of_block:
                outcome = _run(request, find_points, {**new, BLOCK_FOLDER: of_block})
                if database is not None:
                    _record(database, request, outcome)
        except (InputError, ComputationError) as error:
            if not all((folder / "report.json").exists() for folder in new.values()):
                raise
            return [_failed(request, files, error) for files in request.files], {}
    outcomes = []
    for files in request.files:
        name = scene_name(files.image)
        if name in outcome.registered:
            document = report_document(outcome.registered[name].report)
            outcomes.append(registered_outcome(request.scene(files), document))
        else:
            outcomes.append(_failed(request, files, outcome.failed[name]))
    report = outcome.report
    return outcomes, {
        "block": request.output / BLOCK_FOLDER,
        "verdict_on_all": report.verdict,
        "words": report.verdict_words,
        "control_points": report.active_control_points,
        "tie_points": report.tie_points,
        "seconds": round(time.monotonic() - started, 2),
    }


def _failed(request: JointRequest, files: SceneFiles, error: AmersError) -> Outcome:
    folder = request.output / scene_name(files.image)
    return {**failed_outcome(request.scene(files), error), "output": folder}


@contextmanager
def _control(request: JointRequest) -> Iterator[tuple[FindPoints, Database | None]]:
    """What finds control points, and the store that records registrations on its points."""
    if request.block is not None:
        yield points_of_block(request.block), None
        return
    if request.marks is not None:
        yield no_points, None
        return
    settings = read_settings()
    with engine.opened(settings) as database:
        yield points_of_store(database, storage_identity.opened(database, settings)), database


def _run(request: JointRequest, find_points: FindPoints, folders: dict[str, Path]) -> JointOutcome:
    with shown_progress() as progress:
        return run_joint_registration(
            {scene_name(one.image): one for one in request.files},
            find_points,
            JointPlace(
                folders.__getitem__,
                request.output.resolve().name,
                ComputeOptions(jobs=request.jobs),
                None if request.joined is None else read_joined(request.joined / BLOCK_FOLDER),
            ),
            marks=request.marks,
            options=request.options,
            copy_image=request.copy_image,
            progress=progress,
            command=request.command,
        )


def _record(database: Database, request: JointRequest, outcome: JointOutcome) -> None:
    """Store the registrations, all in one transaction."""
    with database.transaction() as connection:
        for files in request.files:
            registered = outcome.registered.get(scene_name(files.image))
            if registered is not None:
                record_registration(connection, registered, image_key(files.image))
