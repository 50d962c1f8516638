"""Register scenes together: read their files, find control, adjust all at once, write each outcome."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np
import shapely

from amers.app.usecases.control_files import IMAGES_NPZ
from amers.app.usecases.executors import ComputeOptions, open_executor
from amers.app.usecases.registration.control_sources import ControlSet, FindPoints
from amers.app.usecases.registration.deliverables import write_outputs
from amers.app.usecases.registration.failure import Attempt, write_failure
from amers.app.usecases.registration.joined_scenes import (
    SCENES_JSON,
    JoinedScenes,
    Member,
    format_scenes,
)
from amers.app.usecases.registration.register import RegisteredScene, SceneFiles, grown
from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.errors import AmersError, InputError
from amers.services.formats.adjusted_images import write_adjusted_images
from amers.services.formats.images.bands import parse_bands
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.refined_model import AdjustedRigorous, write_refined
from amers.services.imagery.scene import Scene, scene_footprint
from amers.services.joint.registration import AdjustedScenes, JointRegistration, register_together
from amers.services.joint.results import RigorousScene
from amers.services.registration.on_points import Registration
from amers.services.registration.options import RegistrationOptions
from amers.services.reports.build import build_report, scene_record
from amers.services.reports.document import format_report
from amers.services.reports.figure_data import figure_data
from amers.services.reports.joint import JointReport, joint_report
from amers.services.reports.joint_pages import format_joint_html, format_joint_tables
from amers.services.reports.report import RefinedModelRecord, RunRecord
from amers.services.sensors.base import SensorModel
from amers.services.sensors.parameter_sets import parameter_set_named
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.tasks import Work
from amers.services.types import Array, Progress, no_progress, part_of

BLOCK_FOLDER = "block"
"""Folder of the report on all scenes, beside those of the scenes."""


@dataclass(frozen=True)
class JointPlace:
    """Where scenes are registered together, and where their results go.

    Attributes:
        folder_of: the folder of the results of a scene, by its name, or of the block.
        name: of the results.
        compute: processes or a cluster.
        joined: scenes that were registered together before.
        address_of: what names an image to scenes that join later, by name of the folder and path.
    """

    folder_of: Callable[[str], Path]
    name: str
    compute: ComputeOptions = field(default_factory=ComputeOptions)
    joined: JoinedScenes | None = None
    address_of: Callable[[str, Path], str] = lambda name, image: str(image.resolve())


@dataclass(frozen=True)
class JointOutcome:
    """Scenes registered together, with their outputs.

    Attributes:
        report: on all of them.
        registered: scenes that fit, by the name of their folder.
        failed: why others were not registered, by the name of their folder.
        files: outputs on all of them, by name.
    """

    report: JointReport
    registered: dict[str, RegisteredScene]
    failed: dict[str, AmersError]
    files: dict[str, Path]


@dataclass(frozen=True)
class _Read:
    """A scene with its files, the name of the folder of its results, and the address of its image."""

    folder: str
    address: str
    files: SceneFiles
    scene: Scene

    @property
    def name(self) -> str:
        return self.scene.acquisition.image_id


def run_joint_registration(
    files: Mapping[str, SceneFiles],
    find_points: FindPoints,
    place: JointPlace,
    *,
    options: RegistrationOptions = RegistrationOptions(),
    copy_image: bool = False,
    progress: Progress = no_progress,
    command: str = "",
) -> JointOutcome:
    """Register scenes together and write the outputs of each, and of all, into their folders.

    A scene that cannot be read or does not fit gets the report of a failure, and does not stop others.

    Args:
        files: of the scenes, by the names of their folders.
        find_points: finds control points.
        place: of the work and of the results.
        options: of the registration.
        copy_image: also copy GeoTIFFs, with the refined models in their tags.
        progress: receives the fraction done and a message.
        command: that repeats the registration, for the reports of failures.

    Raises:
        InputError: no scene can be used, or what they join cannot be.
        ComputationError: no scene can be registered.
    """
    attempts = {
        name: Attempt(one.image, command or f"amers scene register-many {one.image.name}", options)
        for name, one in files.items()
    }
    failed: dict[str, AmersError] = {}
    with ExitStack() as stack:
        before = [] if place.joined is None else _joined(place.joined, stack)
        read = _read_all(files, place, attempts, failed, stack)
        try:
            if not read:
                raise InputError(
                    f"none of {len(files)} scenes can be used: {next(iter(failed.values()))}"
                )
            _check_rigorous(read)
            progress(0.0, "looking for points")
            control = find_points(_outline([one.scene for one in read]))
            for one in read:
                attempts[one.folder].control = control
            executor, ahead = stack.enter_context(open_executor(place.compute))
            result = register_together(
                [one.scene for one in read],
                control.points,
                control.chips,
                options,
                joined=_adjusted(before, place.joined),
                work=Work(executor, ahead=ahead),
                progress=part_of(progress, 0.0, 0.85),
            )
        except AmersError as error:
            for name, attempt in attempts.items():
                write_failure(place.folder_of(name), attempt, failed.get(name, error))
            raise
        by_name = {one.name: one for one in read}
        left = [by_name[one.measured.name].folder for one in result.left]
        for name, gone in zip(left, result.left, strict=True):
            failed[name] = gone.error
            attempts[name].stages.extend(gone.measured.stages)
        for name, why in failed.items():
            write_failure(place.folder_of(name), attempts[name], why)
        registered = {}
        for count, registration in enumerate(result.registrations):
            progress(0.85 + 0.15 * count / len(result.registrations), "writing the reports")
            one = by_name[result.block.scenes[result.numbers[count]].name]
            name = one.folder
            registered[name] = _written(
                one,
                (registration, result.rigorous[count]),
                control,
                attempts[name],
                place.folder_of(name),
                copy_image=copy_image,
            )
        report = joint_report(
            result,
            [one.report for one in registered.values()],
            left,
            name=place.name,
            finished_at=datetime.now(UTC),
        )
        written = _write_block(place.folder_of(BLOCK_FOLDER), report, result, [*before, *read])
    return JointOutcome(report, registered, failed, written)


def _read_all(
    files: Mapping[str, SceneFiles],
    place: JointPlace,
    attempts: dict[str, Attempt],
    failed: dict[str, AmersError],
    stack: ExitStack,
) -> list[_Read]:
    """The scenes that can be read, open until the stack closes; the others are noted.

    A scene whose metadata name it like another one gets the name of its folder.
    """
    read: list[_Read] = []
    taken = {one.name for one in place.joined.members} if place.joined else set()
    for name, one in files.items():
        try:
            scene = _read(one, stack)
        except InputError as error:
            failed[name] = error
            continue
        if scene.acquisition.image_id in taken:
            scene = _named(scene, name)
        if scene.acquisition.image_id in taken:
            failed[name] = InputError(
                f"{name}: the scenes that it joins have one of this name already; leave it out, or "
                "rename the image if it is another one"
            )
            continue
        attempts[name].scene = scene
        taken.add(scene.acquisition.image_id)
        read.append(_Read(name, place.address_of(name, one.image), one, scene))
    return read


def _check_rigorous(read: Sequence[_Read]) -> None:
    """Refuse a set of parameters of rigorous models where no scene has such a model."""
    asked = [one for one in read if one.files.rigorous is not None]
    if asked and all(one.scene.parameter_set is None for one in asked):
        raise InputError(
            f"rigorous: {asked[0].files.rigorous} given, and none of {len(asked)} scenes has metadata "
            "with a rigorous model beside it (DIMAP with orbit and attitude, PHRDIMAP, WorldView XML): "
            "leave the option out, or add the metadata of the products"
        )


def _read(files: SceneFiles, stack: ExitStack) -> Scene:
    bands = None if files.bands is None else parse_bands(files.bands)
    scene = read_scene(
        files.image,
        files.model,
        sigma_m=files.sigma_m,
        bands=bands,
        mask=files.mask,
        parameter_set=None if files.rigorous is None else parameter_set_named(files.rigorous),
    )
    stack.callback(scene.image.close)  # type: ignore[attr-defined]
    return scene


def _named(scene: Scene, name: str) -> Scene:
    """The scene under the name that it has among others."""
    return replace(scene, acquisition=replace(scene.acquisition, image_id=name))


def _for_heights(scene: Scene, heights_m: tuple[float, float]) -> Scene:
    """The scene with the heights that its rigorous model was adjusted for."""
    if not isinstance(scene.model, PushbroomModel):
        return scene
    return replace(scene, model=replace(scene.model, height_range_m=heights_m))


def _outline(scenes: Sequence[Scene]) -> Array:
    """The outline (n, 2) of the ground of all scenes, lon and lat, as far as their models may be off."""
    outlines = [grown(scene_footprint(one), MAX_ERROR_SIGMAS * one.sigma_m) for one in scenes]
    for outline in outlines[1:]:
        outline[:, 0] -= 360.0 * np.round((outline[:, 0].mean() - outlines[0][:, 0].mean()) / 360.0)
    together = shapely.union_all([shapely.Polygon(outline) for outline in outlines])
    if not isinstance(together, shapely.Polygon):
        together = together.convex_hull
    return np.array(together.exterior.coords)[:-1]


def _written(
    one: _Read,
    result: tuple[Registration, RigorousScene | None],
    control: ControlSet,
    attempt: Attempt,
    folder: Path,
    *,
    copy_image: bool,
) -> RegisteredScene:
    """The outputs of one scene, written as those of a scene alone are."""
    files, scene = one.files, one.scene
    registration, found = result
    model: SensorModel | AdjustedRigorous = registration.model
    if found is not None:
        model = AdjustedRigorous(
            registration.model, found.heights_m, found.correction_error_px, found.attitude
        )
    folder.mkdir(parents=True, exist_ok=True)
    refined = write_refined(
        files.image,
        files.model,
        model,
        registration.adjustment,
        shape=scene.image.shape,
        folder=folder,
        copy_image=copy_image,
        frame=registration.frame,
    )
    report = build_report(
        registration,
        scene_record(scene, files.image.stem),
        RunRecord(
            software_version=version("amers"),
            started_at=attempt.started_at,
            finished_at=datetime.now(UTC),
            method="control points",
            blocks=control.blocks,
            options=attempt.options,
        ),
        RefinedModelRecord(refined.max_error_px, refined.note),
        figure_data(scene, control.points, control.chips, registration),
        nearest_px=None if found is None else found.correction_error_px,
    )
    paths = write_outputs(folder, report, files.image.name, control.points)
    outputs = {path.name: path for path in (*paths, *refined.files)}
    return RegisteredScene(scene, registration, None, report, scene_footprint(scene), outputs)


def _write_block(
    folder: Path, report: JointReport, result: JointRegistration, read: Sequence[_Read]
) -> dict[str, Path]:
    """The report on all scenes, and what later scenes need to join them."""
    folder.mkdir(parents=True, exist_ok=True)
    adjusted = {one.name: one.scene.model.height_range_m for one in result.block.scenes}
    members = [
        Member(one.name, one.address, one.files, adjusted[one.name])
        for one in read
        if one.name in adjusted
    ]
    texts = {
        "report.json": format_report(report),
        "report.html": format_joint_html(report),
        "report.txt": format_joint_tables(report),
        SCENES_JSON: format_scenes(members),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    written = {name: folder / name for name in texts}
    if result.block.adjustment.known is not None:
        write_adjusted_images(folder / IMAGES_NPZ, report.block.id, result.block.adjustment.known)
        written[IMAGES_NPZ] = folder / IMAGES_NPZ
    return written


def _joined(joined: JoinedScenes, stack: ExitStack) -> list[_Read]:
    """Scenes that were registered together before, open until the stack closes.

    Raises:
        InputError: an image has moved.
    """
    return [
        _Read(
            one.address,
            one.address,
            one.files,
            _for_heights(_named(_read(one.files, stack), one.name), one.heights_m),
        )
        for one in joined.members
    ]


def _adjusted(before: Sequence[_Read], joined: JoinedScenes | None) -> AdjustedScenes | None:
    """What the adjustment of scenes that were registered before has told of them."""
    if joined is None:
        return None
    return AdjustedScenes(tuple(one.scene for one in before), joined.known)
