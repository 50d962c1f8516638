"""Registering an uploaded scene as a job, on the points and reference images of the store."""

from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, get_args
from uuid import UUID

from app.auth import Scope
from app.db import scenes
from app.db.engine import Connection
from app.db.tokens import Token
from app.usecases.processes import Commit, Process, Work
from app.usecases.references import references_of_store
from app.usecases.registration.control_sources import points_of_store
from app.usecases.registration.deliverables import OUTPUTS
from app.usecases.registration.register import Method, SceneFiles, record, run_registration
from app.usecases.scene_inputs import check_file_names, check_scene, present_scene
from app.usecases.scenes import local_image
from services.formats.images.bands import parse_bands
from services.imagery.scene import scene_gsd_m
from services.registration.options import RegistrationOptions
from services.reports.report import Method as ReportedMethod


@dataclass(frozen=True)
class RegisterScene:
    """What a user says to have a scene registered.

    Files are named that were uploaded beside the image.

    Attributes:
        scene: id of an uploaded scene.
        model: name of the file that holds its model; by default it is found.
        method: "points", "reference", or "auto": on points, on a reference where there is none.
        bands: what is looked at, such as "2" or "1,2,3" or "3:0.3,2:0.7"; by default the panchromatic
            band or the mean of the visible ones.
        mask: name of an image of the same ground that is not zero where pixels shall not be used.
        check_points: name of a file with points that are held out of the registration.
        check_heights: what the heights in it are above, where its format cannot say.
        copy_image: whether a GeoTIFF is delivered again with the refined model in its tags.
        options: of the registration.
    """

    scene: UUID
    model: str | None = None
    method: Method = "auto"
    bands: str | None = None
    mask: str | None = None
    check_points: str | None = None
    check_heights: str | None = None
    copy_image: bool = False
    options: RegistrationOptions = field(default_factory=RegistrationOptions)


def _check(connection: Connection, caller: Token, inputs: RegisterScene) -> None:
    check_scene(connection, caller, inputs.scene)
    check_file_names(inputs, "model", "mask", "check_points")
    if inputs.bands is not None:
        parse_bands(inputs.bands)


def _run(work: Work) -> Commit:
    """Register an uploaded scene; the files are in the storage before the rows that name them."""
    inputs: RegisterScene = work.inputs
    with work.database.transaction() as connection:
        scene = present_scene(connection, inputs.scene)
    find_points = points_of_store(work.database, work.storage)
    with TemporaryDirectory(prefix="amers-") as scratch, TemporaryDirectory(prefix="amers-") as folder:
        image = local_image(work.storage, work.settings, scene, Path(scratch))
        made = run_registration(
            _files_of(inputs, image, scene.sigma_m),
            find_points,
            inputs.options,
            Path(folder),
            work.progress,
            references_of_store(work.database, work.settings),
            inputs.method,
            inputs.copy_image,
        )
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
        return {"verdict": made.report.verdict, "method": made.report.run.method, "files": keys}

    return commit


def _files_of(inputs: RegisterScene, image: Path, sigma_m: float | None) -> SceneFiles:
    """The files of a scene that lie beside its image, by the names they were uploaded under."""

    def beside(name: str | None) -> Path | None:
        return None if name is None else image.with_name(name)

    return SceneFiles(
        image,
        beside(inputs.model),
        sigma_m,
        inputs.bands,
        beside(inputs.mask),
        beside(inputs.check_points),
        inputs.check_heights,
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
        "verdict": {"enum": ["good", "usable", "failed"], "title": "How good it is"},
        "method": {"enum": list(get_args(ReportedMethod)), "title": "What it was registered on"},
    },
)
