"""Models of scenes and of uploads."""

from datetime import datetime
from typing import Literal
from uuid import UUID

from amers.app.api.models.base import Link, Reply, StatedAccuracy
from amers.app.api.models.features import AnyGeometry
from amers.app.db.scene_registrations import RegistrationOutcome
from amers.app.db.schema import SceneState, UploadPurpose


class SceneRegistration(Reply):
    """A registration of a scene; `outcome` is `registered` where it made a model that can be used."""

    job: UUID
    process: str
    outcome: RegistrationOutcome
    verdict: str | None
    relative_to_control_points: StatedAccuracy | None
    on_the_earth: StatedAccuracy | None
    created: datetime
    finished: datetime | None


class Scene(Reply):
    """A scene; what its files state about it is null until it is registered.

    `registrations` are the last ones, the newest first; in a list of scenes only the newest.
    """

    id: UUID
    name: str
    state: SceneState
    file: str
    models: list[str]
    size_bytes: int | None
    sha256: str | None
    sigma_m: float | None
    sensor: str | None
    acquired: datetime | None
    gsd_m: float | None
    footprint: AnyGeometry | None
    created: datetime
    removed: datetime | None
    registrations: list[SceneRegistration]


class Scenes(Reply):
    """A page of scenes, newest first."""

    scenes: list[Scene]
    links: list[Link]


class StoredFile(Reply):
    """A file in the storage."""

    name: str
    size_bytes: int
    sha256: str


class Upload(Reply):
    """A resumable upload; `offset` is the number of bytes that have arrived."""

    id: UUID
    state: Literal["arriving", "finished"]
    purpose: UploadPurpose
    name: str
    offset: int
    size_bytes: int
    scene: UUID | None
    created: datetime
    expires: datetime | None
