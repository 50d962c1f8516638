"""The table `scene`: images that were uploaded. Their files lie in the storage under `scenes/ID/`."""

import math
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal
from uuid import UUID, uuid4

from psycopg.rows import class_row, scalar_row
from psycopg.types.json import Jsonb

from app.db.engine import Connection
from services.types import Acquisition, Array

SceneState = Literal["uploading", "uploaded", "removed"]

COLUMNS = """id, owner, name, state, file_name, file_key, size_bytes, sha256, sigma_m, created_at,
    removed_at, models, reference, acquired_at, sensor, gsd_m,
    st_asgeojson(footprint, 7)::json as footprint"""
LONGEST_UPLOAD_HOURS = 24


@dataclass(frozen=True)
class SceneRow:
    """An uploaded scene.

    Attributes:
        owner: the token that uploaded it; None for the command line.
        file_name: of the image, as the storage has it.
        file_key, size_bytes, sha256: of the image; None while it is on its way, no key once removed.
        sigma_m: accuracy of the model as the owner states it, metres.
        models: the files beside the image, name to size and checksum.
        reference: path below AMERS_SCENE_FOLDER of an image that was not uploaded.
        acquired_at, sensor, gsd_m, footprint: what the files say; None before a registration.
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


def begin_upload(
    connection: Connection,
    owner: UUID | None,
    name: str,
    file_name: str,
    sigma_m: float | None,
    announced_bytes: int | None = None,
) -> UUID:
    """A scene whose image is about to arrive."""
    scene_id = uuid4()
    connection.execute(
        "insert into scene (id, owner, name, state, file_name, sigma_m, size_bytes)"
        " values (%s, %s, %s, 'uploading', %s, %s, %s)",
        [scene_id, owner, name, file_name, sigma_m, announced_bytes],
    )
    return scene_id


def insert_reference(
    connection: Connection, owner: UUID, name: str, path: str, sigma_m: float | None
) -> SceneRow:
    """A scene that stays where it lies, below the folder of the settings."""
    with connection.cursor(row_factory=class_row(SceneRow)) as cursor:
        row = cursor.execute(
            f"""insert into scene (id, owner, name, state, file_name, reference, sigma_m)
                values (%s, %s, %s, 'uploaded', %s, %s, %s) returning {COLUMNS}""",
            [uuid4(), owner, name, name, path, sigma_m],
        ).fetchone()
    assert row is not None
    return row


def add_model(connection: Connection, scene_id: UUID, name: str, size_bytes: int, sha256: str) -> bool:
    """Note a file beside the image; False when the scene has no files any more."""
    done = connection.execute(
        """update scene set models = models || jsonb_build_object(%s::text, %s::jsonb)
           where id = %s and state <> 'removed'""",
        [name, Jsonb({"size_bytes": size_bytes, "sha256": sha256}), scene_id],
    )
    return done.rowcount == 1


def finish_upload(
    connection: Connection,
    scene_id: UUID,
    key: str,
    size_bytes: int,
    sha256: str,
) -> SceneRow | None:
    """The scene, now that its image is in the storage; None when it was given up meanwhile."""
    with connection.cursor(row_factory=class_row(SceneRow)) as cursor:
        return cursor.execute(
            f"""update scene set state = 'uploaded', file_key = %s, file_name = %s, size_bytes = %s,
                    sha256 = %s
                where id = %s and state = 'uploading' returning {COLUMNS}""",
            [key, key.rsplit("/", 1)[-1], size_bytes, sha256, scene_id],
        ).fetchone()


def give_up_upload(connection: Connection, scene_id: UUID) -> None:
    """Forget a scene whose image did not arrive."""
    connection.execute("delete from scene where id = %s and state = 'uploading'", [scene_id])


def give_up_old_uploads(connection: Connection) -> None:
    """Forget the scenes whose upload was cut off with the process that received it."""
    connection.execute(
        "delete from scene where state = 'uploading'"
        " and created_at < now() - make_interval(hours => %(hours)s)"
        " and created_at_uptime_s < uptime_s() - 3600 * %(hours)s"
        " and not exists (select from upload where scene_id = scene.id and finished_at is null)",
        {"hours": LONGEST_UPLOAD_HOURS},
    )


def find_scene(connection: Connection, scene_id: UUID) -> SceneRow | None:
    """The scene with that id."""
    with connection.cursor(row_factory=class_row(SceneRow)) as cursor:
        return cursor.execute(f"select {COLUMNS} from scene where id = %s", [scene_id]).fetchone()


def newest_scenes(connection: Connection, owner: UUID | None, limit: int) -> list[SceneRow]:
    """The last scenes of an owner, or of everybody for None; the newest first."""
    with connection.cursor(row_factory=class_row(SceneRow)) as cursor:
        return cursor.execute(
            f"""select {COLUMNS} from scene where %(owner)s::uuid is null or owner = %(owner)s
                order by created_at desc, id limit %(limit)s""",
            {"owner": owner, "limit": limit},
        ).fetchall()


def set_footprint(connection: Connection, scene_id: UUID, outline: Array) -> None:
    """Remember the ground a scene can show.

    Args:
        outline: (n, 2) lon, lat, degrees, not closed.
    """
    ring = ", ".join(f"{lon:.9f} {lat:.9f}" for lon, lat in [*outline, outline[0]])
    connection.execute(
        "update scene set footprint = st_geomfromtext(%s, 4326) where id = %s",
        [f"POLYGON(({ring}))", scene_id],
    )


def describe(
    connection: Connection,
    scene_id: UUID,
    taken: Acquisition,
    shape: tuple[int, int],
    gsd_m: float,
) -> None:
    """Remember what the files of a scene say of it."""
    angles = (taken.incidence_deg, taken.azimuth_deg, taken.sun_elevation_deg, taken.sun_azimuth_deg)
    connection.execute(
        """update scene set sensor = %s, acquired_at = %s, incidence_deg = %s, azimuth_deg = %s,
               sun_elevation_deg = %s, sun_azimuth_deg = %s, lines = %s, samples = %s, gsd_m = %s
           where id = %s""",
        [
            taken.sensor or None,
            taken.acquired_at,
            *(None if angle is None or math.isnan(angle) else angle for angle in angles),
            *shape,
            gsd_m,
            scene_id,
        ],
    )


def remove_scene(connection: Connection, scene_id: UUID) -> None:
    """Forget where the files of a scene are; what is known about it stays."""
    connection.execute(
        "update scene set state = 'removed', file_key = null, removed_at = now() where id = %s",
        [scene_id],
    )


def with_files(connection: Connection, scene_ids: list[UUID]) -> set[UUID]:
    """Those of some scenes whose files are still wanted."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        rows = cursor.execute(
            "select id from scene where id = any(%s) and state <> 'removed'", [scene_ids]
        )
        return set(rows)
