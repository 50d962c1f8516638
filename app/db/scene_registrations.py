"""The registrations of scenes as their owners see them: those that failed or are under way included."""

from collections import defaultdict
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal
from uuid import UUID

from amers.app.db.engine import Connection
from amers.app.db.rows import every
from amers.app.db.statements import named

SCENE_REGISTRATIONS = named("scenes.sql", "scene_registrations")

RegistrationOutcome = Literal["registered", "failed", "under way"]
"""`registered`: with a model that can be used; `failed`: without one, whatever the reason."""


@dataclass(frozen=True)
class SceneRegistration:
    """One registration of a scene.

    Attributes:
        process: of the job: of this scene alone, or together with others.
        verdict: None while it is under way, and where the job failed without one.
        relative_to_control_points, on_the_earth: accuracy that the report states; None without one.
    """

    scene_id: UUID
    job_id: UUID
    process: str
    created_at: datetime
    finished_at: datetime | None
    outcome: RegistrationOutcome
    verdict: str | None
    relative_to_control_points: dict[str, Any] | None
    on_the_earth: dict[str, Any] | None


def last_registrations(
    connection: Connection, scene_ids: list[UUID], caller: UUID, most: int
) -> dict[UUID, list[SceneRegistration]]:
    """The last registrations of some scenes, the newest first, made by their owners or the caller.

    Args:
        most: number of registrations of each scene.
    """
    parameters = {"scene_ids": scene_ids, "caller": caller, "most": most}
    found = defaultdict(list)
    for one in every(SceneRegistration, connection.execute(SCENE_REGISTRATIONS, parameters)):
        found[one.scene_id].append(one)
    return found
