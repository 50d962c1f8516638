"""The uploaded scenes of a job that uses several, with the models that other jobs made of them."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from uuid import UUID

from amers.app.db import registrations
from amers.app.db.engine import Connection
from amers.app.db.scenes import SceneRow
from amers.app.db.tokens import Token
from amers.app.errors import InputError
from amers.app.usecases.damage import named_by_row
from amers.app.usecases.processes import Work
from amers.app.usecases.registration.joint_job import MOST_SCENES
from amers.app.usecases.scene_inputs import check_scene, present_scene, registered_model_keys
from amers.app.usecases.scenes import local_image, stored_keys


@dataclass(frozen=True)
class StoredScene:
    """A scene and the keys of its registered model, none if the uploaded one is used."""

    row: SceneRow
    model: list[str]

    @property
    def keys(self) -> list[str]:
        """Of all its files in the storage."""
        return [*stored_keys(self.row), *self.model]


def check_scenes(connection: Connection, caller: Token, scenes: Sequence[UUID], fewest: int) -> None:
    """Refuse too few scenes, too many, the same twice, and those that a caller may not use.

    Raises:
        InputError: of their number.
        NotFound: there is no such scene, or the caller may not see it.
        Conflict: its image has not arrived, or was removed.
    """
    if not fewest <= len(scenes) <= MOST_SCENES or len(set(scenes)) < len(scenes):
        raise InputError(
            f"scenes: {len(scenes)} given, {len(set(scenes))} of them different; {fewest} to "
            f"{MOST_SCENES} different ones expected"
        )
    for scene in scenes:
        check_scene(connection, caller, scene)


def stored_scenes(
    connection: Connection, scenes: Sequence[UUID], jobs: Sequence[UUID]
) -> list[StoredScene]:
    """Scenes with the keys of the models that some jobs made of them, the last job first.

    Raises:
        InputError: a scene was registered by none of the jobs.
        Conflict: a scene or the results of a job were removed.
    """
    return [
        StoredScene(present_scene(connection, scene), _model_keys(connection, scene, jobs))
        for scene in scenes
    ]


def _model_keys(connection: Connection, scene: UUID, jobs: Sequence[UUID]) -> list[str]:
    if not jobs:
        return []
    for job in reversed(jobs):
        if registrations.find_of_scene(connection, job, scene) is not None:
            return registered_model_keys(connection, scene, job)
    raise InputError(f"registrations: none of the jobs registered scene {scene}")


def local_scene(work: Work, stored: StoredScene, stack: ExitStack) -> tuple[Path, Path | None]:
    """The image of a scene and the folder of its registration, if any, until the stack closes."""
    scratch, folder = (Path(stack.enter_context(TemporaryDirectory(prefix="amers-"))) for _ in range(2))
    image = local_image(work.storage, work.settings, stored.row, scratch)
    registration = None
    for key in stored.model:
        with named_by_row(key):
            registration = work.storage.fetch(key, folder).parent
    return image, registration
