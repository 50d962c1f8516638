"""The process that reads the delivered model of an uploaded scene, for marks in it."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

from amers.app.auth import Scope
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.errors import InputError
from amers.app.usecases.damage import suspecting_damage
from amers.app.usecases.model_choice import parse_crop_origin
from amers.app.usecases.processes import STATEMENTS_VALUE, Commit, Process, Work, stated_document
from amers.app.usecases.registration.register import SceneFiles
from amers.app.usecases.results import store_results
from amers.app.usecases.scene_inputs import check_file_names, check_scene, present_scene
from amers.app.usecases.scenes import local_image, stored_keys
from amers.services.formats.sensor_models.scene_model import format_scene_model
from amers.services.imagery.scene import Scene

MODEL_NAME = "scene_model.json"


@dataclass(frozen=True)
class ReadModel:
    """The inputs of the reading of a model; files are named as they were uploaded beside the image.

    Attributes:
        scene: id of an uploaded scene.
        sigma_m: accuracy of the delivered sensor model, metres (1 sigma); by default the value stated at
            the upload.
        model: name of the file with the sensor model of the scene; by default it is found by its name.
        crop_origin: position LINE,SAMPLE of the first pixel of the image in the full image of the sensor
            model; by default the position that the files state.
    """

    scene: UUID
    sigma_m: float | None = None
    model: str | None = None
    crop_origin: str | None = None


def _check(connection: Connection, caller: Token, inputs: ReadModel) -> None:
    check_scene(connection, caller, inputs.scene)
    check_file_names(inputs, "model")
    if inputs.sigma_m is not None and not 0.0 < inputs.sigma_m < float("inf"):
        raise InputError(f"sigma_m: {inputs.sigma_m} found, metres above 0 expected")
    if inputs.crop_origin is not None:
        parse_crop_origin(inputs.crop_origin, "crop_origin")


def _run(work: Work) -> Commit:
    """Read the model of an uploaded scene and put it into the storage."""
    inputs: ReadModel = work.inputs
    with work.database.snapshot() as connection:
        row = present_scene(connection, inputs.scene)
    with TemporaryDirectory(prefix="amers-") as scratch, TemporaryDirectory(prefix="amers-") as folder:
        image = local_image(work.storage, work.settings, row, Path(scratch))
        with suspecting_damage(work.database, work.storage, stored_keys(row)):
            scene = _read(inputs, image, row.sigma_m)
        path = Path(folder) / MODEL_NAME
        path.write_text(format_scene_model(scene), encoding="utf-8")
        stored = store_results(work, {MODEL_NAME: path})
    lines, samples = scene.image.shape

    def commit(connection: Connection) -> dict[str, Any]:
        return {
            "lines": lines,
            "samples": samples,
            "sigma_m": scene.sigma_m,
            "statements": stated_document(scene.statements),
            "files": stored,
        }

    return commit


def _read(inputs: ReadModel, image: Path, sigma_m: float | None) -> Scene:
    files = SceneFiles(
        image=image,
        model=None if inputs.model is None else image.with_name(inputs.model),
        sigma_m=sigma_m if inputs.sigma_m is None else inputs.sigma_m,
        crop_origin=None if inputs.crop_origin is None else parse_crop_origin(inputs.crop_origin),
    )
    scene = files.read()
    scene.image.close()  # type: ignore[attr-defined]
    return scene


READ_MODEL = Process(
    id="read-model",
    title="Read the model of a scene",
    description="Read the delivered sensor model or map grid of an uploaded scene, so that marks in the "
    "scene can be adjusted at once by `POST /jobs/{id}/marks`.",
    scope=Scope.REGISTER,
    inputs=ReadModel,
    outputs={MODEL_NAME: "The model, the size of the image, and the accuracy of the model."},
    check=_check,
    run=_run,
    values={
        "lines": {"type": "integer", "title": "Lines of the image"},
        "samples": {"type": "integer", "title": "Samples of the image"},
        "sigma_m": {"type": "number", "title": "Accuracy of the model, metres (1 sigma)"},
        "statements": STATEMENTS_VALUE,
    },
)
