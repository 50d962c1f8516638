"""Uploads that can be resumed, as tus 1.0 has them: creation, termination, checksum, expiration."""

import hashlib
import re
from base64 import b64decode
from email.utils import format_datetime
from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Depends, Header, Request, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from app.api.body import body_chunks
from app.api.deps import (
    DatabaseDep,
    Registrar,
    SettingsDep,
    StorageDep,
    UploadTurn,
)
from app.api.error_responses import problem
from app.db.uploads import UploadRow
from app.errors import InputError
from app.usecases import uploads
from app.usecases.installation import Installation
from app.usecases.uploads import Busy, Checksum, NewUpload, Piece, WrongChecksum

VERSION = "1.0.0"
PIECE = "application/offset+octet-stream"
ALGORITHMS = ("sha1", "sha256")
EXTENSIONS = "creation,termination,checksum,expiration"
LOCKED, CHECKSUM_MISMATCH = 423, 460
TUS = {"Tus-Resumable": VERSION, "Cache-Control": "no-store"}
PIECE_BODY = {"content": {PIECE: {"schema": {"type": "string", "format": "binary"}}}}

Size = Annotated[int, Header(ge=0)]


async def _version(tus_resumable: Annotated[str | None, Header()] = None) -> None:
    if tus_resumable != VERSION:
        told = {"Tus-Version": VERSION}
        raise HTTPException(412, f"Tus-Resumable: this is tus {VERSION}, not {tus_resumable}", told)


Version = Depends(_version)
router = APIRouter(prefix="/uploads", tags=["uploads"])


@router.options("", status_code=204)
def capabilities(settings: SettingsDep) -> Response:
    """What of tus is spoken here."""
    told = {
        "Tus-Version": VERSION,
        "Tus-Max-Size": str(settings.upload_limit_bytes),
        "Tus-Extension": EXTENSIONS,
        "Tus-Checksum-Algorithm": ",".join(ALGORITHMS),
    }
    return Response(status_code=204, headers=TUS | told)


@router.post("", status_code=201, dependencies=[Version])
def create(
    request: Request,
    database: DatabaseDep,
    storage: StorageDep,
    settings: SettingsDep,
    caller: Registrar,
    upload_length: Size,
    upload_metadata: Annotated[str, Header(max_length=4000)] = "",
) -> Response:
    """Begin an upload.

    `Upload-Metadata` says `filename`, and may say `sha256` of the whole file in hexadecimal, `sigma_m`,
    `purpose` (image, model or block), and for a model the id of its `scene`. The header `Amers-Scene` of
    the reply is the scene.
    """
    new = _announced(upload_length, upload_metadata)
    with database.transaction() as connection:
        upload = uploads.create_upload(connection, storage, settings, caller, new)
    place = {"Location": f"{request.base_url}uploads/{upload.id}"}
    return Response(status_code=201, headers=_headers(upload) | place)


@router.head("/{upload_id}", dependencies=[Version])
def ask(upload_id: UUID, database: DatabaseDep, storage: StorageDep, caller: Registrar) -> Response:
    """How much has arrived."""
    with database.reading() as connection:
        upload = uploads.find_upload(connection, caller, upload_id)
    told = {
        "Upload-Offset": str(uploads.received_bytes(storage, upload)),
        "Upload-Length": str(upload.size_bytes),
        **({"Upload-Metadata": upload.metadata} if upload.metadata else {}),
    }
    return Response(headers=_headers(upload) | told)


@router.get("/{upload_id}")
def show(
    upload_id: UUID, database: DatabaseDep, storage: StorageDep, caller: Registrar
) -> dict[str, Any]:
    """An upload, for those who do not speak tus."""
    with database.reading() as connection:
        upload = uploads.find_upload(connection, caller, upload_id)
    return {
        "id": upload.id,
        "state": "arriving" if upload.finished_at is None else "finished",
        "purpose": upload.purpose,
        "name": upload.name,
        "offset": uploads.received_bytes(storage, upload),
        "size_bytes": upload.size_bytes,
        "scene": upload.scene_id,
        "created": upload.created_at,
        "expires": upload.expires_at if upload.finished_at is None else None,
    }


