"""Registering a scene: read its files, find points, call the science, write the outcome."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

import numpy as np
import shapely

from app.auth import Scope
from app.db import registrations, scenes
from app.db.engine import Connection, Database
from app.db.points import control_points
from app.db.tokens import Token
from app.errors import Conflict, InputError
from app.storage import Storage, StoredChips
from app.usecases import history
from app.usecases.processes import Commit, Process, Work
from app.usecases.reference import ReferenceFiles, read_reference
from app.usecases.registration_files import OUTPUTS, write_outputs
from app.usecases.scenes import clean_name, local_image, visible_scene
from services.errors import CoverageError
from services.formats.block import FolderChips
from services.formats.block_check import check_block
from services.formats.scenes import read_scene
from services.reference import (
    ReferenceChips,
    ReferenceOptions,
    homologous_points,
    register_on_reference,
)
from services.registration import Registration, RegistrationOptions, register_scene
from services.reports.document import report_document
from services.reports.report import BlockUsed, RegistrationReport
from services.scene import Scene, scene_footprint, scene_gsd_m
from services.types import Array, ChipSource, ControlPoints, Progress, no_progress

METRES_PER_DEGREE = 111_320.0
REACH_SIGMAS = 3.0
"""A model may be wrong by this many of its standard deviations; points are looked for that far out."""


@dataclass(frozen=True)
class RegisterScene:
    """What a user says to have a scene registered.

    Attributes:
        scene: id of an uploaded scene.
        model: name of the uploaded file that holds its model; by default it is found.
        options: of the registration.
    """

    scene: UUID
    model: str | None = None
    options: RegistrationOptions = field(default_factory=RegistrationOptions)


@dataclass(frozen=True)
class SceneFiles:
    """A scene on the disk.

    Attributes:
        image: the image; what lies beside it is looked at for a model.
        model: file of the model, if it is not found by itself.
        sigma_m: accuracy of the model, metres; by default what the producer or the sensor says.
    """

    image: Path
    model: Path | None = None
    sigma_m: float | None = None


@dataclass(frozen=True)
class FoundPoints:
    """Control points of a piece of ground.

    Attributes:
        chips: where the chips of the points are.
        blocks: whose points they are.
        frame_sigma_m: how well the frame of the worst of them is known, one standard deviation a
            coordinate; NaN when a block does not say.
    """

    points: ControlPoints
    chips: ChipSource
    blocks: tuple[BlockUsed, ...]
    frame_sigma_m: float


FindPoints = Callable[[Array], FoundPoints]
"""Points inside an outline (n, 2) of lon, lat."""


@dataclass(frozen=True)
class RegisteredScene:
    """What a registration made.

    Attributes:
        scene: as read; its pixels are gone once its files are.
        footprint: (n, 2) lon, lat outline of the scene.
        files: the outputs, by name.
    """

    scene: Scene
    registration: Registration
    report: RegistrationReport
    footprint: Array
    files: dict[str, Path]


def run_registration(
    files: SceneFiles,
    find_points: FindPoints | None,
    options: RegistrationOptions,
    folder: Path,
    progress: Progress = no_progress,
    reference: ReferenceFiles | None = None,
) -> RegisteredScene:
    """Register one scene and write what came out of it into a folder.

    Args:
        files: the scene.
        find_points: the control points; None registers on the reference only.
        options: thresholds.
        folder: made when missing.
        progress: told where the work stands.
        reference: what the scene is registered on where there is no control point.

    Raises:
        InputError: the scene cannot be used.
        ComputationError: it cannot be registered.
    """
    started_at = datetime.now(UTC)
    scene = read_scene(files.image, files.model, files.sigma_m)
    footprint = scene_footprint(scene)
    registration, found = _registered(
        scene,
        footprint,
        find_points,
        reference,
        options,
        lambda fraction, message: progress(0.9 * fraction, message),
    )
    progress(0.9, "writing the report")
    report, paths = write_outputs(
        folder,
        files.image,
        files.model,
        scene,
        found.points,
        found.chips,
        found.blocks,
        registration,
        options,
        started_at,
    )
    return RegisteredScene(scene, registration, report, footprint, paths)


def _registered(
    scene: Scene,
    footprint: Array,
    find_points: FindPoints | None,
    reference: ReferenceFiles | None,
    options: RegistrationOptions,
    progress: Progress,
) -> tuple[Registration, FoundPoints]:
    """A registration and the points it was made on: control points, or else places of a reference."""
    if find_points is not None:
        progress(0.0, "looking for points")
        found = find_points(_grown(footprint, REACH_SIGMAS * scene.sigma_m))
        try:
            registration = register_scene(
                scene, found.points, found.chips, options, progress, found.frame_sigma_m
            )
            return registration, found
        except CoverageError:
            if reference is None:
                raise
    if reference is None:
        raise InputError("neither control points nor a reference to register the scene on")
    held = read_reference(reference)
    of_reference = ReferenceOptions(
        seed=options.seed, adjustment=options.adjustment, qualification=options.qualification
    )
    registration = register_on_reference(scene, held, of_reference, progress)
    lon_lat_h = registration.measures.lon_lat_h
    points, chips = homologous_points(lon_lat_h, held), ReferenceChips(held, lon_lat_h)
    block = BlockUsed(reference.image.name, "reference image")
    return registration, FoundPoints(points, chips, (block,), held.frame_sigma_m)


def points_of_block(folder: Path) -> FindPoints:
    """Points straight out of a block folder, once it has been checked entirely."""
    contents = check_block(folder)
    metadata = contents.document.metadata
    said = next((figure.value for figure in metadata.accuracy if figure.name == "frame_sigma_m"), None)

    def find(outline: Array) -> FoundPoints:
        block = BlockUsed(metadata.id, metadata.version)
        return FoundPoints(contents.points, FolderChips(folder), (block,), _frame_sigma_m([said]))

    return find


def points_of_store(database: Database, storage: Storage) -> FindPoints:
    """Points of the published blocks of the store."""

    def find(outline: Array) -> FoundPoints:
        with database.transaction() as connection:
            found = control_points(connection, outline)
        blocks = tuple(BlockUsed(block.id, block.version) for block in found.blocks)
        frame_sigma_m = _frame_sigma_m([block.frame_sigma_m for block in found.blocks])
        return FoundPoints(found.points, StoredChips(storage), blocks, frame_sigma_m)

    return find


def record(
    connection: Connection,
    registered: RegisteredScene,
    scene_key: str,
    *,
    job_id: UUID | None = None,
    scene_id: UUID | None = None,
    keys: dict[str, str] | None = None,
) -> UUID:
    """Remember a registration and what happened to each point in it.

    Args:
        scene_key: the same for the same image; see `history.remember`.
    """
    report = report_document(registered.report)
    registration_id = registrations.insert_registration(
        connection,
        job_id=job_id,
        scene_id=scene_id,
        block_versions=report["blocks"],
        options=report["options"],
        report=report,
        verdict=registered.registration.qualification.verdict,
        files=keys or {},
    )
    history.remember(connection, registration_id, registered.registration, scene_key)
    return registration_id


def key_of_file(image: Path) -> str:
    """What tells an image on the disk from others without reading it all: its place, size and time."""
    found = image.stat()
    said = f"{image.resolve()} {found.st_size} {found.st_mtime_ns}"
    return sha256(said.encode()).hexdigest()


def _check(connection: Connection, caller: Token, inputs: RegisterScene) -> None:
    scene = visible_scene(connection, caller, inputs.scene)
    if scene.state != "uploaded":
        raise Conflict(f"scene {inputs.scene} cannot be registered: its image is {scene.state}")
    if inputs.model is not None and inputs.model != clean_name(inputs.model):
        raise InputError(f"model: {inputs.model!r} is not the name of an uploaded file")


def _run(work: Work) -> Commit:
    """Register an uploaded scene; the files are in the storage before the rows that name them."""
    inputs: RegisterScene = work.inputs
    with work.database.transaction() as connection:
        scene = scenes.find_scene(connection, inputs.scene)
    if scene is None or scene.state == "removed":
        raise Conflict(f"scene {inputs.scene} has been removed")
    find_points = points_of_store(work.database, work.storage)
    with TemporaryDirectory(prefix="amers-") as scratch, TemporaryDirectory(prefix="amers-") as folder:
        image = local_image(work.storage, work.settings, scene, Path(scratch))
        model = inputs.model and image.with_name(inputs.model)
        files = SceneFiles(image, model or None, scene.sigma_m)
        made = run_registration(files, find_points, inputs.options, Path(folder), work.progress)
        gsd_m = scene_gsd_m(made.scene)
        keys = {
            name: work.storage.put_file(f"{work.attempt_folder}/{name}", path).key
            for name, path in made.files.items()
        }

    def commit(connection: Connection) -> dict[str, Any]:
        key = scene.sha256 or f"scene {scene.id}"
        record(connection, made, key, job_id=work.job.id, scene_id=inputs.scene, keys=keys)
        scenes.set_footprint(connection, inputs.scene, made.footprint)
        taken, shape = made.scene.acquisition, made.scene.image.shape
        scenes.describe(connection, inputs.scene, taken, shape, gsd_m)
        return {"verdict": made.report.verdict, "files": keys}

    return commit


def _frame_sigma_m(said: Sequence[float | None]) -> float:
    """The worst of what blocks say of their frames; NaN when one says nothing."""
    return math.nan if None in said or not said else max(value for value in said if value is not None)


def _grown(outline: Array, metres: float) -> Array:
    """An outline (n, 2) of lon, lat with so many metres more on every side."""
    centre = outline.mean(axis=0)
    scale = METRES_PER_DEGREE * np.array([max(np.cos(np.radians(centre[1])), 0.01), 1.0])
    grown = shapely.buffer(shapely.Polygon((outline - centre) * scale), metres, quad_segs=2)
    return np.asarray(centre + np.array(grown.exterior.coords)[:-1] / scale)


REGISTER_SCENE = Process(
    id="register-scene",
    title="Register a scene",
    description="Refine the sensor model of an uploaded scene on the control points of its footprint.",
    scope=Scope.REGISTER,
    inputs=RegisterScene,
    outputs=OUTPUTS,
    check=_check,
    run=_run,
)
