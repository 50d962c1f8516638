"""OGC API - Processes: the processes and their execution."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Query, Request, Response, status
from pydantic import BaseModel, ConfigDict, Field

from amers.app.api.access import FURTHER_SCOPES, Public
from amers.app.api.deps import InstallationDep, Reader
from amers.app.api.jobs import job_url, status_info
from amers.app.api.models.base import Link
from amers.app.api.models.jobs import (
    InputDescription,
    OutputDescription,
    ProcessDescription,
    Processes,
    ProcessSummary,
    StatusInfo,
)
from amers.app.api.negotiation import JSON
from amers.app.api.routes import CallerRoute
from amers.app.errors import InputError
from amers.app.usecases import jobs
from amers.app.usecases.jobs import JobRequest
from amers.app.usecases.media_types import media_type
from amers.app.usecases.processes import Process

router = APIRouter(tags=["processes"], route_class=CallerRoute)

VERSION = "1.0.0"
OGC = "http://www.opengis.net/spec/ogcapi-processes-1/1.0/conf/"
CONFORMS_TO = tuple(
    f"{OGC}{name}"
    for name in ("core", "ogc-process-description", "json", "oas30", "job-list", "dismiss")
)
EXECUTE = "http://www.opengis.net/def/rel/ogc/1.0/execute"
QUALIFIED_VALUE = {"value", "mediaType", "encoding", "schema", "format"}
"""Members of an input that gives its value together with a description of it."""
HIGHEST_PRIORITY = 100
SCENES = ("scenes/", "collections/scenes/items/")


class RequestedOutput(BaseModel):
    """How one output is sent."""

    model_config = ConfigDict(extra="forbid", populate_by_name=True)

    transmission_mode: Literal["value", "reference"] = Field("value", alias="transmissionMode")
    format: dict[str, Any] | None = Field(None, description="Ignored: every output has one format.")


class Execute(BaseModel):
    """The body of an execution."""

    model_config = ConfigDict(extra="forbid", populate_by_name=True)

    inputs: dict[str, Any] = Field(default_factory=dict, description="Inputs of the process, by name.")
    outputs: dict[str, RequestedOutput] | None = Field(
        default=None,
        description="Requested outputs, by name; files are sent by value unless `transmissionMode` is"
        " `reference`. Without this member, all outputs are sent, files by reference.",
    )
    response: Literal["document", "raw"] = Field(
        default="document", description="Whether the results are one document or the outputs themselves."
    )
    priority: int = Field(
        default=0,
        alias="amers:priority",
        ge=-HIGHEST_PRIORITY,
        le=HIGHEST_PRIORITY,
        description="Jobs of a higher priority come first; only administrators may give another than 0.",
    )


@router.get("/processes", dependencies=[Public])
def list_processes(
    *,
    request: Request,
    limit: Annotated[int, Query(ge=1, le=1000, description="Number of processes on a page.")] = 100,
    offset: Annotated[int, Query(ge=0, le=1000, description="From the link `next`.")] = 0,
) -> Processes:
    """List the processes."""
    base = str(request.base_url)
    processes = list(jobs.PROCESSES.values())
    links = [Link(rel="self", href=str(request.url), type=JSON)]
    if offset + limit < len(processes):
        following = str(request.url.include_query_params(offset=offset + limit))
        links.append(Link(rel="next", href=following, type=JSON))
    page = processes[offset : offset + limit]
    return Processes(
        processes=[ProcessSummary(**_summary(base, process)) for process in page], links=links
    )


@router.get("/processes/{process_id}", dependencies=[Public])
def describe_process(*, process_id: str, request: Request) -> ProcessDescription:
    """Return one process with its inputs and outputs."""
    process = jobs.find_process(process_id)
    schema = process.input_schema()
    required = schema.get("required", [])
    descriptions = process.input_descriptions()
    inputs = {
        name: InputDescription(
            title=name,
            description=descriptions.get(name),
            min_occurs=1 if name in required else 0,
            value_schema=inlined(member, schema.get("$defs", {})),
        )
        for name, member in schema["properties"].items()
    }
    outputs = {
        name: OutputDescription(title=value["title"], value_schema=value)
        for name, value in process.values.items()
    }
    for name, text in process.outputs.items():
        outputs[name] = OutputDescription(
            title=name, description=text, value_schema=_file_schema(request, name)
        )
    return ProcessDescription(**_summary(str(request.base_url), process), inputs=inputs, outputs=outputs)


@router.post(
    "/processes/{process_id}/execution",
    status_code=status.HTTP_201_CREATED,
    openapi_extra={FURTHER_SCOPES: ["register", "admin"]},
)
def execute(
    *,
    process_id: str,
    body: Execute,
    request: Request,
    response: Response,
    installation: InstallationDep,
    caller: Reader,
    idempotency_key: Annotated[str | None, Header()] = None,
    prefer: Annotated[str | None, Header()] = None,
) -> StatusInfo:
    """Create a job of a process; jobs are asynchronous whatever the header `Prefer` asks for.

    A repeated request with the same `Idempotency-Key` returns the job of the first one.
    """
    inputs = {name: _input_value(request, name, value) for name, value in body.inputs.items()}
    outputs = None
    if body.outputs is not None:
        outputs = {name: output.transmission_mode for name, output in body.outputs.items()}
    job_request = JobRequest(process_id, inputs, outputs, body.response, body.priority)
    with installation.database.transaction() as connection:
        job = jobs.execute(connection, installation.settings, caller, job_request, idempotency_key)
        names = jobs.names_of_scenes(connection, [job])
    response.headers["Location"] = job_url(request, job)
    if "respond-async" in (prefer or ""):
        response.headers["Preference-Applied"] = "respond-async"
    return status_info(request, job, names)


def _input_value(request: Request, name: str, value: Any) -> Any:
    """The value of an input: as it is, inside a qualified value, or the id in a link to a scene.

    Raises:
        InputError: the link leads elsewhere; the service fetches nothing.
    """
    if not isinstance(value, dict):
        return value
    if "value" in value and value.keys() <= QUALIFIED_VALUE:
        return value["value"]
    if "href" not in value:
        return value
    path = str(value["href"]).removeprefix(str(request.base_url))
    scene_id = next((path.removeprefix(start) for start in SCENES if path.startswith(start)), "")
    if not scene_id or "/" in scene_id:
        raise InputError(f"inputs.{name}.href: no scene of this service; other links are not fetched")
    return scene_id


def inlined(schema: Any, definitions: dict[str, Any]) -> Any:
    """A JSON Schema with each reference replaced by its definition; definitions are not recursive."""
    if isinstance(schema, list):
        return [inlined(item, definitions) for item in schema]
    if not isinstance(schema, dict):
        return schema
    rest = {key: inlined(value, definitions) for key, value in schema.items() if key != "$ref"}
    if "$ref" in schema:
        named = definitions[schema["$ref"].rsplit("/", 1)[1]]
        return {**inlined(named, definitions), **rest}
    return rest


def _file_schema(request: Request, name: str) -> dict[str, Any]:
    """The JSON Schema of a file of the results."""
    kind = media_type(name)
    if name in ("report.json", "block_quality.json"):
        return {"$ref": f"{request.base_url}schemas/{name}", "contentMediaType": kind}
    if kind in (JSON, "application/geo+json"):
        return {"type": "object", "contentMediaType": kind}
    encoding = {} if kind.startswith("text/") else {"contentEncoding": "base64"}
    return {"type": "string", "contentMediaType": kind, **encoding}


def _summary(base: str, process: Process) -> dict[str, Any]:
    here = f"{base}processes/{process.id}"
    return {
        "id": process.id,
        "title": process.title,
        "description": process.description,
        "version": VERSION,
        "job_control_options": ["async-execute", "dismiss"],
        "output_transmission": ["value", "reference"],
        "links": [
            Link(rel="self", href=here, type=JSON, title="description of the process"),
            Link(rel=EXECUTE, href=f"{here}/execution", type=JSON, title="execution of the process"),
        ],
    }
