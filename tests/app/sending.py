"""Resumable uploads as their senders make them, by the protocol tus."""

import io
import zipfile
from base64 import b64encode
from collections.abc import Mapping

import httpx

from tests.app.callers import Caller

TUS = {"Tus-Resumable": "1.0.0"}
PIECE = {"Content-Type": "application/offset+octet-stream"}


def said(**values: str) -> dict[str, str]:
    """The `Upload-Metadata` header of a file."""
    pairs = (f"{name} {b64encode(value.encode()).decode()}" for name, value in values.items())
    return {"Upload-Metadata": ",".join(pairs)}


def begun(me: Caller, size: int, **values: str) -> httpx.Response:
    """The reply to the announcement of an upload."""
    return (me | TUS | {"Upload-Length": str(size)} | said(**values)).post("/uploads")


def piece(me: Caller, url: str, start: int, data: bytes, **more: str) -> httpx.Response:
    """The reply to a piece of an upload."""
    return (me | TUS | PIECE | {"Upload-Offset": str(start)} | more).patch(url, content=data)


def whole(me: Caller, data: bytes, **values: str) -> httpx.Response:
    """The reply to the only piece of an upload."""
    reply = begun(me, len(data), **values)
    assert reply.status_code == 201, reply.text
    return piece(me, reply.headers["location"], 0, data)


def zipped(files: Mapping[str, bytes]) -> bytes:
    """An archive of files."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return out.getvalue()
