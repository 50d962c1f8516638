"""The table `scene`: images that were uploaded. Their files lie in the storage under `scenes/ID/`."""

from dataclasses import dataclass
from datetime import datetime
from typing import Literal
from uuid import UUID, uuid4

from psycopg.rows import class_row, scalar_row

from app.db.engine import Connection
from services.types import Array

SceneState = Literal["uploading", "uploaded", "removed"]

COLUMNS = """id, owner, name, state, file_name, file_key, size_bytes, sha256, sigma_m, created_at,
    removed_at, st_asgeojson(footprint, 7)::json as footprint"""
LONGEST_UPLOAD_HOURS = 24


@dataclass(frozen=True)
class SceneRow:
    """An uploaded scene.

    Attributes:
        owner: the token that uploaded it; None for the command line.
        file_name: of the image, as the storage has it.
        file_key, size_bytes, sha256: of the image; None while it is on its way, no key once removed.
        sigma_m: accuracy of the model as the owner states it, metres.
        footprint: GeoJSON; None until the scene was registered once.
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
    footprint: dict[str, object] | None


def begin_upload(
    connection: Connection, owner: UUID | None, name: str, file_name: str, sigma_m: float | None
) -> UUID:
    """A scene whose image is about to arrive."""
    scene_id = uuid4()
    connection.execute(
        "insert into scene (id, owner, name, state, file_name, sigma_m)"
        " values (%s, %s, %s, 'uploading', %s, %s)",
        [scene_id, owner, name, file_name, sigma_m],
    )
    return scene_id


def finish_upload(
    connection: Connection, scene_id: UUID, key: str, size_bytes: int, sha256: str
) -> SceneRow | None:
    """The scene, now that its image is in the storage; None when it was given up meanwhile."""
    with connection.cursor(row_factory=class_row(SceneRow)) as cursor:
        return cursor.execute(
            f"""update scene set state = 'uploaded', file_key = %s, size_bytes = %s, sha256 = %s
                where id = %s and state = 'uploading' returning {COLUMNS}""",
            [key, size_bytes, sha256, scene_id],
        ).fetchone()


def give_up_upload(connection: Connection, scene_id: UUID) -> None:
    """Forget a scene whose image did not arrive."""
    connection.execute("delete from scene where id = %s and state = 'uploading'", [scene_id])


def give_up_old_uploads(connection: Connection) -> None:
    """Forget the scenes whose upload was cut off with the process that received it."""
    connection.execute(
        "delete from scene where state = 'uploading'"
        " and created_at < now() - make_interval(hours => %s)",
        [LONGEST_UPLOAD_HOURS],
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
