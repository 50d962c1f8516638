"""The table `scene`: images that were uploaded. Their files lie in the storage under `scenes/ID/`."""

import math
from dataclasses import dataclass
from datetime import datetime
from typing import Any
from uuid import UUID, uuid4

from sqlalchemy import (
    JSON,
    BigInteger,
    ColumnElement,
    Text,
    cast,
    delete,
    exists,
    func,
    insert,
    literal,
    select,
    tuple_,
    update,
)
from sqlalchemy.dialects.postgresql import JSONB

from amers.app.db.engine import Connection
from amers.app.db.rows import among, columns_of, every, first, only
from amers.app.db.schema import SceneState, hours, now, scene, upload, uptime_s
from amers.services.types import Acquisition, Array

LONGEST_UPLOAD_HOURS = 24


@dataclass(frozen=True)
class SceneRow:
    """An uploaded scene.

    Attributes:
        owner: the token that uploaded it; None for the command line.
        file_name: of the image in the storage.
        file_key, size_bytes, sha256: of the image; None during the upload; no key after the removal.
        sigma_m: accuracy of the model as the owner states it, metres.
        models: the files beside the image, name to size and checksum.
        reference: path below AMERS_SCENE_FOLDER of an image that was not uploaded.
        acquired_at, sensor, gsd_m, footprint: read from the files; None before a registration.
    """

    id: UUID
    owner: UUID | None
    name: str
    state: SceneState
    file_name: str
    file_key: str | None
    size_bytes: int | None
    sha256: str | None
    sigma_m: float | None
    created_at: datetime
    removed_at: datetime | None
    models: dict[str, dict[str, Any]]
    reference: str | None
    acquired_at: datetime | None
    sensor: str | None
    gsd_m: float | None
    footprint: dict[str, object] | None


COLUMNS = columns_of(SceneRow, scene, footprint=cast(func.ST_AsGeoJSON(scene.c.footprint, 7), JSON))


def begin_upload(
    connection: Connection,
    owner: UUID | None,
    name: str,
    file_name: str,
    *,
    sigma_m: float | None,
    announced_bytes: int | None = None,
) -> UUID:
    """Insert a scene whose image will be uploaded; returns its id.

    Args:
        announced_bytes: size of the image, or the most that may arrive; None where a row of `upload` has
            it.
    """
    scene_id = uuid4()
    connection.execute(
        insert(scene).values(
            id=scene_id,
            owner=owner,
            name=name,
            state="uploading",
            file_name=file_name,
            sigma_m=sigma_m,
            size_bytes=announced_bytes,
        )
    )
    return scene_id


def insert_reference(
    connection: Connection, owner: UUID, name: str, path: str, sigma_m: float | None
) -> SceneRow:
    """A new scene whose image stays in the folder of the settings."""
    statement = (
        insert(scene)
        .values(
            id=uuid4(),
            owner=owner,
            name=name,
            state="uploaded",
            file_name=name,
            reference=path,
            sigma_m=sigma_m,
        )
        .returning(*COLUMNS)
    )
    return only(SceneRow, connection.execute(statement))


def add_model(connection: Connection, scene_id: UUID, name: str, size_bytes: int, sha256: str) -> bool:
    """Record a file beside the image; False when the files of the scene were removed."""
    file = literal({name: {"size_bytes": size_bytes, "sha256": sha256}}, JSONB)
    updated = connection.execute(
        update(scene)
        .where(scene.c.id == scene_id, scene.c.state != "removed")
        .values(
            models=scene.c.models.concat(file),
            side_file_bytes=scene.c.side_file_bytes + size_bytes - _recorded_bytes(name),
        )
    )
    return updated.rowcount == 1


def drop_model(connection: Connection, scene_id: UUID, name: str) -> None:
    """Delete the record of a file beside the image, if there is one."""
    connection.execute(
        update(scene)
        .where(scene.c.id == scene_id, scene.c.models.has_key(name))
        .values(
            models=scene.c.models.op("-")(cast(name, Text)),
            side_file_bytes=scene.c.side_file_bytes - _recorded_bytes(name),
        )
    )


def reserve(connection: Connection, scene_id: UUID, size_bytes: int) -> None:
    """Record the bytes that a scene will take beyond the size of its upload."""
    connection.execute(
        update(scene)
        .where(scene.c.id == scene_id, scene.c.state == "uploading")
        .values(size_bytes=size_bytes)
    )


