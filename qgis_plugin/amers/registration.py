"""Register an image by a service: upload it with its model, wait for the job, download the results."""

from __future__ import annotations

import time
from base64 import b64encode
from pathlib import Path
from typing import Any, Callable

from osgeo import gdal

from .service import Service, ServiceError

POLL_S = 1.0
PIECE_BYTES = 8 << 20
"""Size of the pieces of an upload, between which progress is shown and a cancellation noticed."""
MOST_BREAKS = 5
"""Breaks after which an upload is given up when no byte arrived between them."""
BREAKS = (0, 409, 423)
"""Status of a broken connection: no reply, a piece that QGIS sent again, one that still arrives."""
PAUSE_S = 1.0
UPLOAD_PERCENT = 20.0
"""Share of the upload in the progress of a registration."""
MODEL_SUFFIXES = (".txt", ".rpb", ".xml", ".dim", ".imd")
RESULTS = ("residuals.gpkg", "refined_RPC.TXT", "report.html", "report.json")
TUS = {"Tus-Resumable": "1.0.0"}

Progress = Callable[[float], None]
"""Receives the completed part, percent; raises Canceled when the user has cancelled the work."""


class Canceled(Exception):
    """The user has cancelled the work."""


def register(service: Service, image: Path, sigma_m: float | None, progress: Progress) -> Path:
    """Register an image; returns the folder beside it that receives the results.

    Args:
        service: that registers it.
        image: GeoTIFF, JPEG 2000 or NITF; the files of its model lie beside it.
        sigma_m: accuracy of its model, metres (1 sigma); None: as the model states.
        progress: receives the completed part, percent.

    Raises:
        ServiceError: the service refuses it, or the registration failed.
        Canceled: the job is dismissed.
    """
    models = model_files(image)
    scene = _upload(service, image, sigma_m, progress)
    for path in models:
        service.put(f"scenes/{scene}/files/{path.name}", path.read_bytes())
    job = service.execute("register-scene", {"scene": scene})
    try:
        while job["status"] in ("accepted", "running"):
            time.sleep(POLL_S)
            job = service.get(f"jobs/{job['jobID']}")
            progress(UPLOAD_PERCENT + (100.0 - UPLOAD_PERCENT) * job["progress"] / 100.0)
    except Canceled:
        service.dismiss(job["jobID"])
        raise
    if job["status"] != "successful":
        raise ServiceError(f"{image.name} was not registered: {job['message']}")
    return _download(service, image, job["jobID"])


def last_registration(service: Service, image: Path) -> Path:
    """Download the results of the last registration of an image; returns the folder beside it.

    Raises:
        ServiceError: the service has no registered scene of this name.
    """
    for scene in service.get("scenes?limit=1000")["scenes"]:
        for last in scene["registrations"] if scene["name"] == image.name else ():
            if (last["process"], last["outcome"]) == ("register-scene", "registered"):
                return _download(service, image, last["job"])
    raise ServiceError(f"{service.url} has no registered scene with the name {image.name}")


def model_files(image: Path) -> list[Path]:
    """The files of the model beside an image, as GDAL finds them.

    Raises:
        ServiceError: GDAL cannot open the image.
    """
    dataset = gdal.Open(str(image))
    if dataset is None:
        raise ServiceError(f"{image} cannot be opened")
    paths = [Path(name) for name in dataset.GetFileList() or () if Path(name) != image]
    names = ((path, path.name.lower()) for path in paths)
    return [
        path for path, name in names if name.endswith(MODEL_SUFFIXES) and not name.endswith(".aux.xml")
    ]


def _upload(service: Service, image: Path, sigma_m: float | None, progress: Progress) -> str:
    """Send an image in pieces by tus 1.0; returns the id of the scene.

    After a break, the service says how much has arrived, and only the rest is sent.
    """
    size = image.stat().st_size
    values = {"filename": image.name, **({} if sigma_m is None else {"sigma_m": str(sigma_m)})}
    pairs = (f"{name} {b64encode(value.encode()).decode()}" for name, value in values.items())
    headers = {**TUS, "Upload-Length": str(size), "Upload-Metadata": ",".join(pairs)}
    created = service.post("uploads", b"", headers)
    place = "uploads/" + created["location"].rsplit("/", 1)[1]
    arrived = breaks = 0
    is_complete = False
    with image.open("rb") as file:
        while not is_complete:
            try:
                offset = int(service.head(place, TUS)["upload-offset"])
                if offset < arrived:
                    raise ServiceError(f"the service has lost a part of {image.name} that it had")
                if offset > arrived:
                    arrived, breaks = offset, 0
                file.seek(offset)
                piece = file.read(PIECE_BYTES)
                # After a break, an empty piece completes a file whose bytes have all arrived.
                _send_piece(service, place, offset, piece)
                arrived, breaks = offset + len(piece), 0
                is_complete = arrived == size
            except ServiceError as error:
                breaks += 1
                if breaks > MOST_BREAKS or error.status not in BREAKS:
                    raise
                time.sleep(PAUSE_S)
            progress(UPLOAD_PERCENT * arrived / size)
    return created["amers-scene"]


def _send_piece(service: Service, place: str, offset: int, content: bytes) -> None:
    headers = {
        **TUS,
        "X-HTTP-Method-Override": "PATCH",
        "Content-Type": "application/offset+octet-stream",
        "Upload-Offset": str(offset),
    }
    service.post(place, content, headers)


def _download(service: Service, image: Path, job: str) -> Path:
    """Download the results of a registration into a folder beside its image."""
    results: dict[str, Any] = service.get(f"jobs/{job}/results")
    folder = image.with_name(f"{image.stem}_registered_{job[:8]}")
    folder.mkdir(exist_ok=True)
    for name in RESULTS:
        target = folder / name
        # Results of a job never change, and QGIS may have the file open.
        if name in results and not target.exists():
            target.write_bytes(service.download(f"jobs/{job}/results/{name}"))
    return folder
