"""Scenes: upload, registration of scenes on the server, lists, files, removal."""

import re
from base64 import b64decode
from collections.abc import Sequence
from email.message import Message
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, BackgroundTasks, Query, Request, Response, status
from pydantic import BaseModel, Field

from amers.app.api.body import BINARY_BODY, announced_length
from amers.app.api.conditions import is_conditional, refuse_change
from amers.app.api.deps import (
    DatabaseDep,
    InstallationDep,
    Registrar,
    SettingsDep,
    StorageDep,
    UploadTurn,
)
from amers.app.api.files import file_reply, validators
from amers.app.api.models import scenes as models
from amers.app.api.models.base import Link, stated_accuracy
from amers.app.api.models.scenes import Scene, Scenes, StoredFile
from amers.app.api.negotiation import JSON
from amers.app.api.routes import CallerRoute
from amers.app.api.sent_body import sent_chunks
from amers.app.db.scene_registrations import SceneRegistration
from amers.app.db.scenes import SceneRow
from amers.app.db.tokens import Token
from amers.app.errors import InputError, NotFound
from amers.app.usecases import scenes
from amers.app.usecases.features.stac import scene_media_type
from amers.app.usecases.installation import Installation
from amers.app.usecases.scenes import SentFile

router = APIRouter(tags=["scenes"], route_class=CallerRoute)

MOST_LISTED = 1000
REGISTRATIONS_SHOWN = 20


class SceneOnServer(BaseModel):
    """A scene that lies on the server."""

    path: str = Field(
        min_length=1,
        max_length=1000,
        description="Path of the image below AMERS_SCENE_FOLDER; its model lies beside it.",
    )
    sigma_m: float | None = Field(
        default=None, gt=0, allow_inf_nan=False, description="Accuracy of its model, metres (1 sigma)."
    )


@router.post(
    "/scenes",
    status_code=status.HTTP_201_CREATED,
    dependencies=[UploadTurn],
    openapi_extra={"requestBody": BINARY_BODY},
)
def upload_scene(
    *,
    request: Request,
    response: Response,
    installation: InstallationDep,
    caller: Registrar,
    name: Annotated[str | None, Query(description="Name of the file.")] = None,
    sigma_m: Annotated[
        float | None,
        Query(gt=0, allow_inf_nan=False, description="Accuracy of its model, metres (1 sigma)."),
    ] = None,
) -> Scene:
    """Upload the image of a scene as the body of the request: GeoTIFF, JPEG 2000 or NITF.

    The name is in the query or in `Content-Disposition`. A checksum in `Repr-Digest` (sha-256) or
    `X-Checksum` (sha256 in hexadecimal) is compared with the file. Upload the files of its model next,
    by `PUT /scenes/{id}/files/{name}`.
    """
    sent = _sent_file(request, installation, caller, name or _disposition_name(request))
    row = scenes.upload_scene(installation, caller, sent, sigma_m)
    response.headers["Location"] = str(request.url_for("show_scene", scene_id=row.id))
    return _scene(row)


@router.put(
    "/scenes/{scene_id}/files/{name}",
    dependencies=[UploadTurn],
    openapi_extra={"requestBody": BINARY_BODY},
)
def upload_beside(
    *,
    scene_id: UUID,
    name: str,
    request: Request,
    installation: InstallationDep,
    caller: Registrar,
) -> StoredFile:
    """Upload a side file of a scene: model, terrain, mask or check points.

    With `If-Match` it replaces the file that has this tag alone, with `If-None-Match: *` none.
    """
    if is_conditional(request):
        refuse_change(request, _stored(installation, caller, scene_id, name))
    sent = _sent_file(request, installation, caller, name)
    stored = scenes.upload_side_file(installation, caller, scene_id, sent)
    return StoredFile(
        name=stored.key.rsplit("/", 1)[1], size_bytes=stored.size_bytes, sha256=stored.sha256
    )


@router.get("/scenes/{scene_id}/files/{name}", response_class=Response)
def download_file(
    *,
    scene_id: UUID,
    name: str,
    request: Request,
    database: DatabaseDep,
    storage: StorageDep,
    caller: Registrar,
) -> Response:
    """Return the image or a side file of a scene as it was uploaded."""
    with database.reading() as connection:
        key = scenes.file_key(connection, caller, scene_id, name)
    return file_reply(request, storage, key, scene_media_type(name))


@router.post("/scenes/reference", status_code=status.HTTP_201_CREATED)
def refer_to_scene(
    *,
    body: SceneOnServer,
    request: Request,
    response: Response,
    database: DatabaseDep,
    settings: SettingsDep,
    caller: Registrar,
) -> Scene:
    """Add a scene that lies on the server, below the folder AMERS_SCENE_FOLDER."""
    with database.transaction() as connection:
        row = scenes.add_server_scene(connection, settings, caller, body.path, body.sigma_m)
    response.headers["Location"] = str(request.url_for("show_scene", scene_id=row.id))
    return _scene(row)


