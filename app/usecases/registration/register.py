"""Registering a scene: read its files, find points, call the science, write the outcome."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Literal
from uuid import UUID

import numpy as np
import shapely

from app.db import registrations
from app.db.engine import Connection
from app.usecases import history
from app.usecases.references import keep_places
from app.usecases.registration.check_points import read_check_points
from app.usecases.registration.control_sources import ControlSet, FindPoints
from app.usecases.registration.deliverables import write_outputs
from app.usecases.registration.reference_source import FindReference, FoundReference, register_on
from services.conventions import MAX_ERROR_SIGMAS
from services.errors import CoverageError
from services.formats.images.bands import parse_bands
from services.formats.images.scenes import read_scene
from services.formats.sensor_models.refined_model import write_refined
from services.imagery.scene import Scene, scene_footprint
from services.quality.check_points import CheckPoints, check_model, with_check_points
from services.registration.on_points import Registration, register_scene
from services.registration.options import RegistrationOptions
from services.reports.build import build_report, scene_record
from services.reports.document import report_document
from services.reports.figure_data import figure_data
from services.reports.report import Check, RefinedModelRecord, RegistrationReport, RunRecord
from services.types import Array, Progress, no_progress

Method = Literal["auto", "points", "reference"]
"""What a scene is registered on: control points, a reference image, or that where there is no point."""

METRES_PER_DEGREE = 111_320.0


@dataclass(frozen=True)
class SceneFiles:
    """A scene on the disk.

    Attributes:
        image: the image; what lies beside it is looked at for a model.
        model: file of the model, if it is not found by itself.
        sigma_m: accuracy of the model, metres; by default what the producer or the sensor says.
        bands: what is looked at; see `services.formats.images.bands.parse_bands`.
        mask: image of the same ground, not zero where pixels shall not be used.
        check_points: points held out of the registration.
        check_heights: what their heights are above, where their format cannot say.
    """

    image: Path
    model: Path | None = None
    sigma_m: float | None = None
    bands: str | None = None
    mask: Path | None = None
    check_points: Path | None = None
    check_heights: str | None = None


@dataclass(frozen=True)
class RegisteredScene:
    """What a registration made.

    Attributes:
        scene: as read; its pixels are gone once its files are.
        reference: what it was registered on; None: control points.
        footprint: (n, 2) lon, lat outline of the scene.
        files: the outputs, by name.
    """

    scene: Scene
    registration: Registration
    reference: FoundReference | None
    report: RegistrationReport
    footprint: Array
    files: dict[str, Path]


def run_registration(
    files: SceneFiles,
    find_points: FindPoints | None,
    options: RegistrationOptions,
    folder: Path,
    progress: Progress = no_progress,
    find_reference: FindReference | None = None,
    method: Method = "auto",
    copy_image: bool = False,
) -> RegisteredScene:
    """Register one scene and write what came out of it into a folder.

    Args:
        files: the scene.
        find_points: the control points; None: there are none.
        options: thresholds.
        folder: made when missing.
        progress: told where the work stands.
        find_reference: what the scene is registered on where there is no control point.
        method: "auto" or one of both.
        copy_image: also copy a GeoTIFF, with the refined model in its tags.

    Raises:
        InputError: the scene, its mask or its check points cannot be used.
        ComputationError: it cannot be registered.
    """
    started_at = datetime.now(UTC)
    bands = None if files.bands is None else parse_bands(files.bands)
    scene = read_scene(files.image, files.model, sigma_m=files.sigma_m, bands=bands, mask=files.mask)
    held_out = None
    if files.check_points is not None:
        held_out = read_check_points(files.check_points, files.check_heights, files.image, scene)
    footprint = scene_footprint(scene)
    outline = _grown(footprint, MAX_ERROR_SIGMAS * scene.sigma_m)
    registration, found, reference = _registered(
        scene,
        outline,
        None if method == "reference" else find_points,
        None if method == "points" else find_reference,
        options,
        lambda fraction, message: progress(0.9 * fraction, message),
    )
    checks: tuple[Check, ...] = ()
    if held_out is not None and files.check_points is not None:
        registration, check = _checked(registration, held_out, found, options, files.check_points.name)
        checks = (check,)
    progress(0.9, "writing the report")
    refined = write_refined(
        files.image,
        files.model,
        registration.model,
        registration.adjustment,
        shape=scene.image.shape,
        folder=folder,
        copy_image=copy_image,
    )
    report = build_report(
        registration,
        scene_record(scene, files.image.stem),
        RunRecord(
            software_version=version("amers"),
            started_at=started_at,
            finished_at=datetime.now(UTC),
            method="control points" if reference is None else "reference image",
            blocks=found.blocks,
            options=options,
        ),
        RefinedModelRecord(refined.max_error_px, refined.note),
        figure_data(scene, found.points, found.chips, registration),
        checks=checks,
    )
    paths = write_outputs(folder, report, files.image.name, found.points)
    written = {path.name: path for path in (*paths, *refined.files)}
    return RegisteredScene(scene, registration, reference, report, footprint, written)


def _registered(
    scene: Scene,
    outline: Array,
    find_points: FindPoints | None,
    find_reference: FindReference | None,
    options: RegistrationOptions,
    progress: Progress,
) -> tuple[Registration, ControlSet, FoundReference | None]:
    """A registration and what it was made on: control points, or else places of a reference."""
    missing = CoverageError("no reference image shows the ground of the scene")
    if find_points is not None:
        progress(0.0, "looking for points")
        found = find_points(outline)
        try:
            registration = register_scene(
                scene,
                found.points,
                found.chips,
                options,
                progress=progress,
                frame_sigma_m=found.frame_sigma_m,
            )
            return registration, found, None
        except CoverageError as error:
            missing = error
    reference = None if find_reference is None else find_reference(outline)
    if reference is None:
        raise missing
    return (*register_on(reference, scene, options, progress), reference)


def _checked(
    registration: Registration,
    points: CheckPoints,
    found: ControlSet,
    options: RegistrationOptions,
    name: str,
) -> tuple[Registration, Check]:
    """The registration, qualified with check points too, and its accuracy at these points."""
    checked = check_model(registration.model, registration.adjustment, points, found.frame_sigma_m)
    limit = options.qualification.good_unit_weight
    qualification = with_check_points(registration.qualification, checked, limit)
    check = Check(
        f"independent check points of {name}",
        checked.accuracy,
        checked.residual_px,
        checked.normalised,
    )
    return replace(registration, qualification=qualification), check


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
        scene_key: the same for the same image; see `history.record_measures`.
    """
    report = report_document(registered.report)
    registration_id = registrations.insert_registration(
        connection,
        job_id=job_id,
        scene_id=scene_id,
        block_versions=report["run"]["blocks"],
        options=report["run"]["options"],
        report=report,
        verdict=registered.registration.qualification.verdict,
        files=keys or {},
    )
    made, reference = registered.registration, registered.reference
    if reference is None:
        history.record_measures(connection, registration_id, made, scene_key)
    else:
        keep_places(connection, reference, made, registered.footprint)
    return registration_id


def key_of_file(image: Path) -> str:
    """What tells an image on the disk from others without reading it all: its place, size and time."""
    found = image.stat()
    said = f"{image.resolve()} {found.st_size} {found.st_mtime_ns}"
    return sha256(said.encode()).hexdigest()


def _grown(outline: Array, metres: float) -> Array:
    """An outline (n, 2) of lon, lat with so many metres more on every side."""
    centre = outline.mean(axis=0)
    scale = METRES_PER_DEGREE * np.array([max(np.cos(np.radians(centre[1])), 0.01), 1.0])
    grown = shapely.buffer(shapely.Polygon((outline - centre) * scale), metres, quad_segs=2)
    return np.asarray(centre + np.array(grown.exterior.coords)[:-1] / scale)
