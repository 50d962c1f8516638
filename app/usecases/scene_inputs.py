"""Checks of jobs on an uploaded scene: of the scene, its registration, and names of its files."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from uuid import UUID

from amers.app.db import registrations, scenes
from amers.app.db.engine import Connection
from amers.app.db.scenes import SceneRow
from amers.app.db.tokens import Token
from amers.app.errors import Conflict, InputError
from amers.app.usecases.registered_scene import REFINED_NAME
from amers.app.usecases.scenes import clean_name, visible_scene
from amers.services.formats.sensor_models.refined_model import CORRECTION_JSON


def check_scene(connection: Connection, caller: Token, scene_id: UUID) -> None:
    """Refuse a job on a scene without an image.

    Raises:
        NotFound: there is no such scene, or the caller may not see it.
        Conflict: its image has not arrived, or was removed.
    """
    scene = visible_scene(connection, caller, scene_id)
    if scene.state != "uploaded":
        raise Conflict(f"scene {scene_id} is {scene.state}, uploaded is expected")


def check_file_names(inputs: Any, *fields: str) -> None:
    """Refuse inputs with values that cannot be names of files beside an image.

    Args:
        inputs: of a process.
        fields: names of the inputs that are None or a file name.

    Raises:
        InputError: a value is a path, or has characters that stored names do not have.
    """
    for field in fields:
        name = getattr(inputs, field)
        if name is not None and name != clean_name(name):
            raise InputError(f"{field}: {name!r} is not the name of a file uploaded beside the image")


@contextmanager
def naming(field: str) -> Iterator[None]:
    """Put the name of an input before the message of its refusal."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{field}: {error}") from None


def registration_files(connection: Connection, scene_id: UUID, job_id: UUID) -> dict[str, str]:
    """Name to storage key of the outputs that a job made of a scene that it registered.

    Raises:
        InputError: the job did not register the scene.
        Conflict: its results were removed.
    """
    registration = registrations.find_of_scene(connection, job_id, scene_id)
    if registration is None:
        raise InputError(f"registration: job {job_id} did not register scene {scene_id}")
    if not registration.files:
        raise Conflict(
            f"registration: the results of job {job_id} were removed; register scene {scene_id} again"
        )
    return registration.files


def registered_model_keys(connection: Connection, scene_id: UUID, job_id: UUID) -> list[str]:
    """The storage keys of the correction and the refined model that a job made of a scene.

    Raises:
        InputError: the job did not register the scene, or made no correction.
        Conflict: its results were removed.
    """
    files = registration_files(connection, scene_id, job_id)
    if CORRECTION_JSON not in files:
        raise InputError(f"registration: job {job_id} made no {CORRECTION_JSON}")
    return [files[name] for name in (CORRECTION_JSON, REFINED_NAME) if name in files]


def present_scene(connection: Connection, scene_id: UUID) -> SceneRow:
    """The scene of a job; it may have been removed since the job was created.

    Raises:
        Conflict: it was removed.
    """
    scene = scenes.find_scene(connection, scene_id)
    if scene is None or scene.state == "removed":
        raise Conflict(f"scene {scene_id} was removed; upload it again")
    return scene
