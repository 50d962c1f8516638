"""Resumable uploads by the protocol tus 1.0 with creation, termination, checksum and expiration."""

import hashlib
import re
from base64 import b64decode
from email.utils import format_datetime
from typing import Annotated
from uuid import UUID

from fastapi import APIRouter, Depends, Header, Request, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from amers.app.api.access import FURTHER_SCOPES, Public
from amers.app.api.deps import (
    DatabaseDep,
    InstallationDep,
    Registrar,
    SettingsDep,
    StorageDep,
    UploadTurn,
)
from amers.app.api.error_responses import problem
from amers.app.api.models.scenes import Upload
from amers.app.api.routes import CallerRoute
from amers.app.api.sent_body import sent_chunks
from amers.app.api.tus import VERSION
from amers.app.db.uploads import UploadRow
from amers.app.errors import InputError
from amers.app.usecases import uploads
from amers.app.usecases.uploads import Busy, Checksum, NewUpload, Piece, WrongChecksum

PIECE = "application/offset+octet-stream"
ALGORITHMS = ("sha1", "sha256")
EXTENSIONS = "creation,termination,checksum,expiration"
UNSUPPORTED = {"Upload-Concat": "concatenation", "Upload-Defer-Length": "creation-defer-length"}
"""Headers that ask for what the service does not do; an ordinary upload instead would mislead."""
LOCKED, CHECKSUM_MISMATCH = 423, 460
TUS = {"Tus-Resumable": VERSION, "Cache-Control": "no-store"}
PIECE_BODY = {"content": {PIECE: {"schema": {"type": "string", "format": "binary"}}}}

Size = Annotated[int, Header(ge=0)]


async def _version(request: Request, tus_resumable: Annotated[str | None, Header()] = None) -> None:
    if tus_resumable != VERSION:
        detail = f"Tus-Resumable: {tus_resumable} found, {VERSION} expected"
        raise HTTPException(412, detail, {"Tus-Version": VERSION})
    for header, extension in UNSUPPORTED.items():
        if header in request.headers:
            detail = f"{header}: this service has no tus extension {extension}, only {EXTENSIONS}"
            raise HTTPException(400, detail, {"Tus-Extension": EXTENSIONS})


Version = Depends(_version)
router = APIRouter(prefix="/uploads", tags=["uploads"], route_class=CallerRoute)


@router.options("/{upload_id}", status_code=204, dependencies=[Public], include_in_schema=False)
@router.options("", status_code=204, dependencies=[Public])
def capabilities(*, settings: SettingsDep) -> Response:
    """Return the version and the extensions of tus that the service supports."""
    headers = {
        "Tus-Version": VERSION,
        "Tus-Max-Size": str(settings.upload_limit_bytes),
        "Tus-Extension": EXTENSIONS,
        "Tus-Checksum-Algorithm": ",".join(ALGORITHMS),
    }
    return Response(status_code=204, headers=TUS | headers)


@router.post(
    "",
    status_code=201,
    dependencies=[Version],
    openapi_extra={FURTHER_SCOPES: ["admin"]},
)
def create(
    *,
    request: Request,
    database: DatabaseDep,
    storage: StorageDep,
    settings: SettingsDep,
    caller: Registrar,
    upload_length: Size,
    upload_metadata: Annotated[str, Header(max_length=4000)] = "",
) -> Response:
    """Create an upload.

    `Upload-Metadata` needs `filename`. It may have `sha256` of the whole file in hexadecimal, `sigma_m`,
    `purpose` (image, model or block), and for a model the id of its `scene`. The header `Amers-Scene` of
    the reply is the id of the scene.
    """
    new = _new_upload(upload_length, upload_metadata)
    storage.prove()
    with database.transaction() as connection:
        upload = uploads.create_upload(connection, storage, settings, caller, new)
    location = {"Location": f"{request.base_url}uploads/{upload.id}"}
    return Response(status_code=201, headers=_headers(upload) | location)


@router.head("/{upload_id}", dependencies=[Version])
def show_offset(
    *, upload_id: UUID, database: DatabaseDep, storage: StorageDep, caller: Registrar
) -> Response:
    """Return the number of bytes that have arrived, in the header `Upload-Offset`."""
    with database.reading() as connection:
        upload = uploads.find_upload(connection, caller, upload_id)
    headers = {
        "Upload-Offset": str(uploads.received_bytes(storage, upload)),
        "Upload-Length": str(upload.size_bytes),
        **({"Upload-Metadata": upload.metadata} if upload.metadata else {}),
    }
    return Response(headers=_headers(upload) | headers)


@router.get("/{upload_id}")
def show(*, upload_id: UUID, database: DatabaseDep, storage: StorageDep, caller: Registrar) -> Upload:
    """Return an upload, for clients without tus."""
    with database.reading() as connection:
        upload = uploads.find_upload(connection, caller, upload_id)
    return Upload(
        id=upload.id,
        state="arriving" if upload.finished_at is None else "finished",
        purpose=upload.purpose,
        name=upload.name,
        offset=uploads.received_bytes(storage, upload),
        size_bytes=upload.size_bytes,
        scene=upload.scene_id,
        created=upload.created_at,
        expires=upload.expires_at if upload.finished_at is None else None,
    )


