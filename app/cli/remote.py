"""Registration of a scene by a service: upload it, execute the process, download the results."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from amers.app.client import Client, Job, JobFailed, ServiceFailure
from amers.app.errors import AmersError, ComputationError, InputError
from amers.app.usecases.marked_files import PointStatements
from amers.app.usecases.registration.control_marks import MarkFiles, marks_as_opf
from amers.app.usecases.registration.register import SceneFiles
from amers.services import errors
from amers.services.formats.images.scenes import model_files
from amers.services.formats.sensor_models.product_image import files_to_send
from amers.services.types import Progress, part_of

UPLOAD_SHARE = 0.2
"""Share of the upload in the progress."""


def register(
    client: Client,
    files: SceneFiles,
    folder: Path,
    progress: Progress,
    *,
    marks: MarkFiles | None = None,
    copy_image: bool = False,
    max_ce90_on_earth_m: float | None = None,
) -> dict[str, Any]:
    """Register a scene on a service and download the outputs.

    Args:
        client: of the service.
        files: of the scene.
        folder: for the outputs.
        progress: receives the fraction done and a message.
        marks: of a person in the scene.
        copy_image: also copy a GeoTIFF, with the refined model in its tags.
        max_ce90_on_earth_m: see `QualificationOptions`.

    Returns:
        The report as a document.

    Raises:
        InputError: the scene cannot be used.
        RequestRefused: the service refuses a request.
        ComputationError: the scene could not be registered.
        ServiceFailure: the service does not answer, or not as expected.
    """
    # The model is read to check it before anything is sent.
    models = model_files(files.image, files.model)
    image = files_to_send(files.image)[0]
    with TemporaryDirectory(prefix="amers-") as scratch:
        sent = None if marks is None else _to_send(marks, files, Path(scratch))
        control = None if sent is None else sent.paths[0]
        optional_files = [path for path in (files.mask, files.check_points, control) if path is not None]
        upload_progress = part_of(progress, 0.0, UPLOAD_SHARE)
        scene = client.upload_scene(image, sigma_m=files.sigma_m, progress=upload_progress)
        names = {path: client.upload_file(scene, path) for path in [*models, *optional_files]}
    of_marks = {} if sent is None else _inputs_of_marks(sent)
    paths = {
        "model": files.model,
        "mask": files.mask,
        "check_points": files.check_points,
        "control": control,
    }
    values = {"bands": files.bands, "check_heights": files.check_heights}
    if files.crop_origin is not None:
        values["crop_origin"] = "{},{}".format(*files.crop_origin)
    inputs = {
        "scene": scene,
        "copy_image": copy_image,
        **{name: names[path] for name, path in paths.items() if path is not None},
        **{name: value for name, value in values.items() if value is not None},
        **of_marks,
    }
    if max_ce90_on_earth_m is not None:
        inputs["options"] = {"qualification": {"max_ce90_on_earth_m": max_ce90_on_earth_m}}
    job = client.execute("register-scene", inputs)
    try:
        job = client.wait(job, part_of(progress, UPLOAD_SHARE, 1.0 - UPLOAD_SHARE))
    except JobFailed as failure:
        client.download(failure.job, folder)
        raise _failure(failure.job) from failure
    client.download(job, folder)
    report: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    return report


def _to_send(marks: MarkFiles, files: SceneFiles, folder: Path) -> MarkFiles:
    """The file of marks that a service can read: as given, or converted here by what was stated of it.

    Raises:
        InputError: the marks cannot be read, or a sigma of marks to convert is not stated.
    """
    stated = marks.points.stated
    needs_us = isinstance(stated.heights, Path) or stated.csv.crs or stated.csv.columns
    if not (needs_us or stated.sigma_axes or marks.terrain or len(marks.paths) > 1):
        return marks
    scene = files.read()
    try:
        text = marks_as_opf(marks, files.image, scene)
    finally:
        scene.image.close()  # type: ignore[attr-defined]
    path = folder / f"{marks.paths[0].stem}.opf.json"
    path.write_text(text, encoding="utf-8")
    return MarkFiles((path,), PointStatements(frame_sigma_m=marks.points.frame_sigma_m))


def _inputs_of_marks(marks: MarkFiles) -> dict[str, Any]:
    """The inputs of the process that state what a file of marks does not."""
    points = marks.points
    inputs = {
        "control_heights": points.stated.heights,
        "control_sigma_m": points.sigma_m,
        "control_frame_sigma_m": points.frame_sigma_m,
        "control_mark_sigma_px": points.mark_sigma_px,
    }
    return {name: value for name, value in inputs.items() if value is not None}


def _failure(job: Job) -> AmersError | ServiceFailure:
    """The error that ended a job, of the same kind as on the service."""
    kind = getattr(errors, job.error, None)
    if isinstance(kind, type) and issubclass(kind, ComputationError):
        return ComputationError(job.message)
    if isinstance(kind, type) and issubclass(kind, InputError):
        return InputError(job.message)
    return ServiceFailure(f"job {job.id}: {job.status}: {job.message}")
