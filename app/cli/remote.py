"""Client of an Amers service: upload a scene, execute its registration, wait, download the results."""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.parse import quote

import httpx

from app.errors import AmersError, ComputationError, InputError
from app.usecases.registration.register import SceneFiles
from services import errors
from services.formats.images.scenes import model_files
from services.types import Progress

CHUNK_BYTES = 1 << 20
POLL_S = 0.5
UPLOAD_SHARE = 0.2
"""Share of the upload in the progress."""
TIMEOUT_S = 60.0


class ServiceFailure(RuntimeError):
    """The service does not answer, or not as expected."""


class NothingDone(InputError):
    """The service refuses a request: nothing was registered."""


class Service:
    """A service that registers scenes."""

    def __init__(self, url: str, token: str) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._http = httpx.Client(base_url=url, headers=headers, timeout=TIMEOUT_S)

    def __enter__(self) -> "Service":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.close()

    def register(
        self,
        files: SceneFiles,
        folder: Path,
        progress: Progress,
        *,
        copy_image: bool = False,
        max_ce90_on_earth_m: float | None = None,
    ) -> dict[str, Any]:
        """Register a scene on the service and download the outputs.

        Args:
            files: of the scene.
            folder: for the outputs.
            progress: receives the fraction done and a message.
            copy_image: also copy a GeoTIFF, with the refined model in its tags.
            max_ce90_on_earth_m: see `QualificationOptions`.

        Returns:
            The report as a document.

        Raises:
            InputError: the scene cannot be used, or the service refuses a request.
            ComputationError: the scene could not be registered.
            ServiceFailure: the service does not answer, or not as expected.
        """
        optional_files = [path for path in (files.mask, files.check_points) if path is not None]
        side_files = [*_model_files(files), *optional_files]
        scene = self._upload_scene(files, progress)
        names = {path: self._upload_side_file(scene, path) for path in side_files}
        paths = {"model": files.model, "mask": files.mask, "check_points": files.check_points}
        values = {"bands": files.bands, "check_heights": files.check_heights}
        inputs = {
            "scene": scene,
            "copy_image": copy_image,
            **{name: names[path] for name, path in paths.items() if path is not None},
            **{name: value for name, value in values.items() if value is not None},
        }
        if max_ce90_on_earth_m is not None:
            inputs["options"] = {"qualification": {"max_ce90_on_earth_m": max_ce90_on_earth_m}}
        execution = "processes/register-scene/execution"
        job = self._request("POST", execution, json={"inputs": inputs}).json()
        job = self._wait(job, progress)
        if job["status"] != "successful":
            self._download_report(job, folder)
            raise _failure(job)
        self._download(job["jobID"], folder)
        report: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        return report

    def _upload_scene(self, files: SceneFiles, progress: Progress) -> str:
        size = files.image.stat().st_size
        query = {"name": files.image.name, "sigma_m": files.sigma_m}
        reply = self._request(
            "POST",
            "scenes",
            params={name: value for name, value in query.items() if value is not None},
            content=_chunks(files.image, size, progress),
            headers={"Content-Length": str(size)},
        )
        return str(reply.json()["id"])

    def _upload_side_file(self, scene: str, path: Path) -> str:
        """Upload a file beside the image of a scene; returns the name that the service gives it."""
        with path.open("rb") as file:
            reply = self._request(
                "PUT", f"scenes/{scene}/files/{quote(path.name, safe='')}", content=file
            )
        return str(reply.json()["name"])

    def _wait(self, job: dict[str, Any], progress: Progress) -> dict[str, Any]:
        """Wait until a job has ended; returns its last status."""
        while job["status"] in ("accepted", "running"):
            time.sleep(POLL_S)
            job = self._request("GET", f"jobs/{job['jobID']}").json()
            progress(UPLOAD_SHARE + (1.0 - UPLOAD_SHARE) * job["progress"] / 100.0, job["message"])
        return job

    def _download(self, job_id: str, folder: Path) -> None:
        """Download all files of the results of a job."""
        results = self._request("GET", f"jobs/{job_id}/results").json()
        for name in (k for k, value in results.items() if isinstance(value, dict) and "href" in value):
            self._download_file(job_id, name, folder)

    def _download_report(self, job: dict[str, Any], folder: Path) -> None:
        """Download the report of a failed job, where there is one."""
        results = f"jobs/{job['jobID']}/results/"
        for link in job["links"]:
            if results in link["href"]:
                self._download_file(job["jobID"], str(link["title"]), folder)

    def _download_file(self, job_id: str, name: str, folder: Path) -> None:
        if Path(name).name != name:
            raise ServiceFailure(f"the service names a result {name!r}, which is not a file name")
        folder.mkdir(parents=True, exist_ok=True)
        with self._http.stream("GET", f"jobs/{job_id}/results/{name}") as reply:
            if reply.is_error:
                raise ServiceFailure(f"{reply.url}: {reply.status_code} {reply.reason_phrase}")
            with (folder / name).open("wb") as file:
                for chunk in reply.iter_bytes(CHUNK_BYTES):
                    file.write(chunk)

    def _request(self, method: str, path: str, **options: Any) -> httpx.Response:
        """The reply to a request; error replies raise."""
        try:
            reply = self._http.request(method, path, **options)
        except httpx.HTTPError as error:
            raise ServiceFailure(f"{self._http.base_url}: {error}") from error
        if reply.is_client_error:
            raise NothingDone(f"{self._http.base_url}: {_detail(reply)}")
        if reply.is_error:
            raise ServiceFailure(f"{self._http.base_url}: {reply.status_code} {_detail(reply)}")
        return reply


def _model_files(files: SceneFiles) -> list[Path]:
    """The files with the model of a scene, which is read to check it before anything is sent.

    Raises:
        FormatError: the scene has no usable model.
    """
    return model_files(files.image, files.model)


def _chunks(path: Path, size: int, progress: Progress) -> Iterator[bytes]:
    sent = 0
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            yield chunk
            sent += len(chunk)
            progress(UPLOAD_SHARE * sent / size, "uploading")


def _failure(job: dict[str, Any]) -> AmersError | ServiceFailure:
    """The error that ended a job, of the same kind as on the service."""
    kind = getattr(errors, job.get("error", {}).get("error", ""), None)
    if isinstance(kind, type) and issubclass(kind, ComputationError):
        return ComputationError(job["message"])
    if isinstance(kind, type) and issubclass(kind, InputError):
        return InputError(job["message"])
    return ServiceFailure(f"job {job['jobID']}: {job['status']}: {job['message']}")


def _detail(reply: httpx.Response) -> str:
    try:
        return str(reply.json()["detail"])
    except (ValueError, KeyError, TypeError):
        return f"{reply.status_code} {reply.reason_phrase}"
