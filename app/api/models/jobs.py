"""Models of OGC API - Processes: processes, jobs, messages, results.

Source: OGC 18-062r2 (Processes).
"""

from datetime import datetime
from typing import Annotated, Literal
from uuid import UUID

from pydantic import ConfigDict, Field

from amers.app.api.models.base import JsonObject, Link, Missing, Reply, StatedAccuracy, missing
from amers.app.db.schema import JobState

Percent = Annotated[int, Field(ge=0, le=100)]


class ProcessSummary(Reply):
    """A process in a list."""

    id: str
    title: str
    description: str
    version: str
    job_control_options: list[str] = Field(serialization_alias="jobControlOptions")
    output_transmission: list[Literal["value", "reference"]] = Field(
        serialization_alias="outputTransmission"
    )
    links: list[Link]


class Processes(Reply):
    """A page of the processes."""

    processes: list[ProcessSummary]
    links: list[Link]


class InputDescription(Reply):
    """An input of a process."""

    title: str
    description: str | None = Missing
    min_occurs: int = Field(serialization_alias="minOccurs")
    value_schema: JsonObject = Field(serialization_alias="schema")


class OutputDescription(Reply):
    """An output of a process."""

    title: str
    description: str | None = Missing
    value_schema: JsonObject = Field(serialization_alias="schema")


class ProcessDescription(ProcessSummary):
    """A process with its inputs and outputs, each described by a JSON Schema."""

    inputs: dict[str, InputDescription]
    outputs: dict[str, OutputDescription]


class JobError(Reply):
    """Why a job failed, as problem details; `error` names the kind of error."""

    model_config = ConfigDict(extra="allow")

    type: str | None = Missing
    title: str
    detail: str | None = Missing
    error: str | None = Missing


class StatusInfo(Reply):
    """The state of a job.

    `status` is that of the job; `amers:verdict` is that of its registration: good, usable or failed. A
    job that failed after a search has a report too, under a link.

    `amers:sceneNames` are the names of the scenes among the inputs.
    `amers:relative_to_control_points` and `amers:on_the_earth` are the accuracy that the registration of
    one scene states.

    `amers:queuePosition` is the place in the queue of a job that waits. `amers:estimatedEnd` is
    estimated from the durations of earlier jobs. `amers:priority` is that of a job to which an
    administrator gave one.
    """

    job_id: UUID = Field(serialization_alias="jobID")
    process_id: str = Field(serialization_alias="processID")
    type: Literal["process"]
    status: JobState
    progress: Percent
    message: str | None
    inputs: JsonObject
    created: datetime
    started: datetime | None
    finished: datetime | None
    updated: datetime
    error: JobError | None = Missing
    links: list[Link]
    queue_position: int | None = missing("amers:queuePosition")
    estimated_end: datetime | None = missing("amers:estimatedEnd")
    priority: int | None = missing("amers:priority")
    verdict: Literal["good", "usable", "failed", "not registered"] | None = missing("amers:verdict")
    scene_names: list[str] | None = missing("amers:sceneNames")
    relative_to_control_points: StatedAccuracy | None = missing("amers:relative_to_control_points")
    on_the_earth: StatedAccuracy | None = missing("amers:on_the_earth")


class Jobs(Reply):
    """A page of jobs."""

    jobs: list[StatusInfo]
    links: list[Link]


class Message(Reply):
    """A message of a job; `attempt` is 0 before the first attempt."""

    at: datetime
    attempt: int
    progress: Percent
    message: str


class Messages(Reply):
    """The last messages of a job."""

    messages: list[Message]
    links: list[Link]


class SurfaceHeight(Reply):
    """What a surface has at a place; height and sigma are null where the cell has none.

    The height is above the ellipsoid, sigma one standard deviation; `views` is the number of images that
    show it, 0 where it was filled; `reason` says why there is no height.
    """

    distance_m: float
    lon: float
    lat: float
    height_m: float | None
    sigma_m: float | None
    views: int
    reason: str


class SurfaceHeights(Reply):
    """The heights of a surface at a place, or along a line at equal distances."""

    heights: list[SurfaceHeight]


class ResultFile(Reply):
    """A file of the results of a job, by reference."""

    href: str
    type: str
    title: str
