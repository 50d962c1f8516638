"""Registration of the scenes of a command: one in this process, many in warm processes."""

import json
import os
import pickle
import select
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import typer

from amers.app.cli.exit_status import FAILURE, NO_RESULT, SUCCESS, exit_status
from amers.app.cli.progress import shown_progress
from amers.app.cli.remote import register
from amers.app.client import Client, ServiceError
from amers.app.config import Settings, read_settings
from amers.app.db import engine
from amers.app.db.engine import Database
from amers.app.errors import AmersError, ComputationError, InputError
from amers.app.usecases import storage_identity
from amers.app.usecases.references import references_of_store
from amers.app.usecases.registration.control_marks import MarkFiles
from amers.app.usecases.registration.control_sources import points_of_block, points_of_store
from amers.app.usecases.registration.failure import Attempt, has_report, write_failure
from amers.app.usecases.registration.reference_source import ReferenceFiles, given_reference
from amers.app.usecases.registration.register import (
    ControlSources,
    RegisteredScene,
    SceneFiles,
    image_key,
    record_registration,
    run_registration,
)
from amers.app.usecases.registration.result_folder import older_result, replacing
from amers.app.usecases.report_files import REPORT_FILES
from amers.app.worker.warm_process import WarmProcess, WarmServer
from amers.services.formats.sensor_models.product_files import IMAGE_SUFFIXES, scenes_in
from amers.services.quality.accuracy_statement import accuracy_document
from amers.services.quality.qualification import QualificationOptions
from amers.services.registration.options import RegistrationOptions
from amers.services.reports.document import report_document
from amers.services.reports.failure import NO_ACCURACY, NOT_REGISTERED
from amers.services.types import Progress, no_progress

Register = Callable[["SceneRequest", Path, Progress], dict[str, Any]]
"""Registers the scene of a request into a folder and returns its report."""
Outcome = dict[str, Any]
"""What became of one scene: `scene`, `verdict`, `reason`, `exit_status`; figures where there are any;
and the folder `output` when this run has put its result there."""

_FUNCTION = "amers.app.cli.scene_registration:register_in_process"
_POLL_S = 1.0


@dataclass(frozen=True)
class Control:
    """The control that a command names; without any, that of the store is used.

    Attributes:
        block: folder of a block.
        reference: ortho-image and its terrain.
        marks: of a person in the scene.
    """

    block: Path | None
    reference: ReferenceFiles | None
    marks: MarkFiles | None = None


@dataclass(frozen=True)
class Remote:
    """A service that does the registration.

    Attributes:
        url: address of the service.
        token: for it; "" for none.
    """

    url: str
    token: str


@dataclass(frozen=True)
class SceneRequest:
    """One scene of a command.

    Attributes:
        files: of the scene.
        folder: for its outputs.
        copy_image: also copy a GeoTIFF, with the refined model in its tags.
        command: that repeats the registration, without the accuracy of the model.
        max_ce90_on_earth_m: see `QualificationOptions`.
    """

    files: SceneFiles
    folder: Path
    copy_image: bool
    command: str
    max_ce90_on_earth_m: float | None


def images_of(paths: Sequence[Path]) -> list[Path]:
    """The images among paths, with every image directly inside those that are folders, by name.

    Raises:
        InputError: a folder has no image.
    """
    images: list[Path] = []
    for path in paths:
        if not path.is_dir():
            images.append(path)
            continue
        inside = scenes_in(path)
        if not inside:
            raise InputError(
                f"{path}: the folder contains no image ({', '.join(IMAGE_SUFFIXES)}); name a folder "
                "with images, or the images themselves"
            )
        images.extend(inside)
    return images


def register_scenes(
    requests: Sequence[SceneRequest], control: Control, remote: Remote | None, jobs: int
) -> list[Outcome]:
    """The outcomes of all scenes, in their order. Results that will be replaced are named first.

    Args:
        requests: the scenes.
        control: that they are registered on.
        remote: the service that does the work; None for this machine.
        jobs: number of processes at once.
    """
    outcomes: dict[int, Outcome] = {}
    replaced = set()
    for number, request in enumerate(requests):
        try:
            older = older_result(request.folder)
        except AmersError as error:
            outcomes[number] = failed_outcome(request, error)
            continue
        if older is not None:
            replaced.add(number)
            typer.echo(
                f"amers: {request.folder}: replaces the result of {older.scene} of "
                f"{older.written_at:%Y-%m-%d %H:%M} UTC, verdict {older.verdict}",
                err=True,
            )
    accepted = [number for number in range(len(requests)) if number not in outcomes]
    outcomes |= zip(
        accepted, _register_accepted([requests[k] for k in accepted], control, remote, jobs), strict=True
    )
    for number in replaced:
        if "output" not in outcomes[number]:
            outcomes[number]["reason"] += "; the older result stays in its folder as it was"
    return [outcomes[number] for number in range(len(requests))]


