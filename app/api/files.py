"""Files of the storage as replies."""

from collections.abc import Iterator

from fastapi import Response
from fastapi.responses import FileResponse, StreamingResponse

from app.storage import Storage
from app.usecases.damage import named_by_row

PIECE_BYTES = 1 << 20
PAGE_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"
"""A report may show its own images and styles, and nothing else."""
HEADERS = {"X-Content-Type-Options": "nosniff", "Content-Security-Policy": PAGE_POLICY}


def file_reply(storage: Storage, key: str, media_type: str) -> Response:
    """A file that a row names, streamed; requests for ranges work if it lies on this machine.

    Raises:
        DamagedFile: there is no such file.
    """
    with named_by_row(key):
        path = storage.local(key)
        if path is not None:
            return FileResponse(path, media_type=media_type, headers=HEADERS)
        length = {"Content-Length": str(storage.size(key))}
    return StreamingResponse(_pieces(storage, key), media_type=media_type, headers=HEADERS | length)


def _pieces(storage: Storage, key: str) -> Iterator[bytes]:
    with storage.open(key) as file:
        while piece := file.read(PIECE_BYTES):
            yield piece
