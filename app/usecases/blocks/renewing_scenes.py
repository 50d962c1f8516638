"""The scenes that renew a block: found by their registrations, and registered on all its points."""

from collections.abc import Collection, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from uuid import UUID

import numpy as np

from amers.app.config import Settings
from amers.app.db import registrations
from amers.app.db.blocks import Block
from amers.app.db.engine import Connection, Database
from amers.app.db.history import NOT_ATTRIBUTABLE
from amers.app.db.jobs import jobs
from amers.app.db.registrations import RegistrationRow
from amers.app.errors import ComputationError, InputError, NotFound
from amers.app.storage import Storage
from amers.app.usecases.damage import suspecting_damage
from amers.app.usecases.registration.job import REGISTER_SCENE, scene_files
from amers.app.usecases.registration.joint_job import REGISTER_SCENES
from amers.app.usecases.registration.register import SceneFiles, image_key
from amers.app.usecases.scene_inputs import naming, present_scene
from amers.app.usecases.scenes import local_image, stored_keys
from amers.services.formats.images.bands import parse_bands
from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import CachedImage
from amers.services.production.new_points import registered_scene
from amers.services.quality.qualification import QualificationOptions
from amers.services.registration.on_points import register_scene
from amers.services.registration.options import RegistrationOptions
from amers.services.types import BoolArray, ChipSource, ControlPoints, IntArray, Progress, part_of

PROCESSES = {process.id: process for process in (REGISTER_SCENE, REGISTER_SCENES)}
"""Processes that register scenes."""


@dataclass(frozen=True)
class GoodScene:
    """A scene that was registered on a block with the verdict "good".

    Attributes:
        name: for messages and documents.
        files: of the scene, on this machine.
        registration: its id in the store.
        registered_at: when.
        options: of that registration.
    """

    name: str
    files: SceneFiles
    registration: UUID
    registered_at: datetime
    options: RegistrationOptions = field(default_factory=RegistrationOptions)


@dataclass(frozen=True)
class SceneOnBlock:
    """A scene registered on all points of one block.

    Attributes:
        name, registration: as in `GoodScene`.
        scene: with its registered model and the accuracy of that; open as long as the caller's stack.
        taken_at: when it was taken, or registered where that is unknown.
        searched: (k,) int64 rows of the points that it shows and tried.
        found: (k,) whether the point was active at the end.
    """

    name: str
    registration: UUID
    scene: Scene
    taken_at: datetime
    searched: IntArray
    found: BoolArray


def registered_job(
    connection: Connection, block: Block, job_id: UUID, scenes: Collection[UUID] = ()
) -> list[RegistrationRow]:
    """The registrations of a job, good and on a version of a block.

    Args:
        connection: for reading.
        block: to be renewed.
        job_id: of a job that registered one scene, or several together.
        scenes: the only scenes that are used of several; by default those with the verdict "good".

    Raises:
        NotFound: there is no such job.
        InputError: it is no registration, or cannot renew the block; the message names it.
    """
    job = jobs.find(connection, job_id)
    if job is None:
        raise NotFound(f"no job {job_id}")
    name = f"job {job_id}"
    if job.kind not in PROCESSES or job.state != "successful":
        raise InputError(
            f"{name}: is of the process {job.kind}, {job.state}; a successful one of "
            f"{' or '.join(PROCESSES)} is expected"
        )
    rows = registrations.find_of_job(connection, job_id)
    if job.kind == REGISTER_SCENE.id:
        return [_usable(rows[0] if rows else None, block, name)]
    if scenes:
        rows = [row for row in rows if row.scene_id in scenes]
    else:
        rows = [row for row in rows if row.verdict == "good"]
    if not rows:
        which = "of the scenes named" if scenes else "with the verdict 'good'"
        raise InputError(f"{name}: registered no scene {which}; leave it out")
    return [_usable(row, block, f"scene {row.scene_id} of {name}") for row in rows]


def scene_of_job(
    database: Database,
    storage: Storage,
    settings: Settings,
    registered: RegistrationRow,
    scratch: Path,
) -> GoodScene:
    """The scene of the job of a registration, with its files on this machine.

    Args:
        database, storage, settings: of the installation.
        registered: one from `registered_job`.
        scratch: existing folder of the caller's, for copies of files that lie in a bucket.

    Raises:
        Conflict: the scene was removed.
        NotFound: the job was removed.
    """
    assert registered.job_id is not None
    with database.reading() as connection:
        job = jobs.find(connection, registered.job_id)
        if job is None:
            raise NotFound(f"no job {registered.job_id}")
        assert registered.scene_id is not None
        scene = present_scene(connection, registered.scene_id)
    folder = scratch / str(registered.id)
    folder.mkdir()
    with suspecting_damage(database, storage, stored_keys(scene)):
        image = local_image(storage, settings, scene, folder)
    inputs = PROCESSES[job.kind].parse_inputs(job.inputs)
    files = SceneFiles(image, sigma_m=scene.sigma_m, bands=inputs.bands)
    if job.kind == REGISTER_SCENE.id:
        files = scene_files(inputs, image, scene.sigma_m)
    return GoodScene(
        f"scene {scene.name} of job {job.id}",
        files,
        registered.id,
        registered.created_at,
        inputs.options,
    )


