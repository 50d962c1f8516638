"""Register a scene: read its files, find control, call the science, write the outcome."""

import math
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from uuid import UUID

import numpy as np
import shapely

from amers.app.db import registrations
from amers.app.db.engine import Connection
from amers.app.usecases import history
from amers.app.usecases.references import record_places
from amers.app.usecases.registration.check_points import read_check_points
from amers.app.usecases.registration.control_marks import MarkFiles, read_control_marks
from amers.app.usecases.registration.control_sources import ControlSet, FindPoints
from amers.app.usecases.registration.deliverables import write_outputs
from amers.app.usecases.registration.failure import Attempt, has_report, write_failure
from amers.app.usecases.registration.reference_source import (
    CoveringReference,
    FindReference,
    read_reference,
    register_on,
)
from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.errors import CoverageError
from amers.services.formats.images.bands import parse_bands
from amers.services.formats.images.scenes import read_scene, scene_name
from amers.services.formats.sensor_models.refined_model import AdjustedRigorous, Stated, write_refined
from amers.services.formats.sensor_models.rpc_files import ImageFiles
from amers.services.geodesy import metres_per_degree
from amers.services.imagery.scene import Scene, scene_footprint
from amers.services.joint.results import RigorousScene
from amers.services.quality.check_points import CheckPoints, check_model, with_check_points
from amers.services.registration.on_marks import register_on_marks
from amers.services.registration.on_points import Registration, register_scene
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.scene_marks import NoChips, SceneMarks, with_marks
from amers.services.reports.build import build_report, scene_record, with_shares
from amers.services.reports.document import report_document
from amers.services.reports.figure_data import figure_data
from amers.services.reports.report import Check, RefinedModelRecord, RegistrationReport
from amers.services.sensors.base import SensorModel
from amers.services.sensors.parameter_sets import parameter_set_named
from amers.services.types import Array, Progress, no_progress, part_of


@dataclass(frozen=True)
class SceneFiles:
    """The files of a scene.

    Attributes:
        image: of the scene.
        model: file of its model; None finds it by its name.
        sigma_m: accuracy of the model, metres; by default that of the producer or the sensor.
        bands: to use; see `amers.services.formats.images.bands.parse_bands`.
        mask: image of the same ground; pixels are not used where it is not zero.
        check_points: file of points held out of the registration.
        check_heights: vertical datum of their heights, where their format cannot state it.
        rigorous: name of the free parameters of its rigorous model, where it has one and is registered
            together with others; None uses its RPC. See `PARAMETER_SETS`.
        crop_origin: line and sample of the image's first pixel in the image that the model is for; None
            where its files state it.
    """

    image: Path
    model: Path | None = None
    sigma_m: float | None = None
    bands: str | None = None
    mask: Path | None = None
    check_points: Path | None = None
    check_heights: str | None = None
    rigorous: str | None = None
    crop_origin: tuple[float, float] | None = None

    def read(self) -> Scene:
        """The scene; its files stay open."""
        return read_scene(
            self.image,
            self.model,
            sigma_m=self.sigma_m,
            bands=None if self.bands is None else parse_bands(self.bands),
            crop_origin=self.crop_origin,
            mask=self.mask,
            parameter_set=None if self.rigorous is None else parameter_set_named(self.rigorous),
        )


@dataclass(frozen=True)
class ControlSources:
    """Where a registration looks for its control.

    Attributes:
        find_points: finds control points; None for none.
        find_reference: finds a reference image where there are no control points; None for none.
        marks: files of ground points that a person marked in the image; None for none.
    """

    find_points: FindPoints | None = None
    find_reference: FindReference | None = None
    marks: MarkFiles | None = None


@dataclass(frozen=True)
class RegisteredScene:
    """The registration of a scene and its outputs.

    Attributes:
        registration: of the scene.
        reference: that the scene was registered on; None for control points.
        report: of the registration.
        files: the outputs, by name.
    """

    registration: Registration
    reference: CoveringReference | None
    report: RegistrationReport
    files: dict[str, Path]

    @property
    def footprint(self) -> Array:
        """Outline (n, 2) of the scene by the delivered model, lon and lat."""
        return self.report.scene.footprint_lon_lat


