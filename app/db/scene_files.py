"""The files of scenes that callers can get: image, models, results of the last registration."""

from dataclasses import dataclass
from typing import Any
from uuid import UUID

from amers.app.db.engine import Connection
from amers.app.db.rows import every
from amers.app.db.statements import named

SCENE_FILES = named("scenes.sql", "scene_files")


@dataclass(frozen=True)
class SceneFiles:
    """The files of one scene.

    Attributes:
        image: name of the file; None after its removal, or when it was not uploaded.
        models: names of the files beside it.
        job_id: the last job that registered the scene and whose files are still there.
        results: name to key in the storage of the files that it made of the scene.
        accuracy: what the report of the last registration states, by the names of its members, None in
            reports without them; None without a registration.
    """

    scene_id: UUID
    image: str | None
    models: list[str]
    job_id: UUID | None
    results: dict[str, str]
    accuracy: dict[str, Any] | None


def read_scene_files(connection: Connection, scene_ids: list[UUID]) -> dict[UUID, SceneFiles]:
    """The files of some scenes."""
    rows = connection.execute(SCENE_FILES, {"scene_ids": scene_ids})
    return {files.scene_id: files for files in every(SceneFiles, rows)}
