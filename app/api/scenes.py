"""Scenes: the request to take one in, and what there is."""

import re
from base64 import b64decode
from email.message import Message
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, BackgroundTasks, Query, Request, Response, status
from pydantic import BaseModel, Field

from app.api.body import body_chunks
from app.api.deps import DatabaseDep, Registrar, SettingsDep, StorageDep, UploadTurn
from app.api.files import file_reply
from app.db.scenes import SceneRow
from app.errors import InputError
from app.usecases import scenes
from app.usecases.features.stac import scene_media_type
from app.usecases.installation import Installation
from app.usecases.scenes import SentFile

router = APIRouter(tags=["scenes"])

MOST_LISTED = 1000
BINARY_BODY = {
    "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
}


class SceneOnServer(BaseModel):
    """A scene on the server.

    Attributes:
        path: of its image, below AMERS_SCENE_FOLDER; models lie beside it.
        sigma_m: accuracy of its model, metres.
    """

    path: str = Field(min_length=1, max_length=1000)
    sigma_m: float | None = Field(default=None, gt=0, allow_inf_nan=False)


@router.post(
    "/scenes",
    status_code=status.HTTP_201_CREATED,
    dependencies=[UploadTurn],
    openapi_extra={"requestBody": BINARY_BODY},
)
def upload_scene(
    request: Request,
    response: Response,
    database: DatabaseDep,
    storage: StorageDep,
    settings: SettingsDep,
    caller: Registrar,
    name: Annotated[str | None, Query(description="Name of the file.")] = None,
    sigma_m: Annotated[
        float | None, Query(gt=0, allow_inf_nan=False, description="Accuracy of its model, metres.")
    ] = None,
) -> dict[str, Any]:
    """Upload the image of a scene as the body of the request: GeoTIFF, JPEG 2000 or NITF.

    The name comes from the query or from `Content-Disposition`; a checksum in `Repr-Digest` (sha-256) or
    `X-Checksum` (sha256 in hexadecimal) is compared. Files with the model follow by
    `PUT /scenes/{id}/files/{name}`.
    """
    sent = _sent_file(request, name or _disposition_name(request))
    scene = scenes.upload_scene(Installation(database, storage, settings), caller, sent, sigma_m)
    response.headers["Location"] = str(request.url_for("show_scene", scene_id=scene.id))
    return _scene(scene)


@router.put(
    "/scenes/{scene_id}/files/{name}",
    dependencies=[UploadTurn],
    openapi_extra={"requestBody": BINARY_BODY},
)
def upload_beside(
    scene_id: UUID,
    name: str,
    request: Request,
    database: DatabaseDep,
    storage: StorageDep,
    settings: SettingsDep,
    caller: Registrar,
) -> dict[str, Any]:
    """Upload a file to lie beside the image of a scene: model, terrain, mask or check points."""
    sent = _sent_file(request, name)
    stored = scenes.upload_side_file(Installation(database, storage, settings), caller, scene_id, sent)
    return {
        "name": stored.key.rsplit("/", 1)[1],
        "size_bytes": stored.size_bytes,
        "sha256": stored.sha256,
    }


@router.get("/scenes/{scene_id}/files/{name}", response_class=Response)
def download_file(
    scene_id: UUID, name: str, database: DatabaseDep, storage: StorageDep, caller: Registrar
) -> Response:
    """The image of a scene, or a file that was laid beside it, as it was sent."""
    with database.reading() as connection:
        key = scenes.file_key(connection, caller, scene_id, name)
    return file_reply(storage, key, scene_media_type(name))


@router.post("/scenes/reference", status_code=status.HTTP_201_CREATED)
def refer_to_scene(
    body: SceneOnServer,
    request: Request,
    response: Response,
    database: DatabaseDep,
    settings: SettingsDep,
    caller: Registrar,
) -> dict[str, Any]:
    """Take in a scene that lies on the server, below the folder of `AMERS_SCENE_FOLDER`."""
    with database.transaction() as connection:
        scene = scenes.add_server_scene(connection, settings, caller, body.path, body.sigma_m)
    response.headers["Location"] = str(request.url_for("show_scene", scene_id=scene.id))
    return _scene(scene)


@router.get("/scenes")
def list_scenes(
    database: DatabaseDep,
    caller: Registrar,
    limit: Annotated[int, Query(ge=1, le=MOST_LISTED)] = 100,
) -> dict[str, Any]:
    """The caller's scenes, the newest first; everybody's for an administrator."""
    with database.reading() as connection:
        found = scenes.list_scenes(connection, caller, limit)
    return {"scenes": [_scene(scene) for scene in found]}


@router.get("/scenes/{scene_id}")
def show_scene(scene_id: UUID, database: DatabaseDep, caller: Registrar) -> dict[str, Any]:
    """One scene."""
    with database.reading() as connection:
        scene = scenes.visible_scene(connection, caller, scene_id)
    return _scene(scene)


@router.delete("/scenes/{scene_id}", status_code=status.HTTP_204_NO_CONTENT)
def remove_scene(
    scene_id: UUID,
    database: DatabaseDep,
    storage: StorageDep,
    caller: Registrar,
    after_commit: BackgroundTasks,
) -> None:
    """Remove the files of a scene; its record, its jobs and their results stay."""
    with database.transaction() as connection:
        scenes.remove_scene(connection, caller, scene_id)
    after_commit.add_task(scenes.delete_files, storage, scene_id)


def _scene(scene: SceneRow) -> dict[str, Any]:
    return {
        "id": scene.id,
        "name": scene.name,
        "state": scene.state,
        "file": scene.file_name,
        "models": sorted(scene.models) if scene.state != "removed" else [],
        "size_bytes": scene.size_bytes,
        "sha256": scene.sha256,
        "sigma_m": scene.sigma_m,
        "sensor": scene.sensor,
        "acquired": scene.acquired_at,
        "gsd_m": scene.gsd_m,
        "footprint": scene.footprint,
        "created": scene.created_at,
        "removed": scene.removed_at,
    }


def _sent_file(request: Request, name: str | None) -> SentFile:
    if not name:
        raise InputError("the file has no name: send ?name= or Content-Disposition")
    length = request.headers.get("content-length", "")
    return SentFile(
        name=name,
        chunks=body_chunks(request),
        size_bytes=int(length) if length.isdigit() else None,
        sha256=_announced_sha256(request),
    )


def _disposition_name(request: Request) -> str | None:
    """The file name of `Content-Disposition`, plain or encoded (RFC 6266)."""
    message = Message()
    message["Content-Disposition"] = request.headers.get("content-disposition", "")
    return message.get_filename()


def _announced_sha256(request: Request) -> str | None:
    """The checksum the sender announces, in hexadecimal.

    Raises:
        InputError: there is one, but not a SHA-256.
    """
    plain = request.headers.get("x-checksum")
    if plain is not None:
        if not re.fullmatch(r"[0-9a-fA-F]{64}", plain):
            raise InputError("X-Checksum is not a SHA-256 in hexadecimal")
        return plain.lower()
    digest = request.headers.get("repr-digest", "")
    found = re.search(r"(?:^|,)\s*sha-256=:([A-Za-z0-9+/=]*):", digest)
    if found is None:
        return None
    try:
        raw = b64decode(found[1], validate=True)
    except ValueError:
        raw = b""
    if len(raw) != 32:
        raise InputError("the sha-256 of Repr-Digest is not the base64 of 32 bytes")
    return raw.hex()