def run_registration(
    files: SceneFiles,
    sources: ControlSources,
    folder: Path,
    *,
    options: RegistrationOptions = RegistrationOptions(),
    copy_image: bool = False,
    progress: Progress = no_progress,
    command: str = "",
) -> RegisteredScene:
    """Register one scene and write the outputs into a folder; for one that fails, a report of that.

    An error that is none of the scene leaves a report, too, and is raised again.

    Args:
        files: of the scene.
        sources: of control points and reference images.
        folder: for the outputs; created when missing.
        options: of the registration.
        copy_image: also copy a GeoTIFF, with the refined model in its tags.
        progress: receives the fraction done and a message.
        command: that repeats this registration, without the accuracy of the model, for the report of a
            failure; by default one that names the image.

    Raises:
        InputError: the scene, its mask or its check points cannot be used.
        ComputationError: the scene cannot be registered.
    """
    attempt = Attempt(files.image, command or f"amers scene register {files.image.name}", options)
    try:
        return _register_and_write(files, sources, folder, attempt, copy_image, progress=progress)
    except Exception as error:
        if has_report(error):
            write_failure(folder, attempt, error)
        raise


def _register_and_write(
    files: SceneFiles,
    sources: ControlSources,
    folder: Path,
    attempt: Attempt,
    copy_image: bool,
    *,
    progress: Progress,
) -> RegisteredScene:
    """Register one scene and write the outputs; what is done is noted in the attempt."""
    scene = attempt.with_scene(files.read())
    held_out: list[tuple[str, CheckPoints]] = []
    marks = None
    if sources.marks is not None:
        of_scene = read_control_marks(sources.marks, files.image, scene)
        marks = of_scene.control
        attempt.statements.extend(marks.statements)
        if of_scene.check is not None:
            held_out.append((sources.marks.name, of_scene.check))
    if files.check_points is not None:
        check_points = read_check_points(files.check_points, files.check_heights, files.image, scene)
        attempt.statements.extend(check_points.statements)
        held_out.append((files.check_points.name, check_points))

    registration, reference = _register(scene, sources, marks, attempt, part_of(progress, 0.0, 0.9))

    checks: tuple[Check, ...] = ()
    for name, points in held_out:
        registration, check = checked(registration, points, attempt.options, name)
        checks += (check,)

    progress(0.9, "writing the report")
    registered = write_registered(
        files, registration, attempt, folder, copy_image=copy_image, checks=checks
    )
    return replace(registered, reference=reference)


def write_registered(
    files: SceneFiles,
    registration: Registration,
    attempt: Attempt,
    folder: Path,
    *,
    copy_image: bool,
    checks: tuple[Check, ...] = (),
    rigorous: RigorousScene | None = None,
) -> RegisteredScene:
    """Write the outputs of a scene that was registered alone or together with others.

    Args:
        files: of the scene.
        registration: of the scene.
        attempt: with the scene, as read, and its control.
        folder: for the outputs; created when missing.
        copy_image: also copy a GeoTIFF, with the refined model in its tags.
        checks: accuracy at points that had no part in the registration.
        rigorous: the adjusted rigorous model that is written in place of the corrected one.
    """
    scene, control = attempt.scene, attempt.control
    assert scene is not None
    assert control is not None
    model: SensorModel | AdjustedRigorous = registration.model
    if rigorous is not None:
        model = AdjustedRigorous(
            registration.model,
            rigorous.heights_m,
            rigorous.correction_error_px,
            rigorous.rpc,
            rigorous.attitude,
        )
    folder.mkdir(parents=True, exist_ok=True)
    refined = write_refined(
        ImageFiles(files.image, files.model, files.crop_origin),
        model,
        registration.adjustment,
        shape=scene.image.shape,
        folder=folder,
        copy_image=copy_image,
        stated=_stated(registration),
    )
    run = attempt.run_record()
    report = build_report(
        registration,
        scene_record(scene, scene_name(files.image)),
        replace(run, blocks=with_shares(run.blocks, control.points, registration.measures)),
        RefinedModelRecord(refined.max_error_px, refined.note),
        figure_data(scene, control.points, control.chips, registration),
        checks=checks,
        nearest_px=None if rigorous is None else rigorous.correction_error_px,
    )
    outputs = write_outputs(folder, report, files.image.name, control.points, registration.model)
    outputs.update({path.name: path for path in refined.files})
    return RegisteredScene(registration, None, report, outputs)


def _stated(registration: Registration) -> Stated:
    """What a registration states of its correction; without any accuracy, no RPC misses it."""
    quality = registration.qualification
    worst_px = quality.predicted.worst_px
    ce90_px = worst_px if np.isfinite(worst_px) else math.inf
    return Stated(registration.frame, quality.coverage.outline, ce90_px)


