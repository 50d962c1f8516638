"""The process `register-scenes`: register uploaded scenes together on the points of the store."""

from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import UUID

from amers.app.auth import Scope
from amers.app.db.engine import Connection
from amers.app.db.scenes import SceneRow
from amers.app.db.tokens import Token
from amers.app.errors import ComputationError, InputError, is_no_memory
from amers.app.usecases.control_files import IMAGES_NPZ
from amers.app.usecases.damage import suspecting_damage
from amers.app.usecases.processes import Commit, Process, Work
from amers.app.usecases.registration.control_sources import points_of_store
from amers.app.usecases.registration.job import commit_scene, with_reports
from amers.app.usecases.registration.joined_job import fetch_joined, joinable_scenes
from amers.app.usecases.registration.joined_scenes import SCENES_JSON
from amers.app.usecases.registration.register import SceneFiles
from amers.app.usecases.registration.together import (
    JointOutcome,
    JointPlace,
    run_joint_registration,
)
from amers.app.usecases.results import store_results
from amers.app.usecases.scene_inputs import check_scene, present_scene
from amers.app.usecases.scenes import local_image, stored_keys
from amers.services.formats.images.bands import parse_bands
from amers.services.quality.accuracy_statement import accuracy_document
from amers.services.registration.options import RegistrationOptions
from amers.services.reports.failure import NO_ACCURACY, NOT_REGISTERED
from amers.services.sensors.parameter_sets import ParameterSetName

MOST_SCENES = 100


@dataclass(frozen=True)
class RegisterScenes:
    """The inputs of a registration of scenes together.

    Attributes:
        scenes: ids of uploaded scenes, 2 to 100; with those that they join.
        join: id of a job of this process whose scenes these join; the earlier ones stay as they are.
        bands: bands to use of each, such as "2" or "1,2,3" or "3:0.3,2:0.7"; by default the
            panchromatic band or the mean of the visible ones.
        rigorous: adjust orbit, attitude and camera of the scenes whose metadata have a rigorous model,
            with the free parameters of this set: "srp", "toutin" or "spot-hrv"; by default RPCs.
        copy_image: whether GeoTIFFs are copied to the outputs with the refined model in their tags.
        options: of the registration.
    """

    scenes: tuple[UUID, ...]
    join: UUID | None = None
    bands: str | None = None
    rigorous: ParameterSetName | None = None
    copy_image: bool = False
    options: RegistrationOptions = field(default_factory=RegistrationOptions)


def _check(connection: Connection, caller: Token, inputs: RegisterScenes) -> None:
    if len(set(inputs.scenes)) < len(inputs.scenes):
        raise InputError("scenes: the same id is given twice; give each scene once")
    before = [] if inputs.join is None else joinable_scenes(connection, caller, inputs.join)
    if set(before) & set(inputs.scenes):
        raise InputError(
            f"scenes: job {inputs.join} has registered one of these scenes already; leave that scene out"
        )
    count = len(inputs.scenes) + len(before)
    if not inputs.scenes or not 2 <= count <= MOST_SCENES:
        raise InputError(
            f"scenes: {len(inputs.scenes)} given, with {len(before)} that they join; at least one and "
            f"2 to {MOST_SCENES} with these are expected"
        )
    for scene in (*inputs.scenes, *before):
        check_scene(connection, caller, scene)
    if inputs.bands is not None:
        parse_bands(inputs.bands)


def _run(work: Work) -> Commit:
    """Register uploaded scenes and put the outputs into the storage before rows refer to them."""
    inputs: RegisterScenes = work.inputs
    with work.database.reading() as connection:
        rows = {str(scene): present_scene(connection, scene) for scene in inputs.scenes}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="amers-")))
        joined = None if inputs.join is None else fetch_joined(work, inputs.join, stack)
        files = {name: _local_files(work, row, stack) for name, row in rows.items()}
        try:
            with suspecting_damage(
                work.database, work.storage, [key for row in rows.values() for key in stored_keys(row)]
            ):
                outcome = run_joint_registration(
                    files,
                    points_of_store(work.database, work.storage),
                    JointPlace(
                        lambda name: folder / name,
                        f"job {work.job.id}",
                        joined=joined,
                        address_of=lambda name, image: name,
                    ),
                    options=inputs.options,
                    copy_image=inputs.copy_image,
                    progress=work.progress,
                )
        except (InputError, ComputationError) as error:
            if is_no_memory(error):
                raise
            paths = _of_scenes(folder, rows)
            raise with_reports(work, paths, error, {}) from error
        keys = store_results(work, {**outcome.files, **_of_scenes(folder, rows)})

    def commit(connection: Connection) -> dict[str, Any]:
        for name, registered in outcome.registered.items():
            of_scene = {output: keys[f"{name}/{output}"] for output in registered.files}
            commit_scene(connection, work, rows[name], registered, of_scene)
        return {
            "verdict": NOT_REGISTERED if outcome.failed else outcome.report.verdict,
            "verdict_words": outcome.report.verdict_words,
            "scenes": [_scene_values(name, outcome) for name in rows],
            "joined": [one.address for one in joined.members] if joined else [],
            "files": keys,
        }

    return commit


def _local_files(work: Work, row: SceneRow, stack: ExitStack) -> SceneFiles:
    """The files of a scene on this machine, until the stack closes."""
    scratch = stack.enter_context(TemporaryDirectory(prefix="amers-"))
    image = local_image(work.storage, work.settings, row, Path(scratch))
    inputs: RegisterScenes = work.inputs
    return SceneFiles(image, sigma_m=row.sigma_m, bands=inputs.bands, rigorous=inputs.rigorous)


def _of_scenes(folder: Path, names: Iterable[str]) -> dict[str, Path]:
    """The outputs of every scene, by the name of the scene and their own."""
    return {f"{name}/{path.name}": path for name in names for path in sorted((folder / name).glob("*"))}


def _scene_values(name: str, outcome: JointOutcome) -> dict[str, Any]:
    """What the results state of one scene."""
    one = outcome.registered.get(name)
    if one is None:
        stated = {"verdict": NOT_REGISTERED, **accuracy_document(NO_ACCURACY)}
        return {"scene": name, **stated, "reason": str(outcome.failed[name])}
    quality = one.registration.qualification
    stated = {"verdict": quality.verdict, **accuracy_document(quality.accuracy)}
    return {"scene": name, **stated, "reason": one.report.verdict_explanation}


REGISTER_SCENES = Process(
    id="register-scenes",
    title="Register scenes together",
    description="Refine the sensor models of uploaded scenes in one adjustment, on control points and "
    "on tie points between the scenes. Each scene has the outputs of register-scene, as SCENE/NAME.",
    scope=Scope.REGISTER,
    inputs=RegisterScenes,
    outputs={
        "report.json": "The report on all scenes as a document.",
        "report.html": "The report on all scenes as a page.",
        "report.txt": "The tables of the report as plain text.",
        SCENES_JSON: "The scenes, for those that join them later.",
        IMAGES_NPZ: "Their adjusted models with the joint covariance, for the same.",
    },
    check=_check,
    run=_run,
    values={
        "verdict": {
            "enum": ["good", "usable", "failed", "not registered"],
            "title": "Worst verdict on a scene",
        },
        "verdict_words": {"type": "string", "title": "How many scenes have which verdict"},
        "scenes": {"type": "array", "title": "Verdict, accuracy and reason of every scene"},
        "joined": {
            "type": "array",
            "items": {"type": "string", "format": "uuid"},
            "title": "Scenes that these joined",
        },
    },
)