@router.patch(
    "/{upload_id}",
    status_code=204,
    dependencies=[Version, UploadTurn],
    openapi_extra={"requestBody": PIECE_BODY},
)
def send(
    upload_id: UUID,
    request: Request,
    database: DatabaseDep,
    storage: StorageDep,
    settings: SettingsDep,
    caller: Registrar,
    upload_offset: Size,
    content_type: Annotated[str, Header()] = "",
    upload_checksum: Annotated[str | None, Header()] = None,
) -> Response:
    """Send the next piece; with the last one the file takes its place, or is refused and forgotten."""
    if content_type.lower() != PIECE:
        raise HTTPException(415, f"Content-Type: {content_type!r} is not {PIECE}")
    checksum = None if upload_checksum is None else _checksum(upload_checksum)
    with database.reading() as connection:
        upload = uploads.find_upload(connection, caller, upload_id)
    if upload.finished_at is not None and upload_offset == upload.size_bytes:
        return Response(
            status_code=204, headers=_headers(upload) | {"Upload-Offset": str(upload_offset)}
        )
    try:
        piece = Piece(upload_offset, body_chunks(request), checksum)
        arrived = uploads.append_piece(Installation(database, storage, settings), upload, piece)
    except Busy as busy:
        return problem(LOCKED, str(busy), headers=TUS)
    except WrongChecksum as wrong:
        return problem(CHECKSUM_MISMATCH, str(wrong), title="Checksum Mismatch", headers=TUS)
    except ClientDisconnect:
        return problem(400, "the line broke; what has arrived is kept", headers=TUS)
    return Response(status_code=204, headers=_headers(upload) | {"Upload-Offset": str(arrived)})


@router.delete("/{upload_id}", status_code=204, dependencies=[Version])
def end(upload_id: UUID, database: DatabaseDep, storage: StorageDep, caller: Registrar) -> Response:
    """End an upload that is not complete; what has arrived of it is forgotten."""
    with database.transaction() as connection:
        uploads.terminate_upload(connection, storage, uploads.find_upload(connection, caller, upload_id))
    return Response(status_code=204, headers=TUS)


def _headers(upload: UploadRow) -> dict[str, str]:
    return {
        **TUS,
        **({"Upload-Expires": format_datetime(upload.expires_at)} if not upload.finished_at else {}),
        **({"Amers-Scene": str(upload.scene_id)} if upload.scene_id else {}),
    }


def _announced(size_bytes: int, metadata: str) -> NewUpload:
    """What the sender says about the file.

    Raises:
        InputError: a value is missing or not what it should be; the message names it.
    """
    said = dict(_pair(part) for part in metadata.split(",") if part.strip())
    if size_bytes == 0:
        raise InputError("Upload-Length: an empty file is of no use")
    if not said.get("filename"):
        raise InputError("Upload-Metadata: filename is missing")
    purpose = next((one for one in uploads.PURPOSES if one == said.get("purpose")), None)
    if purpose is None and "purpose" in said:
        raise InputError(f"Upload-Metadata: purpose is one of {', '.join(uploads.PURPOSES)}")
    sha256 = said.get("sha256")
    if sha256 is not None and not re.fullmatch(r"[0-9a-fA-F]{64}", sha256):
        raise InputError("Upload-Metadata: sha256 is not a SHA-256 in hexadecimal")
    try:
        scene = UUID(said["scene"]) if said.get("scene") else None
        sigma_m = float(said["sigma_m"]) if said.get("sigma_m") else None
    except ValueError as error:
        raise InputError(f"Upload-Metadata: scene or sigma_m: {error}") from None
    if sigma_m is not None and not 0.0 < sigma_m < float("inf"):
        raise InputError(f"Upload-Metadata: sigma_m is {sigma_m}, not a positive number of metres")
    return NewUpload(
        name=said["filename"],
        size_bytes=size_bytes,
        purpose=purpose,
        scene=scene,
        sha256=sha256.lower() if sha256 else None,
        sigma_m=sigma_m,
        metadata=metadata,
    )


def _pair(part: str) -> tuple[str, str]:
    """A name and a value in base64, which may be missing."""
    name, _, value = part.strip().partition(" ")
    try:
        return name, b64decode(value.strip(), validate=True).decode()
    except ValueError:
        raise InputError(f"Upload-Metadata: {name[:50]} is not base64 of UTF-8") from None


def _checksum(said: str) -> Checksum:
    algorithm, _, value = said.partition(" ")
    try:
        digest = b64decode(value.strip(), validate=True)
    except ValueError:
        digest = b""
    if algorithm not in ALGORITHMS or len(digest) != hashlib.new(algorithm).digest_size:
        raise HTTPException(400, f"Upload-Checksum: one of {', '.join(ALGORITHMS)} and its base64", TUS)
    return Checksum(algorithm, digest)