def record_registration(
    connection: Connection,
    registered: RegisteredScene,
    scene_key: str,
    *,
    job_id: UUID | None = None,
    scene_id: UUID | None = None,
    keys: dict[str, str] | None = None,
) -> UUID:
    """Store a registration with the measures of its points or places; returns the id of its row.

    Args:
        connection: with the transaction that ends the registration.
        registered: the registration.
        scene_key: identifies the image; see `history.record_measures`.
        job_id, scene_id: of the job that did it; None for a command.
        keys: storage keys of the outputs, by name.
    """
    document = report_document(registered.report)
    registration_id = registrations.insert_registration(
        connection,
        job_id=job_id,
        scene_id=scene_id,
        block_versions=[
            {"id": one["id"], "version": one["version"]} for one in document["run"]["blocks"]
        ],
        options=document["run"]["options"],
        report=document,
        verdict=registered.registration.qualification.verdict,
        files=keys or {},
    )
    registration, reference = registered.registration, registered.reference
    if reference is None:
        history.record_measures(connection, registration_id, registration, scene_key)
    else:
        record_places(connection, reference, registration, registered.footprint)
    return registration_id


def image_key(image: Path) -> str:
    """A key that identifies an image file by its path, size and time, without reading the file."""
    status = image.stat()
    identity = f"{image.resolve()} {status.st_size} {status.st_mtime_ns}"
    return sha256(identity.encode()).hexdigest()


def _register(
    scene: Scene,
    sources: ControlSources,
    marks: SceneMarks | None,
    attempt: Attempt,
    progress: Progress,
) -> tuple[Registration, CoveringReference | None]:
    """The registration of a scene on control points, or else on a reference image, which is returned.

    Marks are observations of the same adjustment; without control points and a reference that show the
    scene, it is registered on them alone.
    """
    outline = grown(scene_footprint(scene), MAX_ERROR_SIGMAS * scene.sigma_m)
    no_control = CoverageError("no reference image shows the ground of the scene")
    attempt.marks = "" if sources.marks is None else sources.marks.name
    if sources.find_points is not None:
        progress(0.0, "looking for points")
        control = attempt.control = sources.find_points(outline)
        try:
            registration = register_scene(
                scene,
                control.points,
                control.chips,
                attempt.options,
                marks=marks,
                progress=progress,
                stages=attempt.stages,
            )
            if marks is not None:
                attempt.control = replace(control, points=with_marks(control.points, marks))
            return registration, None
        except CoverageError as error:
            no_control = error
    reference = None if sources.find_reference is None else sources.find_reference(outline)
    if reference is None:
        if marks is None:
            raise no_control
        attempt.control = ControlSet(marks.points, NoChips(), ())
        return register_on_marks(scene, marks, attempt.options), None
    attempt.reference = reference.name
    opened = read_reference(reference.files, outline)
    attempt.statements.extend(opened.statements)
    registration, attempt.control = register_on(
        reference,
        opened,
        scene,
        attempt.options,
        marks=marks,
        progress=progress,
        stages=attempt.stages,
    )
    return registration, reference


def checked(
    registration: Registration,
    points: CheckPoints,
    options: RegistrationOptions,
    name: str,
) -> tuple[Registration, Check]:
    """The registration, qualified with check points too, and its accuracy at these points.

    Args:
        registration: of the scene.
        points: that had no part in it.
        options: of the registration.
        name: of the file of the points.
    """
    at_points = check_model(registration.model, registration.adjustment, points, registration.frame)
    limit = options.qualification.good_unit_weight
    qualification = with_check_points(registration.qualification, at_points, limit)
    check = Check(
        f"independent check points of {name}",
        at_points.accuracy,
        at_points.residual_px,
        at_points.normalised,
    )
    return replace(registration, qualification=qualification), check


def grown(outline: Array, metres: float) -> Array:
    """An outline (n, 2) of lon, lat, grown by a distance on every side."""
    centre = outline.mean(axis=0)
    east_m, north_m = metres_per_degree(float(centre[1]), 0.0)
    scale = np.array([max(east_m, 0.01 * north_m), north_m])
    grown = shapely.buffer(shapely.Polygon((outline - centre) * scale), metres, quad_segs=2)
    return np.asarray(centre + np.array(grown.exterior.coords)[:-1] / scale)
