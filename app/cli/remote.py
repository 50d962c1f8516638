"""A service of Amers, as a command asks it: upload, execute, watch, download."""

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
"""Share of the progress that the upload is."""
TIMEOUT_S = 60.0


class ServiceFailure(RuntimeError):
    """The service does not answer, or not as it should."""


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
        self, files: SceneFiles, folder: Path, progress: Progress, copy_image: bool = False
    ) -> dict[str, Any]:
        """Have a scene registered and download what came out of it.

        Args:
            files: of the scene.
            folder: for what comes out of it.
            progress: told where the work stands.
            copy_image: also have a GeoTIFF copied, with the refined model in its tags.

        Returns:
            The report as a document.

        Raises:
            InputError: the scene is not usable, or the service refuses what is asked of it.
            ComputationError: the scene could not be registered.
            ServiceFailure: the service does not answer, or not as it should.
        """
        given = [path for path in (files.mask, files.check_points) if path is not None]
        beside = [*_files_beside(files), *given]
        scene = self._upload_scene(files, progress)
        names = {path: self._upload_model(scene, path) for path in beside}
        named = {"model": files.model, "mask": files.mask, "check_points": files.check_points}
        asked = {name: names[path] for name, path in named.items() if path is not None}
        said = {"bands": files.bands, "check_heights": files.check_heights}
        asked |= {name: value for name, value in said.items() if value is not None}
        inputs = {"scene": scene, "copy_image": copy_image, **asked}
        execution = "processes/register-scene/execution"
        job = self._ask("POST", execution, json={"inputs": inputs}).json()
        job = self._watch(job, progress)
        if job["status"] != "successful":
            raise _failure(job)
        self._download(job["jobID"], folder)
        report: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        return report

    def _upload_scene(self, files: SceneFiles, progress: Progress) -> str:
        size = files.image.stat().st_size
        query = {"name": files.image.name, "sigma_m": files.sigma_m}
        reply = self._ask(
            "POST",
            "scenes",
            params={name: value for name, value in query.items() if value is not None},
            content=_chunks(files.image, size, progress),
            headers={"Content-Length": str(size)},
        )
        return str(reply.json()["id"])

    def _upload_model(self, scene: str, path: Path) -> str:
        """Name under which the service has the file."""
        with path.open("rb") as file:
            reply = self._ask("PUT", f"scenes/{scene}/files/{quote(path.name, safe='')}", content=file)
        return str(reply.json()["name"])

    def _watch(self, job: dict[str, Any], progress: Progress) -> dict[str, Any]:
        while job["status"] in ("accepted", "running"):
            time.sleep(POLL_S)
            job = self._ask("GET", f"jobs/{job['jobID']}").json()
            progress(UPLOAD_SHARE + (1.0 - UPLOAD_SHARE) * job["progress"] / 100.0, job["message"])
        return job

    def _download(self, job_id: str, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        results = self._ask("GET", f"jobs/{job_id}/results").json()
        for name in (name for name, value in results.items() if isinstance(value, dict)):
            if Path(name).name != name:
                raise ServiceFailure(f"the service names a file {name!r}")
            with self._http.stream("GET", f"jobs/{job_id}/results/{name}") as reply:
                if reply.is_error:
                    raise ServiceFailure(f"{reply.url}: {reply.status_code} {reply.reason_phrase}")
                with (folder / name).open("wb") as file:
                    for chunk in reply.iter_bytes(CHUNK_BYTES):
                        file.write(chunk)

    def _ask(self, method: str, path: str, **request: Any) -> httpx.Response:
        """A reply that is not an error."""
        try:
            reply = self._http.request(method, path, **request)
        except httpx.HTTPError as error:
            raise ServiceFailure(f"{self._http.base_url}: {error}") from error
        if reply.is_client_error:
            raise InputError(f"{self._http.base_url}: {_detail(reply)}")
        if reply.is_error:
            raise ServiceFailure(f"{self._http.base_url}: {reply.status_code} {_detail(reply)}")
        return reply


def _files_beside(files: SceneFiles) -> list[Path]:
    """The files with the model of a scene, which is looked at before anything is sent.

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
    """The error that ended a job, of the kind it was over there."""
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
