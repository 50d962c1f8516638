"""The client: points and blocks, uploads, jobs and their results."""

import time
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

import httpx

from .connection import Connection
from .errors import JobFailed, RequestRefused, ServiceFailure, is_transient
from .job import Job, Progress, no_progress
from .upload import upload_image

POLL_S = 0.5
TIMEOUT_S = 60.0
OUTAGE_S = 60.0
"""Longest time without an answer about a job; a service starts again within seconds."""
PAGE = 1000
"""Number of features on a page."""
NEXT_TOKEN = "Amers-Next-Token"
"""Header of a page that others follow."""

Box = tuple[float, float, float, float]
"""West, south, east, north in degrees; a west greater than the east crosses the antimeridian."""
Feature = dict[str, Any]
"""A GeoJSON feature: longitude and latitude in degrees, height above the ellipsoid in metres."""


class Client:
    """An Amers service.

    Every method raises RequestRefused when the service refuses the request, and ServiceFailure when it
    does not answer, or not as expected.
    """

    def __init__(self, url: str, token: str = "", *, timeout_s: float = TIMEOUT_S) -> None:
        """Nothing is sent yet.

        Args:
            url: address of the service.
            token: secret of a token; "" for a service with public points.
            timeout_s: longest time without a byte from the service.
        """
        self._connection = Connection(url, token, timeout_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connection.close()

    def points(
        self,
        bbox: Box | None = None,
        *,
        footprint: Mapping[str, Any] | None = None,
        where: str | None = None,
    ) -> Iterator[Feature]:
        """Iterate over the published points, page by page.

        Args:
            bbox: only points inside it.
            footprint: GeoJSON geometry in longitude and latitude; only points that intersect it.
            where: condition in CQL2 text, such as `saliency > 0.3 AND n_views >= 3`.
        """
        return self.features("points", bbox, footprint=footprint, where=where)

    def blocks(self) -> list[Feature]:
        """The blocks that the token may see."""
        return list(self.features("blocks"))

    def features(
        self,
        collection: str,
        bbox: Box | None = None,
        *,
        footprint: Mapping[str, Any] | None = None,
        where: str | None = None,
    ) -> Iterator[Feature]:
        """Iterate over the features of a collection, page by page; see `points`."""
        conditions = {
            "bbox": None if bbox is None else list(bbox),
            "intersects": footprint,
            "filter": where,
        }
        query: dict[str, Any] | None = {"f": "json", "limit": PAGE} | {
            name: value for name, value in conditions.items() if value is not None
        }
        asked: set[str] = set()
        while query is not None:
            _ask_once(asked, repr(query))
            page = self._connection.request(
                "POST", f"collections/{collection}/search", json=query
            ).json()
            yield from page["features"]
            query = next((link["body"] for link in page["links"] if link["rel"] == "next"), None)

    def count(self, collection: str, bbox: Box | None = None) -> tuple[int, bool]:
        """The number of features of a collection, and whether it is exact: large ones are estimates."""
        page = self._page(collection, "json", bbox, 1).json()
        return page["numberMatched"], page["amers:numberMatchedIsExact"]

    def csv(self, collection: str, bbox: Box | None = None) -> Iterator[bytes]:
        """The features of a collection as one CSV with a header, in pieces."""
        token, is_first, asked = None, True, set[str]()
        while is_first or token is not None:
            _ask_once(asked, str(token))
            page = self._page(collection, "csv", bbox, PAGE, token)
            header, _, rows = page.content.partition(b"\r\n")
            yield header + b"\r\n" + rows if is_first else rows
            token, is_first = page.headers.get(NEXT_TOKEN), False

    def _page(
        self, collection: str, form: str, bbox: Box | None, limit: int, token: str | None = None
    ) -> httpx.Response:
        """A page of a collection, the first one without a token."""
        corners = None if bbox is None else ",".join(map(str, bbox))
        query = {"f": form, "limit": limit, "bbox": corners, "token": token}
        present = {name: value for name, value in query.items() if value is not None}
        return self._connection.request("GET", f"collections/{collection}/items", params=present)

    def upload_scene(
        self, image: Path, *, sigma_m: float | None = None, progress: Progress = no_progress
    ) -> str:
        """Upload the image of a scene, resuming when the connection breaks; returns the id of the scene.

        Args:
            image: GeoTIFF, JPEG 2000 or NITF. A model in files of its own follows by `upload_file`.
            sigma_m: accuracy of its model, metres (1 sigma); by default what the model states.
            progress: receives the fraction sent.
        """
        return upload_image(self._connection, image, sigma_m, progress)

    def upload_file(self, scene: str, path: Path) -> str:
        """Upload a file beside the image of a scene: model, terrain, mask or check points.

        Returns:
            The name that the service gives it, for the inputs of a process.
        """
        with path.open("rb") as file:
            target = f"scenes/{scene}/files/{quote(path.name, safe='')}"
            return str(self._connection.request("PUT", target, content=file).json()["name"])

    def execute(self, process: str, inputs: Mapping[str, Any]) -> Job:
        """Start a process, such as `register-scene`; returns its job.

        Args:
            process: its id, one of `/processes`.
            inputs: by name, as `/processes/ID` describes them.
        """
        body = {"inputs": dict(inputs)}
        reply = self._connection.request("POST", f"processes/{process}/execution", json=body)
        return Job.of(reply.json())

    def job(self, job_id: str) -> Job:
        """The present state of a job."""
        return Job.of(self._connection.request("GET", f"jobs/{job_id}").json())

    def wait(self, job: Job, progress: Progress = no_progress, *, timeout_s: float | None = None) -> Job:
        """Wait until a job has ended; returns its last state.

        A service that does not answer, because it starts again or has too much to do, is asked again for
        as long as `OUTAGE_S`.

        Args:
            progress: receives the fraction done and the current step.
            timeout_s: longest time to wait; None for no limit.

        Raises:
            JobFailed: the job failed or was dismissed.
            TimeoutError: the job has not ended in this time; it goes on.
        """
        end = None if timeout_s is None else time.monotonic() + timeout_s
        answered_at = time.monotonic()
        while not job.has_ended:
            if end is not None and time.monotonic() > end:
                raise TimeoutError(f"job {job.id}: {job.status} after {timeout_s:g} s: {job.message}")
            time.sleep(POLL_S)
            try:
                job = self.job(job.id)
            except (ServiceFailure, RequestRefused) as error:
                if not is_transient(error) or time.monotonic() - answered_at > OUTAGE_S:
                    raise
                continue
            answered_at = time.monotonic()
            progress(job.progress / 100.0, job.message)
        if job.status != "successful":
            raise JobFailed(job)
        return job

    def results(self, job: Job) -> dict[str, Any]:
        """The results of a successful job: values, and for every file an object with its `href`."""
        results: dict[str, Any] = self._connection.request("GET", f"jobs/{job.id}/results").json()
        return results

    def report(self, job: Job) -> dict[str, Any]:
        """The report of a registration, `report.json`; its schema is at `/schemas/report.json`."""
        path = f"jobs/{job.id}/results/report.json"
        report: dict[str, Any] = self._connection.request("GET", path).json()
        return report

    def download(self, job: Job, folder: Path) -> list[Path]:
        """Download the files of the results into a folder; of a failed job, those of its report.

        Returns:
            The files, in the folder or below it.
        """
        if job.status == "successful":
            values = self.results(job).items()
            names = [name for name, value in values if isinstance(value, dict) and "href" in value]
        else:
            results = f"jobs/{job.id}/results/"
            names = [link["title"] for link in job.document["links"] if results in link["href"]]
        return [self._download(job, name, folder) for name in names]

    def _download(self, job: Job, name: str, folder: Path) -> Path:
        relative = PurePosixPath(name)
        if not relative.name or relative.is_absolute() or ".." in relative.parts:
            raise ServiceFailure(f"the service names a result {name!r}, which is not a file name")
        target = folder / relative
        target.parent.mkdir(parents=True, exist_ok=True)
        self._connection.download(f"jobs/{job.id}/results/{quote(name)}", target)
        return target


def _ask_once(asked: set[str], page: str) -> None:
    """Note a page of a collection.

    Raises:
        ServiceFailure: it was read before: links to the next page form a ring.
    """
    if page in asked:
        raise ServiceFailure("the service names a next page that was already read")
    asked.add(page)