def _register_accepted(
    requests: Sequence[SceneRequest], control: Control, remote: Remote | None, jobs: int
) -> list[Outcome]:
    """The outcomes of the scenes whose folders can be written."""
    if not requests:
        return []
    try:
        if remote is not None:
            with Client(remote.url, remote.token) as client:
                on_service = _on_service(client, control.marks)
                return [outcome_of(on_service, request) for request in requests]
        if len(requests) == 1:
            with registrar(control) as register_one:
                return [outcome_of(register_one, requests[0])]
        return register_many(requests, control, jobs)
    except AmersError as error:
        return [failed_outcome(request, error) for request in requests]


def outcome_of(
    register_one: Register, request: SceneRequest, progress: Progress | None = None
) -> Outcome:
    """The outcome of one scene; its progress is shown, unless it is received by `progress`.

    An error that should not happen is raised again, once its report is in its place.
    """
    started = time.monotonic()
    unexpected = None
    try:
        with ExitStack() as shown, replacing(request.folder) as new:
            receiver = progress or shown.enter_context(shown_progress())
            try:
                outcome = registered_outcome(request, register_one(request, new, receiver))
            except (InputError, ComputationError) as error:
                _keep_only_failure(request, new, error)
                report = json.loads((new / "report.json").read_text(encoding="utf-8"))
                outcome = failed_outcome(request, error)
                outcome |= {"output": request.folder, **_notes(report)}
            except Exception as error:
                if isinstance(error, AmersError | ServiceError) or not has_report(error):
                    raise
                _keep_only_failure(request, new, error)
                unexpected = error
    except (AmersError, ServiceError) as error:
        return failed_outcome(request, error)
    if unexpected is not None:
        raise unexpected
    return {**outcome, "seconds": round(time.monotonic() - started, 2)}


def _keep_only_failure(request: SceneRequest, new: Path, error: Exception) -> None:
    """Leave nothing but the report of a failure in a new folder."""
    is_written = (new / "report.json").exists() and _is_of_failure(new / "report.json")
    for path in new.iterdir():
        if path.name not in REPORT_FILES or not is_written:
            path.unlink()
    if not is_written:
        attempt = Attempt(request.files.image, request.command, RegistrationOptions())
        write_failure(new, attempt, error)


def _is_of_failure(report: Path) -> bool:
    return bool(json.loads(report.read_text(encoding="utf-8"))["verdict"] == NOT_REGISTERED)


def failed_outcome(request: SceneRequest, error: Exception) -> Outcome:
    """The outcome of a scene whose registration ended with an error."""
    return {
        "scene": request.files.image,
        "verdict": NOT_REGISTERED,
        **accuracy_document(NO_ACCURACY),
        "reason": str(error),
        "exit_status": exit_status(error),
    }


def registered_outcome(request: SceneRequest, report: dict[str, Any]) -> Outcome:
    """The outcome of a scene with a report, by the verdict of the report."""
    is_failed = report["verdict"] == "failed"
    counts, correction = report["point_counts"], report["correction"]
    return {
        "scene": request.files.image,
        "verdict": report["verdict"],
        "verdict_scope": report["verdict_scope"],
        "relative_to_control_points": report["relative_to_control_points"],
        "on_the_earth": report["on_the_earth"],
        "reason": _do_not_use(request, report) if is_failed else report["verdict_explanation"],
        "exit_status": NO_RESULT if is_failed else SUCCESS,
        "visible": counts["visible"],
        "matched": counts["matched"],
        "active": counts["active"],
        "held_percent": report["coverage"]["percent"],
        "correction": correction["order"],
        "shift_px": correction["shift_px"],
        "shift_m": correction["shift_m"],
        "residual_rms_px": report["image_residuals_px"]["xy"]["rms"],
        **_check_figures(report["checks"]),
        **_of_marks(report.get("marks")),
        "refined_model": report["refined_model"]["note"] or None,
        "refined_model_error_px": report["refined_model"]["max_error_px"],
        "output": request.folder,
        **_notes(report),
    }


def _notes(report: dict[str, Any]) -> dict[str, Any]:
    """What a report notes of files and pixels; a service of an earlier version may not."""
    return {
        "statements": report["run"].get("statements", []),
        "pixel_findings": report["scene"].get("pixel_findings", []),
        "findings": report.get("findings", []),
    }


def _do_not_use(request: SceneRequest, report: dict[str, Any]) -> str:
    """Why a registration has the verdict failed: the criteria of a usable one that it does not meet."""
    unmet = [
        f"{criterion['label']} {criterion['note']}".rstrip()
        for criterion in report["criteria"]
        if not criterion["met"] and criterion["needed_for"] == "usable"
    ]
    return (
        f"the registration has the verdict failed ({'; '.join(unmet)}), do not use its model; see "
        f"{request.folder / 'report.html'}"
    )


def worst_status(outcomes: Sequence[Outcome]) -> int:
    """The exit status of a command with several scenes: the smallest one that is not success."""
    return min(
        (outcome["exit_status"] for outcome in outcomes if outcome["exit_status"]), default=SUCCESS
    )