def finish_upload(
    connection: Connection,
    scene_id: UUID,
    key: str,
    size_bytes: int,
    sha256: str,
) -> SceneRow | None:
    """The scene, now that its image is in the storage; None when it was given up meanwhile."""
    statement = (
        update(scene)
        .where(scene.c.id == scene_id, scene.c.state == "uploading")
        .values(
            state="uploaded",
            file_key=key,
            file_name=key.rsplit("/", 1)[-1],
            size_bytes=size_bytes,
            sha256=sha256,
        )
        .returning(*COLUMNS)
    )
    return first(SceneRow, connection.execute(statement))


def give_up_upload(connection: Connection, scene_id: UUID) -> None:
    """Delete a scene whose image did not arrive."""
    connection.execute(delete(scene).where(scene.c.id == scene_id, scene.c.state == "uploading"))


def give_up_old_uploads(connection: Connection) -> None:
    """Delete the scenes whose upload ended with the process that received it."""
    under_way = exists(upload.c.id).where(
        upload.c.scene_id == scene.c.id, upload.c.finished_at.is_(None)
    )
    connection.execute(
        delete(scene).where(
            scene.c.state == "uploading",
            scene.c.created_at < now - hours(LONGEST_UPLOAD_HOURS),
            scene.c.created_at_uptime_s < uptime_s - 3600 * LONGEST_UPLOAD_HOURS,
            ~under_way.correlate(scene),
        )
    )


def find_scene(connection: Connection, scene_id: UUID) -> SceneRow | None:
    """The scene with that id."""
    return first(SceneRow, connection.execute(select(*COLUMNS).where(scene.c.id == scene_id)))


def newest_scenes(
    connection: Connection, owner: UUID | None, limit: int, after: UUID | None = None
) -> list[SceneRow]:
    """The last scenes of an owner, or of everybody for None; the newest first.

    Args:
        after: the page starts behind this scene.
    """
    statement = select(*COLUMNS).order_by(scene.c.created_at.desc(), scene.c.id.desc()).limit(limit)
    if owner is not None:
        statement = statement.where(scene.c.owner == owner)
    if after is not None:
        last = scene.alias("last")
        key = select(last.c.created_at, last.c.id).where(last.c.id == after).scalar_subquery()
        statement = statement.where(tuple_(scene.c.created_at, scene.c.id) < key)
    return every(SceneRow, connection.execute(statement))


def scene_names(connection: Connection, scene_ids: list[UUID]) -> dict[UUID, str]:
    """The names of some scenes."""
    statement = select(scene.c.id, scene.c.name).where(among(scene.c.id, scene_ids))
    return {row.id: row.name for row in connection.execute(statement)}


def set_footprint(connection: Connection, scene_id: UUID, outline: Array) -> None:
    """Store the ground that a scene can show.

    Args:
        outline: (n, 2) lon, lat, degrees, not closed.
    """
    ring = ", ".join(f"{lon:.9f} {lat:.9f}" for lon, lat in [*outline, outline[0]])
    connection.execute(
        update(scene)
        .where(scene.c.id == scene_id)
        .values(footprint=func.ST_GeomFromText(f"POLYGON(({ring}))", 4326))
    )


def describe(
    connection: Connection,
    scene_id: UUID,
    taken: Acquisition,
    shape: tuple[int, int],
    gsd_m: float,
) -> None:
    """Store what the files of a scene contain about it."""
    connection.execute(
        update(scene)
        .where(scene.c.id == scene_id)
        .values(
            sensor=taken.sensor or None,
            acquired_at=taken.acquired_at,
            incidence_deg=_finite(taken.incidence_deg),
            azimuth_deg=_finite(taken.azimuth_deg),
            sun_elevation_deg=_finite(taken.sun_elevation_deg),
            sun_azimuth_deg=_finite(taken.sun_azimuth_deg),
            lines=shape[0],
            samples=shape[1],
            gsd_m=gsd_m,
        )
    )


def remove_scene(connection: Connection, scene_id: UUID) -> None:
    """Mark a scene as removed, without the key of its files; the rest of its row stays."""
    connection.execute(
        update(scene)
        .where(scene.c.id == scene_id)
        .values(state="removed", file_key=None, removed_at=now)
    )


def keeping_files(connection: Connection, scene_ids: list[UUID]) -> dict[UUID, bool]:
    """Those of some scenes that exist, with whether they keep their files: they are not removed."""
    statement = select(scene.c.id, scene.c.state).where(among(scene.c.id, scene_ids))
    return {row.id: row.state != "removed" for row in connection.execute(statement)}


def _finite(angle_deg: float | None) -> float | None:
    return None if angle_deg is None or math.isnan(angle_deg) else angle_deg


def _recorded_bytes(name: str) -> ColumnElement[int]:
    """The recorded size of a file beside the image of a scene, 0 without such a file."""
    return func.coalesce(cast(scene.c.models[name]["size_bytes"].astext, BigInteger), 0)
