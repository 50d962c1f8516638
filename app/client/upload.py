"""Resumable uploads by the protocol tus 1.0: after a break, only the bytes that are missing are sent."""

import time
from base64 import b64encode
from collections.abc import Iterator
from pathlib import Path

from .connection import CHUNK_BYTES, Connection
from .errors import RequestRefused, ServiceFailure
from .job import Progress

TUS = {"Tus-Resumable": "1.0.0"}
PIECE = "application/offset+octet-stream"
BREAKS = (409, 423)
"""Statuses after a break: bytes of the broken connection arrived since, or are still arriving."""
MOST_BREAKS = 5
"""Breaks after which an upload is given up when no byte arrived between them."""
PAUSE_S = 1.0


def upload_image(connection: Connection, path: Path, sigma_m: float | None, progress: Progress) -> str:
    """Upload the image of a scene; returns the id of the scene.

    Raises:
        RequestRefused: the service refuses the image.
        ServiceFailure: the service does not answer, or the connection broke again and again.
    """
    size = path.stat().st_size
    metadata = {"filename": path.name, **({} if sigma_m is None else {"sigma_m": str(sigma_m)})}
    pairs = (f"{name} {b64encode(value.encode()).decode()}" for name, value in metadata.items())
    headers = {**TUS, "Upload-Length": str(size), "Upload-Metadata": ",".join(pairs)}
    created = connection.request("POST", "uploads", headers=headers)
    place = f"uploads/{created.headers['Location'].rsplit('/', 1)[1]}"
    arrived = breaks = 0
    while True:
        try:
            offset = int(connection.request("HEAD", place, headers=TUS).headers["Upload-Offset"])
            if offset > arrived:
                arrived, breaks = offset, 0
            connection.request(
                "PATCH",
                place,
                content=_rest(path, offset, size, progress),
                headers={
                    **TUS,
                    "Content-Type": PIECE,
                    "Content-Length": str(size - offset),
                    "Upload-Offset": str(offset),
                },
            )
            return str(created.headers["Amers-Scene"])
        except (RequestRefused, ServiceFailure) as error:
            breaks += 1
            if breaks > MOST_BREAKS or (
                isinstance(error, RequestRefused) and error.status not in BREAKS
            ):
                raise
        time.sleep(PAUSE_S)


def _rest(path: Path, offset: int, size: int, progress: Progress) -> Iterator[bytes]:
    """The bytes of a file from an offset on."""
    with path.open("rb") as file:
        file.seek(offset)
        while chunk := file.read(CHUNK_BYTES):
            yield chunk
            progress(file.tell() / size, "uploading")