@router.patch(
    "/{upload_id}",
    status_code=204,
    dependencies=[Version, UploadTurn],
    openapi_extra={"requestBody": PIECE_BODY},
)
def send(
    *,
    upload_id: UUID,
    request: Request,
    installation: InstallationDep,
    caller: Registrar,
    upload_offset: Size,
    content_type: Annotated[str, Header()] = "",
    upload_checksum: Annotated[str | None, Header()] = None,
) -> Response:
    """Append a piece; the last piece completes the file, which is then stored or refused."""
    if content_type.lower() != PIECE:
        raise HTTPException(415, f"Content-Type: {content_type!r} is not {PIECE}")
    checksum = None if upload_checksum is None else _checksum(upload_checksum)
    with installation.database.reading() as connection:
        upload = uploads.find_upload(connection, caller, upload_id)
    if upload.finished_at is not None and upload_offset == upload.size_bytes:
        return Response(
            status_code=204, headers=_headers(upload) | {"Upload-Offset": str(upload_offset)}
        )
    try:
        piece = Piece(upload_offset, sent_chunks(request, installation.database, caller), checksum)
        arrived = uploads.append_piece(installation, upload, piece)
    except Busy as busy:
        return problem(LOCKED, str(busy), headers=TUS)
    except WrongChecksum as wrong:
        return problem(CHECKSUM_MISMATCH, str(wrong), title="Checksum Mismatch", headers=TUS)
    except ClientDisconnect:
        return problem(400, "the connection broke; the bytes that arrived are stored", headers=TUS)
    return Response(status_code=204, headers=_headers(upload) | {"Upload-Offset": str(arrived)})


@router.delete("/{upload_id}", status_code=204, dependencies=[Version])
def terminate(
    *, upload_id: UUID, database: DatabaseDep, storage: StorageDep, caller: Registrar
) -> Response:
    """Terminate an upload that is not complete, and delete the bytes that have arrived."""
    storage.prove()
    with database.transaction() as connection:
        uploads.terminate_upload(connection, storage, uploads.find_upload(connection, caller, upload_id))
    return Response(status_code=204, headers=TUS)


def _headers(upload: UploadRow) -> dict[str, str]:
    return {
        **TUS,
        **({"Upload-Expires": format_datetime(upload.expires_at)} if not upload.finished_at else {}),
        **({"Amers-Scene": str(upload.scene_id)} if upload.scene_id else {}),
    }


def _new_upload(size_bytes: int, metadata: str) -> NewUpload:
    """The upload that the headers of its creation announce.

    Raises:
        InputError: a value is missing or cannot be used; the message names it.
    """
    values = dict(_pair(part) for part in metadata.split(",") if part.strip())
    if size_bytes == 0:
        raise InputError("Upload-Length: 0 found, the size of a file that is not empty expected")
    if not values.get("filename"):
        raise InputError("Upload-Metadata: filename is missing")
    purpose = next((name for name in uploads.PURPOSES if name == values.get("purpose")), None)
    if purpose is None and "purpose" in values:
        raise InputError(f"Upload-Metadata: purpose is one of {', '.join(uploads.PURPOSES)}")
    sha256 = values.get("sha256")
    if sha256 is not None and not re.fullmatch(r"[0-9a-fA-F]{64}", sha256):
        raise InputError("Upload-Metadata: sha256 is not a SHA-256 in hexadecimal")
    try:
        scene = UUID(values["scene"]) if values.get("scene") else None
        sigma_m = float(values["sigma_m"]) if values.get("sigma_m") else None
    except ValueError as error:
        raise InputError(f"Upload-Metadata: scene or sigma_m: {error}") from None
    if sigma_m is not None and not 0.0 < sigma_m < float("inf"):
        raise InputError(f"Upload-Metadata: sigma_m is {sigma_m}, not a positive number of metres")
    return NewUpload(
        name=values["filename"],
        size_bytes=size_bytes,
        purpose=purpose,
        scene=scene,
        sha256=sha256.lower() if sha256 else None,
        sigma_m=sigma_m,
        metadata=metadata,
    )


def _pair(part: str) -> tuple[str, str]:
    """Name and value of a part of `Upload-Metadata`; the value is in base64 and may be missing."""
    name, _, value = part.strip().partition(" ")
    try:
        return name, b64decode(value.strip(), validate=True).decode()
    except ValueError:
        raise InputError(f"Upload-Metadata: {name[:50]} is not base64 of UTF-8") from None


def _checksum(header: str) -> Checksum:
    algorithm, _, value = header.partition(" ")
    try:
        digest = b64decode(value.strip(), validate=True)
    except ValueError:
        digest = b""
    if algorithm not in ALGORITHMS or len(digest) != hashlib.new(algorithm).digest_size:
        raise HTTPException(
            400, f"Upload-Checksum: one of {', '.join(ALGORITHMS)} and its base64 expected", TUS
        )
    return Checksum(algorithm, digest)
