"""OGC API - Processes: jobs, where they stand and what they made."""

from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Query, Request
from fastapi.responses import FileResponse, JSONResponse

from app.api.deps import ReadConnection, Reader, StorageDep, WriteConnection
from app.api.replies import problem
from app.db.jobs import Job, JobFilter, JobState
from app.errors import NotFound
from app.usecases import jobs
from app.usecases.registration_files import media_type

router = APIRouter(tags=["jobs"])

MOST_LISTED = 1000
EXCEPTIONS = "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0"
PAGE_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"
"""A report shows and styles what is in it, and does nothing else."""


@router.get("/jobs")
def list_jobs(
    request: Request,
    connection: ReadConnection,
    caller: Reader,
    process_id: Annotated[list[str] | None, Query(alias="processID")] = None,
    status: Annotated[list[JobState] | None, Query()] = None,
    limit: Annotated[int, Query(ge=1, le=MOST_LISTED)] = 100,
    after: Annotated[UUID | None, Query(description="From the link `next`.")] = None,
) -> dict[str, Any]:
    """The caller's jobs, the newest first; everybody's for an administrator."""
    wanted = JobFilter(tuple(process_id or ()), tuple(status or ()))
    found = jobs.list_jobs(connection, caller, wanted, limit + 1, after)
    page = found[:limit]
    links = [{"rel": "self", "href": str(request.url), "type": "application/json"}]
    if len(found) > limit:
        following = str(request.url.include_query_params(after=page[-1].id))
        links.append({"rel": "next", "href": following, "type": "application/json"})
    return {"jobs": [status_info(request, job) for job in page], "links": links}


@router.get("/jobs/{job_id}")
def show_job(
    job_id: UUID, request: Request, connection: ReadConnection, caller: Reader
) -> dict[str, Any]:
    """Where a job stands; while it waits, `amers:queuePosition` says how many come before it, and it."""
    job = jobs.visible_job(connection, caller, job_id)
    position = jobs.queue_position(connection, job)
    info = status_info(request, job)
    return info if position is None else {**info, "amers:queuePosition": position}


@router.delete("/jobs/{job_id}")
def dismiss_job(
    job_id: UUID, request: Request, connection: WriteConnection, caller: Reader
) -> dict[str, Any]:
    """Dismiss a job that has not ended; work on it stops within seconds."""
    return status_info(request, jobs.dismiss(connection, caller, job_id))


@router.get("/jobs/{job_id}/results", response_model=None)
def show_results(
    job_id: UUID, request: Request, connection: ReadConnection, caller: Reader
) -> dict[str, Any] | JSONResponse:
    """What a job made: values, and links to its files."""
    job = jobs.visible_job(connection, caller, job_id)
    if job.state == "failed" and job.error is not None:
        return problem(409, **{"detail": "the job failed", **_told(job.error)})
    if job.state != "successful":
        title = f"The job is {job.state}"
        return problem(404, job.message, title=title, type=f"{EXCEPTIONS}/result-not-ready")
    results = dict(job.results or {})
    names = results.pop("files", {})
    here = job_url(request, job)
    files = {
        name: {"href": f"{here}/results/{name}", "type": media_type(name), "title": name}
        for name in names
    }
    return {**results, **files}


@router.get("/jobs/{job_id}/results/{name}")
def download_result(
    job_id: UUID, name: str, connection: ReadConnection, storage: StorageDep, caller: Reader
) -> FileResponse:
    """One file of the results."""
    job = jobs.visible_job(connection, caller, job_id)
    key = (job.results or {}).get("files", {}).get(name)
    if key is None:
        raise NotFound(f"job {job_id} has no result {name}")
    headers = {"X-Content-Type-Options": "nosniff", "Content-Security-Policy": PAGE_POLICY}
    return FileResponse(storage.path(key), media_type=media_type(name), headers=headers)


def job_url(request: Request, job: Job) -> str:
    """Where a job is watched."""
    return f"{request.base_url}jobs/{job.id}"


def status_info(request: Request, job: Job) -> dict[str, Any]:
    """A job as OGC API - Processes tells it; `error` holds the problem details of a failure."""
    here = job_url(request, job)
    links = [{"rel": "self", "href": here, "type": "application/json"}]
    if job.state == "successful":
        results = {"rel": "http://www.opengis.net/def/rel/ogc/1.0/results", "href": f"{here}/results"}
        links.append({**results, "type": "application/json"})
    if "scene" in job.inputs:
        scene = f"{request.base_url}scenes/{job.inputs['scene']}"
        links.append({"rel": "related", "href": scene, "type": "application/json", "title": "scene"})
    return {
        "jobID": job.id,
        "processID": job.kind,
        "type": "process",
        "status": job.state,
        "progress": job.progress,
        "message": job.message,
        "inputs": job.inputs,
        "created": job.created_at,
        "started": job.started_at,
        "finished": job.finished_at,
        "updated": job.updated_at,
        **({"error": job.error} if job.error else {}),
        "links": links,
    }


def _told(error: dict[str, Any]) -> dict[str, Any]:
    """Problem details of a failed job, as members of a reply that has its own type and status."""
    return {name: value for name, value in error.items() if name not in ("type", "status")}
