"""OGC API - Processes: jobs, where they stand and what they made."""

from typing import Annotated, Any, Literal
from uuid import UUID

from fastapi import APIRouter, Depends, Query, Request

from app.api.deps import DatabaseDep, Reader
from app.db.jobs.jobs import Job, JobFilter
from app.db.schema import JobState
from app.errors import NoSuchJob
from app.usecases import jobs
from app.usecases.features.query import parse_interval

router = APIRouter(tags=["jobs"])

MOST_LISTED = 1000


async def _job_id(job_id: str) -> UUID:
    try:
        return UUID(job_id)
    except ValueError:
        raise NoSuchJob(f"no job {job_id:.100}") from None


JobId = Annotated[UUID, Depends(_job_id)]


@router.get("/jobs")
def list_jobs(
    request: Request,
    database: DatabaseDep,
    caller: Reader,
    process_id: Annotated[list[str] | None, Query(alias="processID")] = None,
    status: Annotated[list[JobState] | None, Query()] = None,
    type: Annotated[list[Literal["process"]] | None, Query(description="Every job is one.")] = None,
    datetime: Annotated[
        str | None,
        Query(description="When it was asked for: a time, or FROM/TO with .. for an open end."),
    ] = None,
    min_duration: Annotated[
        float | None, Query(alias="minDuration", ge=0, description="Seconds.")
    ] = None,
    max_duration: Annotated[
        float | None, Query(alias="maxDuration", ge=0, description="Seconds.")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=MOST_LISTED)] = 100,
    after: Annotated[UUID | None, Query(description="From the link `next`.")] = None,
) -> dict[str, Any]:
    """The caller's jobs, the newest first; everybody's for an administrator."""
    since, until = (None, None) if datetime is None else parse_interval(datetime)
    wanted = JobFilter(
        tuple(process_id or ()), tuple(status or ()), since, until, min_duration, max_duration
    )
    with database.reading() as connection:
        found = jobs.list_jobs(connection, caller, wanted, limit + 1, after)
    page = found[:limit]
    links = [{"rel": "self", "href": str(request.url), "type": "application/json"}]
    if len(found) > limit:
        following = str(request.url.include_query_params(after=page[-1].id))
        links.append({"rel": "next", "href": following, "type": "application/json"})
    return {"jobs": [status_info(request, job) for job in page], "links": links}


@router.get("/jobs/{job_id}")
def show_job(job_id: JobId, request: Request, database: DatabaseDep, caller: Reader) -> dict[str, Any]:
    """Where a job stands.

    While it waits, `amers:queuePosition` counts the jobs to be begun up to it; until it ends,
    `amers:estimatedEnd` says when it may, from the durations of jobs before it.
    """
    with database.reading() as connection:
        job = jobs.visible_job(connection, caller, job_id)
        course = {
            "amers:queuePosition": jobs.queue_position(connection, job),
            "amers:estimatedEnd": jobs.expected_end(connection, job),
        }
    told = {name: value for name, value in course.items() if value is not None}
    return {**status_info(request, job), **told}


@router.get("/jobs/{job_id}/messages")
def show_messages(
    job_id: JobId, request: Request, database: DatabaseDep, caller: Reader
) -> dict[str, Any]:
    """What a job has said on its way, the oldest message first: the last thousand."""
    with database.reading() as connection:
        said = jobs.read_messages(connection, caller, job_id)
    here = f"{request.base_url}jobs/{job_id}"
    return {
        "messages": [vars(message) for message in said],
        "links": [
            {"rel": "self", "href": f"{here}/messages", "type": "application/json"},
            {"rel": "up", "href": here, "type": "application/json"},
        ],
    }


@router.delete("/jobs/{job_id}")
def dismiss_job(
    job_id: JobId, request: Request, database: DatabaseDep, caller: Reader
) -> dict[str, Any]:
    """Dismiss a job that has not ended; work on it stops within seconds."""
    with database.transaction() as connection:
        return status_info(request, jobs.dismiss(connection, caller, job_id))


def job_url(request: Request, job: Job) -> str:
    """Where a job is watched."""
    return f"{request.base_url}jobs/{job.id}"


def status_info(request: Request, job: Job) -> dict[str, Any]:
    """A job as OGC API - Processes tells it; `error` holds the problem details of a failure."""
    here = job_url(request, job)
    links = [
        {"rel": "self", "href": here, "type": "application/json"},
        {"rel": "related", "href": f"{here}/messages", "type": "application/json", "title": "messages"},
    ]
    if job.state == "successful" and job.results_removed_at is None:
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
