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

from app.cli.progress import shown_progress
from app.config import Settings, read_settings
from app.db import engine
from app.db.engine import Database
from app.errors import AmersError, ComputationError, InputError
from app.storage import open_storage
from app.usecases.references import references_of_store
from app.usecases.registration.control_sources import points_of_block, points_of_store
from app.usecases.registration.reference_source import ReferenceFiles, given_reference
from app.usecases.registration.register import (
    ControlSources,
    SceneFiles,
    image_key,
    record_registration,
    run_registration,
)
from app.usecases.uploads import IMAGE_SUFFIXES
from app.worker.warm_process import WarmProcess, WarmServer
from services.reports.document import report_document
from services.types import Progress, no_progress

Register = Callable[[SceneFiles, Path, Progress, bool], dict[str, Any]]
"""Registers one scene into a folder and returns its report; the last argument copies the image too."""
Outcome = dict[str, Any] | AmersError
"""The figures to show of one registered scene, or the error that ended its registration."""

_FUNCTION = "app.cli.scene_registration:register_in_process"
_POLL_S = 1.0


@dataclass(frozen=True)
class Control:
    """The control that a command names; without any, that of the store is used.

    Attributes:
        block: folder of a block.
        reference: ortho-image and its terrain.
    """

    block: Path | None
    reference: ReferenceFiles | None


@dataclass(frozen=True)
class SceneRequest:
    """One scene of a command.

    Attributes:
        files: of the scene.
        folder: for its outputs.
        copy_image: also copy a GeoTIFF, with the refined model in its tags.
    """

    files: SceneFiles
    folder: Path
    copy_image: bool


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
        inside = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
        if not inside:
            raise InputError(f"{path}: no image ({', '.join(IMAGE_SUFFIXES)}) in this folder")
        images.extend(inside)
    return images


def outcome_of(
    register_one: Register, request: SceneRequest, progress: Progress | None = None
) -> Outcome:
    """The outcome of one scene; its progress is shown, unless it is received by `progress`."""
    image, folder = request.files.image, request.folder
    try:
        with ExitStack() as shown:
            receiver = progress or shown.enter_context(shown_progress())
            report = register_one(request.files, folder, receiver, request.copy_image)
    except AmersError as error:
        return error
    if report["verdict"] == "failed":
        return ComputationError(
            f"{image}: the registration has the verdict failed, do not use its model; see "
            f"{folder / 'report.html'}"
        )
    counts, correction = report["point_counts"], report["correction"]
    return {
        "scene": image,
        "verdict": report["verdict"],
        "visible": counts["visible"],
        "matched": counts["matched"],
        "active": counts["active"],
        "correction": correction["order"],
        "shift_px": correction["shift_px"],
        "shift_m": correction["shift_m"],
        "residual_rms_px": report["image_residuals_px"]["xy"]["rms"],
        "ce90_predicted_px": report["predicted"]["worst_px"],
        **_check_figures(report["checks"]),
        "output": folder,
    }


def _check_figures(checks: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures to show of independent check points, if there are any."""
    if not checks:
        return {}
    accuracy = checks[0]["accuracy"]
    return {"check_points": accuracy["n"], "check_ce90_m": accuracy["ce90_m"]["value"]}


@contextmanager
def registrar(control: Control) -> Iterator[Register]:
    """The function that registers scenes on the control of a command."""
    if control.block is not None or control.reference is not None:
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
    )

    def register_one(
        files: SceneFiles, folder: Path, progress: Progress, copy_image: bool
    ) -> dict[str, Any]:
        registered = run_registration(files, sources, folder, copy_image=copy_image, progress=progress)
        return report_document(registered.report)

    return register_one


def _on_store(database: Database, settings: Settings) -> Register:
    """A function that registers scenes on the store and records the registrations there."""
    storage = open_storage(settings)
    sources = ControlSources(points_of_store(database, storage), references_of_store(database, settings))

    def register_one(
        files: SceneFiles, folder: Path, progress: Progress, copy_image: bool
    ) -> dict[str, Any]:
        registered = run_registration(files, sources, folder, copy_image=copy_image, progress=progress)
        with database.transaction() as connection:
            record_registration(connection, registered, image_key(files.image))
        return report_document(registered.report)

    return register_one


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
    if control.block is not None or control.reference is not None:
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
    started = time.monotonic()
    try:
        with registrar(control) as register_one:
            outcome = outcome_of(register_one, request, no_progress)
    except AmersError as error:
        outcome = error
    if isinstance(outcome, AmersError):
        outcome = {"error": str(outcome), "is_computation": isinstance(outcome, ComputationError)}
    else:
        outcome["seconds"] = round(time.monotonic() - started, 2)
    part = outcome_file.with_suffix(".part")
    part.write_text(json.dumps(outcome, default=os.fspath))
    part.rename(outcome_file)
    return 0


def _read_outcome(file: Path, request: SceneRequest, code: int) -> Outcome:
    """The outcome that a process has written, or an error when it ended without one."""
    image = request.files.image
    if not file.exists():
        return ComputationError(f"{image}: its process ended with code {code} and without an outcome")
    outcome: dict[str, Any] = json.loads(file.read_text())
    if "error" not in outcome:
        return outcome
    message = outcome["error"] if str(image) in outcome["error"] else f"{image}: {outcome['error']}"
    return ComputationError(message) if outcome["is_computation"] else InputError(message)