@router.get("/scenes")
def list_scenes(
    *,
    request: Request,
    database: DatabaseDep,
    caller: Registrar,
    limit: Annotated[int, Query(ge=1, le=MOST_LISTED, description="Number of scenes on a page.")] = 100,
    after: Annotated[UUID | None, Query(description="From the link `next`.")] = None,
) -> Scenes:
    """List the scenes of the caller, newest first; administrators see all scenes."""
    with database.reading() as connection:
        listed = scenes.list_scenes(connection, caller, limit + 1, after)
        page = listed[:limit]
        last = scenes.registrations_of(connection, caller, page, 1)
    links = [Link(rel="self", href=str(request.url), type=JSON)]
    if len(listed) > limit:
        following = str(request.url.include_query_params(after=page[-1].id))
        links.append(Link(rel="next", href=following, type=JSON))
    return Scenes(scenes=[_scene(row, last.get(row.id, ())) for row in page], links=links)


@router.get("/scenes/{scene_id}")
def show_scene(*, scene_id: UUID, database: DatabaseDep, caller: Registrar) -> Scene:
    """Return one scene."""
    with database.reading() as connection:
        row = scenes.visible_scene(connection, caller, scene_id)
        last = scenes.registrations_of(connection, caller, [row], REGISTRATIONS_SHOWN)
    return _scene(row, last.get(row.id, ()))


@router.delete("/scenes/{scene_id}", status_code=status.HTTP_204_NO_CONTENT)
def remove_scene(
    *,
    scene_id: UUID,
    database: DatabaseDep,
    storage: StorageDep,
    caller: Registrar,
    after_commit: BackgroundTasks,
) -> None:
    """Remove the files of a scene; its record, its jobs and their results stay."""
    storage.prove()
    with database.transaction() as connection:
        scenes.remove_scene(connection, caller, scene_id)
    after_commit.add_task(scenes.delete_files, storage, scene_id)


def _scene(row: SceneRow, registrations: Sequence[SceneRegistration] = ()) -> Scene:
    return Scene(
        id=row.id,
        name=row.name,
        state=row.state,
        file=row.file_name,
        models=sorted(row.models) if row.state != "removed" else [],
        size_bytes=row.size_bytes,
        sha256=row.sha256,
        sigma_m=row.sigma_m,
        sensor=row.sensor,
        acquired=row.acquired_at,
        gsd_m=row.gsd_m,
        footprint=row.footprint,
        created=row.created_at,
        removed=row.removed_at,
        registrations=[_registration(one) for one in registrations],
    )


def _registration(row: SceneRegistration) -> models.SceneRegistration:
    return models.SceneRegistration(
        job=row.job_id,
        process=row.process,
        outcome=row.outcome,
        verdict=row.verdict,
        relative_to_control_points=stated_accuracy(row.relative_to_control_points),
        on_the_earth=stated_accuracy(row.on_the_earth),
        created=row.created_at,
        finished=row.finished_at,
    )


def _stored(
    installation: Installation, caller: Token, scene_id: UUID, name: str
) -> dict[str, str] | None:
    """The validators of a file of a scene; None without such a file."""
    try:
        with installation.database.reading() as connection:
            key = scenes.file_key(connection, caller, scene_id, name)
        return validators(key, installation.storage.state(key))
    except NotFound:
        return None


def _sent_file(
    request: Request, installation: Installation, caller: Token, name: str | None
) -> SentFile:
    if not name:
        raise InputError("the file has no name: send ?name= or the header Content-Disposition")
    return SentFile(
        name=name,
        chunks=sent_chunks(request, installation.database, caller),
        size_bytes=announced_length(request),
        sha256=_announced_sha256(request),
    )


def _disposition_name(request: Request) -> str | None:
    """The file name of `Content-Disposition`, plain or encoded (RFC 6266)."""
    message = Message()
    message["Content-Disposition"] = request.headers.get("content-disposition", "")
    return message.get_filename()


def _announced_sha256(request: Request) -> str | None:
    """The SHA-256 in the headers of an upload, in hexadecimal; None without one.

    Raises:
        InputError: the header is not a SHA-256.
    """
    plain = request.headers.get("x-checksum")
    if plain is not None:
        if not re.fullmatch(r"[0-9a-fA-F]{64}", plain):
            raise InputError("X-Checksum: not a SHA-256 in hexadecimal, 64 digits")
        return plain.lower()
    digest = request.headers.get("repr-digest", "")
    match = re.search(r"(?:^|,)\s*sha-256=:([A-Za-z0-9+/=]*):", digest)
    if match is None:
        return None
    try:
        raw = b64decode(match[1], validate=True)
    except ValueError:
        raw = b""
    if len(raw) != 32:
        raise InputError("Repr-Digest: its sha-256 is not the base64 of 32 bytes")
    return raw.hex()