def _check_figures(checks: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures to show of independent check points, if there are any."""
    if not checks:
        return {}
    accuracy = checks[0]["accuracy"]
    return {"check_points": accuracy["n"], "check_ce90_m": accuracy["ce90_m"]["value"]}


def _of_marks(marks: dict[str, Any] | None) -> dict[str, Any]:
    """What became of marks of a person, if there are any."""
    return {} if marks is None else {"marks": marks}


@contextmanager
def registrar(control: Control) -> Iterator[Register]:
    """The function that registers scenes on the control of a command."""
    if control != Control(None, None):
        yield _on_files(control)
        return
    settings = read_settings()
    with engine.opened(settings) as database:
        yield _on_store(database, settings)


def _on_files(control: Control) -> Register:
    """A function that registers scenes on a block folder, a reference, or both."""
    sources = ControlSources(
        find_points=None if control.block is None else points_of_block(control.block),
        find_reference=None if control.reference is None else given_reference(control.reference),
        marks=control.marks,
    )

    def register_one(request: SceneRequest, folder: Path, progress: Progress) -> dict[str, Any]:
        registered = _run(request, sources, folder, progress)
        return report_document(registered.report)

    return register_one


def _run(
    request: SceneRequest, sources: ControlSources, folder: Path, progress: Progress
) -> RegisteredScene:
    return run_registration(
        request.files,
        sources,
        folder,
        options=RegistrationOptions(
            qualification=QualificationOptions(max_ce90_on_earth_m=request.max_ce90_on_earth_m)
        ),
        copy_image=request.copy_image,
        progress=progress,
        command=request.command,
    )


def _on_store(database: Database, settings: Settings) -> Register:
    """A function that registers scenes on the store and records the registrations there."""
    storage = storage_identity.opened(database, settings)
    sources = ControlSources(points_of_store(database, storage), references_of_store(database, settings))

    def register_one(request: SceneRequest, folder: Path, progress: Progress) -> dict[str, Any]:
        registered = _run(request, sources, folder, progress)
        with database.transaction() as connection:
            record_registration(connection, registered, image_key(request.files.image))
        return report_document(registered.report)

    return register_one


def _on_service(client: Client, marks: MarkFiles | None) -> Register:
    """A function that lets a service register scenes."""
    return lambda request, folder, progress: register(
        client,
        request.files,
        folder,
        progress,
        marks=marks,
        copy_image=request.copy_image,
        max_ce90_on_earth_m=request.max_ce90_on_earth_m,
    )


def register_many(requests: Sequence[SceneRequest], control: Control, jobs: int) -> list[Outcome]:
    """The outcomes of scenes in their order; each is registered in a process of its own.

    Args:
        requests: the scenes.
        control: that they are registered on.
        jobs: number of processes at once.
    """
    outcomes: dict[int, Outcome] = {}
    running: dict[int, WarmProcess] = {}
    waiting = list(enumerate(requests))
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="amers-")))
        server = stack.enter_context(WarmServer(_environment(stack, control)))
        progress = stack.enter_context(shown_progress())
        while waiting or running:
            while waiting and len(running) < jobs:
                number, request = waiting.pop(0)
                (folder / f"{number}.request").write_bytes(pickle.dumps((request, control)))
                arguments = [str(folder / f"{number}.request"), str(folder / str(number))]
                running[number] = server.start(_FUNCTION, arguments, {})
            select.select(list(running.values()), [], [], _POLL_S)
            for number, process in tuple(running.items()):
                code = process.wait(0.0)
                if code is not None:
                    running.pop(number).close()
                    outcomes[number] = _read_outcome(folder / str(number), requests[number], code)
                    done = f"{len(outcomes)} of {len(requests)} scenes"
                    progress(len(outcomes) / len(requests), done)
    return [outcomes[number] for number in range(len(requests))]


def _environment(stack: ExitStack, control: Control) -> dict[str, str]:
    """Variables with the place of the store, which stays open until the stack is closed."""
    if control != Control(None, None):
        return {}
    settings = read_settings()
    database = stack.enter_context(engine.opened(settings))
    return {
        "AMERS_DATABASE_URL": database.dsn,
        "AMERS_DATA_FOLDER": str(settings.data_folder),
    }


def register_in_process(arguments: list[str]) -> int:
    """Register the scene of a request, and write its outcome into a second file; returns 0."""
    request_file, outcome_file = map(Path, arguments)
    request, control = pickle.loads(request_file.read_bytes())
    try:
        with registrar(control) as register_one:
            outcome = outcome_of(register_one, request, no_progress)
    except AmersError as error:
        outcome = failed_outcome(request, error)
    part = outcome_file.with_suffix(".part")
    part.write_text(json.dumps(outcome, default=os.fspath))
    part.rename(outcome_file)
    return 0


def _read_outcome(file: Path, request: SceneRequest, code: int) -> Outcome:
    """The outcome that a process has written, or a failure when it ended without one."""
    if file.exists():
        outcome: Outcome = json.loads(file.read_text())
        return outcome
    reason = f"its process ended with code {code} and without an outcome"
    return {
        "scene": request.files.image,
        "verdict": NOT_REGISTERED,
        **accuracy_document(NO_ACCURACY),
        "reason": reason,
        "exit_status": FAILURE,
    }
