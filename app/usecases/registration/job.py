"""The process `register-scene`: register an uploaded scene on points and references of the store."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args
from uuid import UUID

from amers.app.auth import Scope
from amers.app.db import scenes
from amers.app.db.engine import Connection
from amers.app.db.scenes import SceneRow
from amers.app.db.tokens import Token
from amers.app.errors import AmersError, ComputationError, InputError, TooLarge, is_no_memory
from amers.app.usecases.damage import suspecting_damage
from amers.app.usecases.marked_files import PointStatements
from amers.app.usecases.model_choice import parse_crop_origin
from amers.app.usecases.processes import Commit, Process, Work, WorkFailed
from amers.app.usecases.references import references_of_store
from amers.app.usecases.registration.control_marks import MarkFiles
from amers.app.usecases.registration.control_sources import points_of_store
from amers.app.usecases.registration.deliverables import OUTPUTS
from amers.app.usecases.registration.register import (
    ControlSources,
    RegisteredScene,
    SceneFiles,
    record_registration,
    run_registration,
)
from amers.app.usecases.report_files import REPORT_FILES
from amers.app.usecases.results import store_results
from amers.app.usecases.scene_inputs import check_file_names, check_scene, naming, present_scene
from amers.app.usecases.scenes import local_image, stored_keys
from amers.services.formats.gcp.marked_points import check_heights
from amers.services.formats.gcp.reader import StatedByCaller
from amers.services.formats.images.bands import parse_bands
from amers.services.quality.accuracy_statement import accuracy_document
from amers.services.registration.options import RegistrationOptions
from amers.services.reports.failure import NO_ACCURACY, NOT_REGISTERED
from amers.services.reports.report import Method as ReportedMethod

Method = Literal["auto", "points", "reference", "marks"]
"""What a scene is registered on: control points, a reference image, or the first of both that exists;
or marks of a person alone."""


@dataclass(frozen=True)
class RegisterScene:
    """The inputs of a registration; files are named as they were uploaded beside the image.

    Attributes:
        scene: id of an uploaded scene.
        sigma_m: accuracy of the delivered sensor model, metres (1 sigma); by default the value stated at
            the upload.
        model: name of the file with the sensor model of the scene; by default it is found by its name.
        method: "points", "reference", or "auto": on points, and where there are none on a reference; or
            "marks": on the marks of `control` alone.
        bands: bands to use, such as "2" or "1,2,3" or "3:0.3,2:0.7"; by default the panchromatic band or
            the mean of the visible ones.
        mask: name of an image of the same ground that is used as a mask; pixels of the scene are ignored
            where it is not 0.
        check_points: name of a file with check points, which take no part in the registration.
        check_heights: vertical datum of the heights of the check points, if their format cannot state
            it.
        control: name of a file with ground points that a person marked in the scene. They take part in
            the adjustment; without other points, the scene is registered on them alone.
        control_heights: vertical datum of these heights, if the file does not state it.
        control_sigma_m: accuracy of the ground points of `control` if the file states none: horizontal
            and up, metres (1 sigma); by default one pixel.
        control_frame_sigma_m: common error of all ground points of `control` on the Earth: horizontal
            and up, metres (1 sigma); by default unknown.
        control_mark_sigma_px: sigma of marks if their file states none, pixels; by default 0.5.
        crop_origin: position LINE,SAMPLE of the first pixel of the image in the full image of the sensor
            model; by default the position that the files state.
        copy_image: whether the outputs include a copy of a GeoTIFF with the refined model in its tags.
        options: of the registration.
    """

    scene: UUID
    sigma_m: float | None = None
    model: str | None = None
    method: Method = "auto"
    bands: str | None = None
    mask: str | None = None
    check_points: str | None = None
    check_heights: str | None = None
    control: str | None = None
    control_heights: str | None = None
    control_sigma_m: tuple[float, float] | None = None
    control_frame_sigma_m: tuple[float, float] | None = None
    control_mark_sigma_px: float | None = None
    crop_origin: str | None = None
    copy_image: bool = False
    options: RegistrationOptions = field(default_factory=RegistrationOptions)


def _check(connection: Connection, caller: Token, inputs: RegisterScene) -> None:
    check_scene(connection, caller, inputs.scene)
    check_file_names(inputs, "model", "mask", "check_points", "control")
    if inputs.sigma_m is not None and not 0.0 < inputs.sigma_m < inf:
        raise InputError(f"sigma_m: {inputs.sigma_m} found, metres above 0 expected")
    if inputs.bands is not None:
        parse_bands(inputs.bands)
    if inputs.crop_origin is not None:
        parse_crop_origin(inputs.crop_origin, "crop_origin")
    if inputs.check_heights is not None:
        with naming("check_heights"):
            check_heights(inputs.check_heights)
    _check_marks(inputs)


def _check_marks(inputs: RegisterScene) -> None:
    """Refuse what is stated of marks that are not given, or is no accuracy."""
    if inputs.control_heights is not None:
        with naming("control_heights"):
            check_heights(inputs.control_heights)
    sigmas = {
        "control_sigma_m": inputs.control_sigma_m,
        "control_frame_sigma_m": inputs.control_frame_sigma_m,
        "control_mark_sigma_px": inputs.control_mark_sigma_px,
    }
    stated = {name: value for name, value in sigmas.items() if value is not None}
    if inputs.control is None:
        alone = [*stated, *(["control_heights"] if inputs.control_heights is not None else [])]
        if alone or inputs.method == "marks":
            raise InputError(
                f"{', '.join(alone) or 'method'}: of marks, whose file is missing: upload it beside the "
                "image and name it with control"
            )
    for name, value in stated.items():
        if not all(0.0 < one < inf for one in (value if isinstance(value, tuple) else (value,))):
            raise InputError(f"{name}: {value} found, more than 0 expected")


def _run(work: Work) -> Commit:
    """Register an uploaded scene and put the outputs into the storage before rows refer to them."""
    inputs: RegisterScene = work.inputs
    with work.database.reading() as connection:
        scene = present_scene(connection, inputs.scene)
    with TemporaryDirectory(prefix="amers-") as scratch, TemporaryDirectory(prefix="amers-") as folder:
        image = local_image(work.storage, work.settings, scene, Path(scratch))
        try:
            with suspecting_damage(work.database, work.storage, stored_keys(scene)):
                registered = run_registration(
                    scene_files(inputs, image, scene.sigma_m),
                    _control_sources(work, inputs, image),
                    Path(folder),
                    options=inputs.options,
                    copy_image=inputs.copy_image,
                    progress=work.progress,
                )
        except (InputError, ComputationError) as error:
            if is_no_memory(error):
                raise
            paths = {name: Path(folder, name) for name in REPORT_FILES}
            raise with_reports(work, paths, error, accuracy_document(NO_ACCURACY)) from error
        keys = store_results(work, registered.files)

    def commit(connection: Connection) -> dict[str, Any]:
        commit_scene(connection, work, scene, registered, keys)
        return {
            "verdict": registered.report.verdict,
            "verdict_scope": registered.report.verdict_scope,
            **accuracy_document(registered.registration.qualification.accuracy),
            "method": registered.report.run.method,
            "files": keys,
        }

    return commit


def commit_scene(
    connection: Connection,
    work: Work,
    scene: SceneRow,
    registered: RegisteredScene,
    keys: dict[str, str],
) -> None:
    """Store the registration of an uploaded scene, and what its files contain about it.

    Args:
        connection: with the transaction that ends the job.
        work: the job.
        scene: that was registered.
        registered: its registration.
        keys: storage keys of its outputs, by name.
    """
    scene_key, record = scene.sha256 or f"scene {scene.id}", registered.report.scene
    record_registration(
        connection, registered, scene_key, job_id=work.job.id, scene_id=scene.id, keys=keys
    )
    scenes.set_footprint(connection, scene.id, registered.footprint)
    scenes.describe(connection, scene.id, record.acquisition, record.shape, record.gsd_m)


def with_reports(
    work: Work, files: Mapping[str, Path], error: AmersError, values: Mapping[str, Any]
) -> WorkFailed | AmersError:
    """The error of a job with the reports of the failure; without them where there are none or no room.

    Args:
        work: the job.
        files: reports, by name.
        error: that ended it.
        values: further results.
    """
    if not files:
        return error
    try:
        keys = store_results(work, files)
    except TooLarge:
        return error
    return WorkFailed(error, {"verdict": NOT_REGISTERED, **values, "files": keys})


def _control_sources(work: Work, inputs: RegisterScene, image: Path) -> ControlSources:
    """The sources of control in the store that the method allows, and the marks beside the image."""
    points = points_of_store(work.database, work.storage)
    references = references_of_store(work.database, work.settings)
    marks = None
    if inputs.control is not None:
        statements = PointStatements(
            StatedByCaller(inputs.control_heights, options="--control-"),
            inputs.control_sigma_m,
            inputs.control_frame_sigma_m,
            inputs.control_mark_sigma_px,
        )
        marks = MarkFiles((image.with_name(inputs.control),), statements)
    return ControlSources(
        find_points=points if inputs.method in ("auto", "points") else None,
        find_reference=references if inputs.method in ("auto", "reference") else None,
        marks=marks,
    )


def scene_files(inputs: RegisterScene, image: Path, sigma_m: float | None) -> SceneFiles:
    """The files of a scene, which lie beside its image under the names of the inputs.

    Args:
        sigma_m: as stated when the scene was uploaded.
    """

    def beside(name: str | None) -> Path | None:
        return None if name is None else image.with_name(name)

    return SceneFiles(
        image=image,
        model=beside(inputs.model),
        sigma_m=sigma_m if inputs.sigma_m is None else inputs.sigma_m,
        bands=inputs.bands,
        mask=beside(inputs.mask),
        check_points=beside(inputs.check_points),
        check_heights=inputs.check_heights,
        crop_origin=None if inputs.crop_origin is None else parse_crop_origin(inputs.crop_origin),
    )


REGISTER_SCENE = Process(
    id="register-scene",
    title="Register a scene",
    description="Refine the sensor model of an uploaded scene on the control points of its footprint.",
    scope=Scope.REGISTER,
    inputs=RegisterScene,
    outputs=OUTPUTS,
    check=_check,
    run=_run,
    values={
        "verdict": {"enum": ["good", "usable", "failed"], "title": "Verdict on the registration"},
        "verdict_scope": {"type": "string", "title": "Accuracy that the verdict speaks of"},
        "relative_to_control_points": {"type": "object", "title": "CE90 without the points' frame"},
        "on_the_earth": {"type": "object", "title": "CE90 and LE90 with it, null when unknown"},
        "method": {"enum": list(get_args(ReportedMethod)), "title": "Control that was used"},
    },
)
