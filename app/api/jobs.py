"""OGC API - Processes: jobs, their states and messages."""

from collections.abc import Mapping
from typing import Annotated, Literal
from uuid import UUID

from fastapi import APIRouter, BackgroundTasks, Depends, Query, Request
from pydantic import BaseModel, Field

from amers.app.api.deps import DatabaseDep, Reader, StorageDep
from amers.app.api.models.base import Link, stated_accuracy
from amers.app.api.models.jobs import JobError, Jobs, Message, Messages, StatusInfo
from amers.app.api.negotiation import JSON
from amers.app.api.routes import CallerRoute
from amers.app.db.features.instants import first_instant, last_instant, parse_interval
from amers.app.db.jobs.jobs import Job, JobFilter
from amers.app.db.schema import JobState
from amers.app.errors import NoSuchJob
from amers.app.usecases import jobs, results
from amers.app.usecases.media_types import media_type
from amers.app.usecases.processes import results_folder
from amers.app.usecases.results import delete_removed

router = APIRouter(tags=["jobs"], route_class=CallerRoute)

MOST_LISTED = 1000
RESULTS = "http://www.opengis.net/def/rel/ogc/1.0/results"


async def _job_id(job_id: str) -> UUID:
    try:
        return UUID(job_id)
    except ValueError:
        raise NoSuchJob(f"no job {job_id:.100}") from None


JobId = Annotated[UUID, Depends(_job_id)]


class JobsQuery(BaseModel):
    """The parameters of a page of jobs."""

    process_id: list[str] | None = Field(default=None, alias="processID")
    status: list[JobState] | None = None
    type: list[Literal["process"]] | None = Field(default=None, description="Every job is of this type.")
    datetime: str | None = Field(
        default=None,
        description="When it was requested: a date, a time, or FROM/TO with `..` for an open end.",
    )
    min_duration: float | None = Field(default=None, alias="minDuration", ge=0, description="Seconds.")
    max_duration: float | None = Field(default=None, alias="maxDuration", ge=0, description="Seconds.")
    limit: int = Field(default=100, ge=1, le=MOST_LISTED, description="Number of jobs on a page.")
    after: UUID | None = Field(default=None, description="From the link `next`.")

    @property
    def job_filter(self) -> JobFilter:
        """The jobs that meet the parameters."""
        since, until = (None, None) if self.datetime is None else parse_interval(self.datetime)
        return JobFilter(
            kinds=tuple(self.process_id or ()),
            states=tuple(self.status or ()),
            since=None if since is None else first_instant(since),
            until=None if until is None else last_instant(until),
            min_duration_s=self.min_duration,
            max_duration_s=self.max_duration,
        )


@router.get("/jobs")
def list_jobs(
    *, request: Request, database: DatabaseDep, caller: Reader, query: Annotated[JobsQuery, Query()]
) -> Jobs:
    """List the jobs of the caller, newest first; administrators see all jobs."""
    with database.reading() as connection:
        listed = jobs.list_jobs(connection, caller, query.job_filter, query.limit + 1, query.after)
        page = listed[: query.limit]
        names = jobs.names_of_scenes(connection, page)
    links = [Link(rel="self", href=str(request.url), type=JSON)]
    if len(listed) > query.limit:
        following = str(request.url.include_query_params(after=page[-1].id))
        links.append(Link(rel="next", href=following, type=JSON))
    return Jobs(jobs=[status_info(request, job, names) for job in page], links=links)


@router.get("/jobs/{job_id}")
def show_job(*, job_id: JobId, request: Request, database: DatabaseDep, caller: Reader) -> StatusInfo:
    """Return the state of a job.

    `amers:queuePosition` is the place in the queue of a job that waits. `amers:estimatedEnd` is
    estimated from the durations of earlier jobs, until the job ends.
    """
    with database.reading() as connection:
        job = jobs.visible_job(connection, caller, job_id)
        status = status_info(request, job, jobs.names_of_scenes(connection, [job]))
        outlook = jobs.outlook(connection, job)
        status.queue_position, status.estimated_end = outlook.position, outlook.expected_end
    return status


@router.get("/jobs/{job_id}/messages")
def show_messages(*, job_id: JobId, request: Request, database: DatabaseDep, caller: Reader) -> Messages:
    """Return the last thousand messages of a job, oldest first."""
    with database.reading() as connection:
        messages = jobs.read_messages(connection, caller, job_id)
    here = f"{request.base_url}jobs/{job_id}"
    return Messages(
        messages=[Message.model_validate(message) for message in messages],
        links=[
            Link(rel="self", href=f"{here}/messages", type=JSON),
            Link(rel="up", href=here, type=JSON),
        ],
    )


@router.delete("/jobs/{job_id}")
def dismiss_job(
    *,
    job_id: JobId,
    request: Request,
    database: DatabaseDep,
    storage: StorageDep,
    caller: Reader,
    after_commit: BackgroundTasks,
) -> StatusInfo:
    """Dismiss a job that has not ended, or remove an ended one with its messages and results.

    The worker of a dismissed job stops within seconds. The measures of a registration stay in the
    histories of its points.
    """
    with database.reading() as connection:
        is_ended = jobs.visible_job(connection, caller, job_id).finished_at is not None
    if is_ended:
        storage.prove()
    with database.transaction() as connection:
        job = jobs.dismiss(connection, caller, job_id)
        names = jobs.names_of_scenes(connection, [job])
    if job.results_removed_at is not None:
        after_commit.add_task(delete_removed, storage, results_folder(job_id))
    return status_info(request, job, names)


def job_url(request: Request, job: Job) -> str:
    """The address of a job."""
    return f"{request.base_url}jobs/{job.id}"


def status_info(request: Request, job: Job, names: Mapping[str, str] | None = None) -> StatusInfo:
    """A job as OGC API - Processes describes it.

    Args:
        names: of scenes, by id.
    """
    names, made = names or {}, job.results or {}
    scene_names = [names[scene] for scene in jobs.scenes_of(job) if scene in names]
    here = job_url(request, job)
    links = [
        Link(rel="self", href=here, type=JSON),
        Link(rel="related", href=f"{here}/messages", type=JSON, title="messages"),
    ]
    if job.state == "successful" and job.results_removed_at is None:
        links.append(Link(rel=RESULTS, href=f"{here}/results", type=JSON))
    if job.state == "failed":
        links += [
            Link(rel="related", href=f"{here}/results/{name}", type=media_type(name), title=name)
            for name in results.kept_files(job)
        ]
    for scene in jobs.scenes_of(job):
        href = f"{request.base_url}scenes/{scene}"
        links.append(Link(rel="related", href=href, type=JSON, title="scene"))
    return StatusInfo(
        job_id=job.id,
        process_id=job.kind,
        type="process",
        status=job.state,
        progress=job.progress,
        message=job.message,
        inputs=job.inputs,
        created=job.created_at,
        started=job.started_at,
        finished=job.finished_at,
        updated=job.updated_at,
        error=JobError.model_validate(job.error) if job.error else None,
        priority=job.priority or None,
        verdict=made.get("verdict"),
        scene_names=scene_names or None,
        relative_to_control_points=stated_accuracy(made.get("relative_to_control_points")),
        on_the_earth=stated_accuracy(made.get("on_the_earth")),
        links=links,
    )
