"""Files of the storage as replies: whole, or the ranges that a request asks for."""

import hashlib
from collections.abc import Iterator
from email.utils import formatdate

from fastapi import Request, Response
from fastapi.responses import StreamingResponse

from amers.app.api.conditions import may_send_range
from amers.app.api.disposition import disposition
from amers.app.api.error_responses import problem
from amers.app.api.methods import HEAD
from amers.app.api.ranges import Part, content_range, multipart, wanted_ranges
from amers.app.errors import DamagedFile
from amers.app.storage import FileState, Storage
from amers.app.usecases.damage import named_by_row

PIECE_BYTES = 1 << 20
PAGE_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"
"""A report may show its own images and styles, and nothing else."""
HEADERS = {
    "Accept-Ranges": "bytes",
    "Content-Security-Policy": PAGE_POLICY,
    "X-Content-Type-Options": "nosniff",
}


def file_reply(
    request: Request, storage: Storage, key: str, media_type: str, name: str | None = None
) -> Response:
    """A file that a row names, or its ranges, streamed from a folder and from a bucket alike.

    Args:
        name: under which a browser keeps it; by default the last part of the key.

    Raises:
        DamagedFile: there is no such file.
    """
    with named_by_row(key):
        state = storage.state(key)
    size = state.size_bytes
    if media_type.startswith("text/"):
        media_type += "; charset=utf-8"
    headers = {**HEADERS, **validators(key, state), "Content-Type": media_type}
    headers["Content-Disposition"] = disposition(name or key.rpartition("/")[2], media_type)
    ranges = None
    # The standard defines ranges for GET alone.
    if HEAD not in request.scope and may_send_range(request.headers, headers):
        ranges = wanted_ranges(request.headers.get("range"), size)
    if ranges is None:
        return _reply(storage, key, 200, headers, [Part(b"", 0, size)])
    if not ranges:
        detail = f"Range: {request.headers['range']:.100}: the file has {size} bytes"
        told = validators(key, state) | {"Content-Range": f"bytes */{size}"}
        return problem(416, detail, headers=told)
    if len(ranges) > 1:
        headers["Content-Type"], parts = multipart(ranges, size, media_type)
        return _reply(storage, key, 206, headers, parts)
    headers["Content-Range"] = content_range(*ranges[0], size)
    return _reply(storage, key, 206, headers, [Part(b"", *ranges[0])])


def validators(key: str, state: FileState) -> dict[str, str]:
    """The headers that tell a client whether a file is the one it has."""
    tag = hashlib.sha256(f"{key} {state.version}".encode()).hexdigest()[:32]
    return {"ETag": f'"{tag}"', "Last-Modified": formatdate(state.modified_s, usegmt=True)}


def _reply(
    storage: Storage, key: str, status: int, headers: dict[str, str], parts: list[Part]
) -> Response:
    length = sum(len(part.head) + part.end - part.start for part in parts)
    headers = headers | {"Content-Length": str(length)}
    return StreamingResponse(_pieces(storage, key, parts), status, headers)


def _pieces(storage: Storage, key: str, parts: list[Part]) -> Iterator[bytes]:
    reader = storage.reader(key)
    try:
        for part in parts:
            if part.head:
                yield part.head
            at = part.start
            while at < part.end:
                piece = reader.read(at, min(PIECE_BYTES, part.end - at))
                if not piece:
                    raise DamagedFile(key, f"ends at byte {at}, while it is read")
                at += len(piece)
                yield piece
    finally:
        reader.close()
