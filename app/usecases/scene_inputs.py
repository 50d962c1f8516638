"""What jobs on an uploaded scene ask of it and of the files that are named beside its image."""

from typing import Any
from uuid import UUID

from app.db import scenes
from app.db.engine import Connection
from app.db.scenes import SceneRow
from app.db.tokens import Token
from app.errors import Conflict, InputError
from app.usecases.scenes import clean_name, visible_scene


def check_scene(connection: Connection, caller: Token, scene_id: UUID) -> None:
    """Refuse a job on a scene that is not there to be worked on.

    Raises:
        NotFound: there is none, or it is somebody else's.
        Conflict: its image has not arrived, or is gone.
    """
    scene = visible_scene(connection, caller, scene_id)
    if scene.state != "uploaded":
        raise Conflict(f"scene {scene_id} cannot be worked on: its image is {scene.state}")


def check_file_names(inputs: Any, *names: str) -> None:
    """Refuse inputs that name anything but files as they lie beside an image.

    Args:
        inputs: of a process.
        names: of its inputs that are None or the name of a file.

    Raises:
        InputError: one of them is a path, or no name that a file can have.
    """
    for name in names:
        given = getattr(inputs, name)
        if given is not None and given != clean_name(given):
            raise InputError(f"{name}: {given!r} is not the name of an uploaded file")


def present_scene(connection: Connection, scene_id: UUID) -> SceneRow:
    """The scene of a job, which may have been removed since the job was asked for.

    Raises:
        Conflict: it has been.
    """
    scene = scenes.find_scene(connection, scene_id)
    if scene is None or scene.state == "removed":
        raise Conflict(f"scene {scene_id} has been removed")
    return scene