def scene_of_image(connection: Connection, block: Block, image: Path) -> GoodScene:
    """The scene of an image on this machine that `amers scene register` has registered on the store.

    Its model is found by its name, with the accuracy of that registration.

    Raises:
        InputError: there is no such image, or it cannot renew the block; the message names it.
    """
    if not image.is_file():
        raise InputError(f"{image}: no such file")
    row = _usable(registrations.find_counted(connection, image_key(image)), block, str(image))
    sigma_m = float(row.report["scene"]["sigma_m"])
    return GoodScene(image.name, SceneFiles(image, sigma_m=sigma_m), row.id, row.created_at)


def _usable(row: RegistrationRow | None, block: Block, name: str) -> RegistrationRow:
    """A registration that can renew a block."""
    if row is None:
        raise InputError(
            f"{name}: no registration on the points of the store is known; register it there first "
            "(amers scene register, without --block)"
        )
    used = [f"{one['id']}@{one['version']}" for one in row.block_versions]
    if block.id not in [one["id"] for one in row.block_versions]:
        raise InputError(
            f"{name}: was registered on {', '.join(used) or 'no block'}, and block {block.id} is to be "
            "renewed; leave it out"
        )
    if row.verdict != "good":
        raise InputError(
            f"{name}: the verdict on its registration is {row.verdict!r}, 'good' is expected; "
            "leave it out"
        )
    return row


def register_on_block(
    points: ControlPoints,
    chips: ChipSource,
    given: Sequence[GoodScene],
    stack: ExitStack,
    progress: Progress,
) -> list[SceneOnBlock]:
    """Register scenes on all points of one block, and on nothing else, so that its frame is theirs.

    Args:
        points: of the block, of ascending ids.
        chips: of the points.
        given: the scenes; their images stay open as long as `stack`.
        stack: closes the images.
        progress: receives the fraction done and a message.

    Raises:
        InputError: two images have one name, an image cannot be used, or the verdict is not "good".
        ComputationError: a scene cannot be registered.
    """
    taken = {image.image_id for image in points.views.images}
    on_block = []
    for number, one in enumerate(given):
        part = part_of(progress, number / len(given), 1.0 / len(given))
        part(0.0, f"registering {one.name} on all points of the block")
        files = one.files
        scene = read_scene(
            files.image,
            files.model,
            sigma_m=files.sigma_m,
            bands=None if files.bands is None else parse_bands(files.bands),
            mask=files.mask,
        )
        stack.callback(scene.image.close)  # type: ignore[attr-defined]
        if scene.acquisition.image_id in taken:
            raise InputError(
                f"{one.name}: the block has views of an image {scene.acquisition.image_id} already; "
                "leave it out, or rename the image if it is another one"
            )
        taken.add(scene.acquisition.image_id)
        on_block.append(_registered(one, scene, points, chips, part))
    return on_block


def _registered(
    one: GoodScene, scene: Scene, points: ControlPoints, chips: ChipSource, progress: Progress
) -> SceneOnBlock:
    options = replace(one.options, max_points=0, qualification=QualificationOptions())
    try:
        with naming(one.name):
            made = register_scene(scene, points, chips, options, progress=progress)
    except ComputationError as error:
        raise ComputationError(f"{one.name}: {error}") from error
    verdict = made.qualification.verdict
    if verdict != "good":
        raise InputError(
            f"{one.name}: on all points of the block the verdict is {verdict!r}, 'good' is expected; "
            "leave it out"
        )
    tried = ~np.isin(made.measures.reason, NOT_ATTRIBUTABLE)
    return SceneOnBlock(
        name=one.name,
        registration=one.registration,
        scene=registered_scene(
            replace(scene, image=CachedImage(scene.image)), made.model, made.adjustment
        ),
        taken_at=scene.acquisition.acquired_at or one.registered_at,
        searched=np.searchsorted(points.id, made.measures.point_id[tried]),
        found=made.measures.active[tried],
    )
