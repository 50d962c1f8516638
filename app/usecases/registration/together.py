"""Register scenes together: read their files, find control, adjust all at once, write each outcome."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import shapely

from amers.app.usecases.control_files import IMAGES_NPZ
from amers.app.usecases.executors import ComputeOptions, open_executor
from amers.app.usecases.registration.control_marks import MarkFiles, read_marks_together
from amers.app.usecases.registration.control_sources import ControlSet, FindPoints
from amers.app.usecases.registration.failure import Attempt, write_failure
from amers.app.usecases.registration.joined_scenes import (
    SCENES_JSON,
    JoinedScenes,
    Member,
    format_scenes,
)
from amers.app.usecases.registration.register import (
    RegisteredScene,
    SceneFiles,
    checked,
    grown,
    write_registered,
)
from amers.app.usecases.report_files import write_report, write_texts
from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.errors import AmersError, InputError
from amers.services.formats.adjusted_images import write_adjusted_images
from amers.services.imagery.scene import Scene, scene_footprint
from amers.services.joint.registration import AdjustedScenes, JointRegistration, register_together
from amers.services.quality.check_points import CheckPoints
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.scene_marks import SceneMarks, with_marks
from amers.services.reports.joint import JointReport, joint_report
from amers.services.reports.joint_pages import JOINT_PAGE
from amers.services.reports.report import Check
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
    marks: MarkFiles | None = None,
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
        marks: files of ground points that a person marked in the images; None for none.
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
    with ExitStack() as stack:
        before = [] if place.joined is None else _joined(place.joined, stack)
        scenes = _Scenes(place, attempts, before)
        scenes.read(files, stack)
        try:
            result = _register(scenes, find_points, marks, options, progress)
        except AmersError as error:
            scenes.failed = {name: scenes.failed.get(name, error) for name in attempts}
            scenes.write_failures()
            raise
        return _write(result, scenes, copy_image, progress)


@dataclass
class _Scenes:
    """Scenes on their way to a registration together.

    Attributes:
        place: of the work and of the results.
        attempts: what was done with each, by the name of its folder.
        before: scenes that were registered before.
        opened: those that could be read.
        failed: why others were not registered, by the name of their folder.
        held_out: marks that their files hold out, by the name of the folder of their scene.
    """

    place: JointPlace
    attempts: Mapping[str, Attempt]
    before: Sequence[_Read]
    opened: list[_Read] = field(default_factory=list)
    failed: dict[str, AmersError] = field(default_factory=dict)
    held_out: dict[str, CheckPoints] = field(default_factory=dict)

    def read(self, files: Mapping[str, SceneFiles], stack: ExitStack) -> None:
        """Read the scenes, which stay open until the stack closes; note those that cannot be read.

        A scene whose metadata name it like another one gets the name of its folder.
        """
        taken = {one.name for one in self.before}
        for name, one in files.items():
            try:
                scene = _read(one, stack)
            except InputError as error:
                self.failed[name] = error
                continue
            if scene.acquisition.image_id in taken:
                scene = _named(scene, name)
            if scene.acquisition.image_id in taken:
                self.failed[name] = InputError(
                    f"{name}: the earlier run (--join) has a scene of this name already; leave this "
                    "image out, or rename it if it is another image"
                )
                continue
            scene = self.attempts[name].with_scene(scene)
            taken.add(scene.acquisition.image_id)
            self.opened.append(_Read(name, self.place.address_of(name, one.image), one, scene))

    def write_failures(self) -> None:
        """Write the reports of the scenes that were not registered."""
        for name, why in self.failed.items():
            write_failure(self.place.folder_of(name), self.attempts[name], why)


def _register(
    scenes: _Scenes,
    find_points: FindPoints,
    marks: MarkFiles | None,
    options: RegistrationOptions,
    progress: Progress,
) -> JointRegistration:
    """Scenes registered together on the control points of their ground, which the attempts note."""
    opened = [one.scene for one in scenes.opened]
    if not opened:
        why = next(iter(scenes.failed.values()))
        raise InputError(f"none of {len(scenes.attempts)} scenes can be used: {why}")
    _check_rigorous(scenes.opened)
    progress(0.0, "looking for points")
    control = find_points(_outline(opened))
    for one in scenes.opened:
        scenes.attempts[one.folder].control = control
    every = None if marks is None else _marks(scenes, marks, control)
    joined = scenes.place.joined
    before = tuple(one.scene for one in scenes.before)
    with open_executor(scenes.place.compute) as (executor, ahead):
        return register_together(
            opened,
            control.points,
            control.chips,
            options,
            marks=every,
            joined=None if joined is None else AdjustedScenes(before, joined.known),
            work=Work(executor, ahead=ahead),
            progress=part_of(progress, 0.0, 0.85),
        )


def _marks(scenes: _Scenes, files: MarkFiles, control: ControlSet) -> list[SceneMarks]:
    """The marks of each scene, which its attempt notes beside the points of the base."""
    read = read_marks_together(files, [(one.files.image, one.scene) for one in scenes.opened])
    scenes.held_out = {
        one.folder: marks.check
        for one, marks in zip(scenes.opened, read, strict=True)
        if marks.check is not None
    }
    every = [marks.control for marks in read]
    for one, own in zip(scenes.opened, every, strict=True):
        attempt = scenes.attempts[one.folder]
        attempt.control = replace(control, points=with_marks(control.points, own))
        attempt.marks = files.name
        attempt.statements.extend(own.statements)
    return every


def _write(
    result: JointRegistration, scenes: _Scenes, copy_image: bool, progress: Progress
) -> JointOutcome:
    """The outputs of each scene and of all; scenes that did not fit join those that failed."""
    by_name, place = {one.name: one for one in scenes.opened}, scenes.place
    left = [by_name[one.measured.name].folder for one in result.left]
    for name, gone in zip(left, result.left, strict=True):
        scenes.failed[name] = gone.error
        scenes.attempts[name].stages.extend(gone.measured.stages)
    scenes.write_failures()
    registered = {}
    for k, number in enumerate(result.numbers):
        progress(0.85 + 0.15 * k / len(result.numbers), "writing the reports")
        one = by_name[result.block.scenes[number].name]
        attempt = scenes.attempts[one.folder]
        checks: tuple[Check, ...] = ()
        registration = result.registrations[k]
        if one.folder in scenes.held_out:
            registration, check = checked(
                registration, scenes.held_out[one.folder], attempt.options, attempt.marks
            )
            checks = (check,)
        registered[one.folder] = write_registered(
            one.files,
            registration,
            attempt,
            place.folder_of(one.folder),
            copy_image=copy_image,
            checks=checks,
            rigorous=result.rigorous[k],
        )
    reports = [one.report for one in registered.values()]
    report = joint_report(result, reports, left, name=place.name, finished_at=datetime.now(UTC))
    of_block = place.folder_of(BLOCK_FOLDER)
    written = _write_block(of_block, report, result, [*scenes.before, *scenes.opened])
    return JointOutcome(report, registered, scenes.failed, written)


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
    scene = files.read()
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


def _write_block(
    folder: Path, report: JointReport, result: JointRegistration, read: Sequence[_Read]
) -> dict[str, Path]:
    """The report on all scenes, and what later scenes need to join them."""
    adjusted = {one.name: one.scene.model.height_range_m for one in result.block.scenes}
    members = [
        Member(one.name, one.address, one.files, adjusted[one.name])
        for one in read
        if one.name in adjusted
    ]
    written = write_report(folder, JOINT_PAGE, report)
    written |= write_texts(folder, {SCENES_JSON: format_scenes(members)})
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
