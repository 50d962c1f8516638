"""OGC API - Processes: what the service can be asked to do, and asking."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Header, Query, Request, Response, status
from pydantic import BaseModel, ConfigDict, Field

from app.api.deps import DatabaseDep, Reader, SettingsDep
from app.api.jobs import job_url, status_info
from app.errors import InputError
from app.usecases import jobs
from app.usecases.jobs import JobRequest
from app.usecases.processes import Process
from app.usecases.registration.deliverables import media_type

router = APIRouter(tags=["processes"])

VERSION = "1.0.0"
JSON = "application/json"
OGC = "http://www.opengis.net/spec/ogcapi-processes-1/1.0/conf/"
CONFORMS_TO = tuple(
    f"{OGC}{name}" for name in ("core", "ogc-process-description", "json", "job-list", "dismiss")
)
QUALIFIERS = {"value", "mediaType", "encoding", "schema", "format"}
"""Members of an input whose value is told with what it is."""
SCENES = ("scenes/", "collections/scenes/items/")


class OutputAsked(BaseModel):
    """How one output shall be told."""

    model_config = ConfigDict(extra="forbid", populate_by_name=True)

    transmission_mode: Literal["value", "reference"] = Field("value", alias="transmissionMode")
    format: dict[str, Any] | None = Field(None, description="Each output has one format: its own.")


class Execute(BaseModel):
    """The body of an execution.

    Attributes:
        inputs: those of the process, by name.
        outputs: those wanted, by name, files by value unless said otherwise; all of them, files by
            reference, if there is none.
        response: results in one document, or as they are.
    """

    model_config = ConfigDict(extra="forbid")

    inputs: dict[str, Any] = Field(default_factory=dict)
    outputs: dict[str, OutputAsked] | None = None
    response: Literal["document", "raw"] = "document"


@router.get("/processes")
def list_processes(
    request: Request,
    limit: Annotated[int, Query(ge=1, le=1000, description="Most processes on the page.")] = 10,
    offset: Annotated[int, Query(ge=0, le=1000, description="From the link `next`.")] = 0,
) -> dict[str, Any]:
    """The processes, in short."""
    base = str(request.base_url)
    every = list(jobs.PROCESSES.values())
    links = [{"rel": "self", "href": str(request.url), "type": JSON}]
    if offset + limit < len(every):
        following = str(request.url.include_query_params(offset=offset + limit))
        links.append({"rel": "next", "href": following, "type": JSON})
    page = every[offset : offset + limit]
    return {"processes": [_summary(base, process) for process in page], "links": links}


@router.get("/processes/{process_id}")
def describe_process(process_id: str, request: Request) -> dict[str, Any]:
    """One process with its inputs and outputs."""
    process = jobs.find_process(process_id)
    schema = process.input_schema()
    required = schema.get("required", [])
    descriptions = process.input_descriptions()
    inputs = {
        name: {
            "title": name,
            **({"description": descriptions[name]} if name in descriptions else {}),
            "minOccurs": 1 if name in required else 0,
            "schema": inlined(member, schema.get("$defs", {})),
        }
        for name, member in schema["properties"].items()
    }
    outputs = {
        name: {"title": value["title"], "schema": value} for name, value in process.values.items()
    }
    for name, text in process.outputs.items():
        outputs[name] = {"title": name, "description": text, "schema": _file_schema(request, name)}
    return {**_summary(str(request.base_url), process), "inputs": inputs, "outputs": outputs}


@router.post("/processes/{process_id}/execution", status_code=status.HTTP_201_CREATED)
def execute(
    process_id: str,
    body: Execute,
    request: Request,
    response: Response,
    database: DatabaseDep,
    settings: SettingsDep,
    caller: Reader,
    idempotency_key: Annotated[str | None, Header()] = None,
    prefer: Annotated[str | None, Header()] = None,
) -> dict[str, Any]:
    """Ask for work; the answer is a job to watch, whatever `Prefer` says.

    The same request with the same `Idempotency-Key` asks for it once.
    """
    inputs = {name: _plain(request, name, value) for name, value in body.inputs.items()}
    asked = body.outputs
    outputs = None if asked is None else {name: one.transmission_mode for name, one in asked.items()}
    with database.transaction() as connection:
        job_request = JobRequest(process_id, inputs, outputs, body.response)
        job = jobs.execute(connection, settings, caller, job_request, idempotency_key)
    response.headers["Location"] = job_url(request, job)
    if "respond-async" in (prefer or ""):
        response.headers["Preference-Applied"] = "respond-async"
    return status_info(request, job)


def _plain(request: Request, name: str, value: Any) -> Any:
    """The value of an input that is told as such, with what it is, or as a link to something of ours.

    Raises:
        InputError: the link leads elsewhere; nothing is fetched.
    """
    if not isinstance(value, dict):
        return value
    if "value" in value and value.keys() <= QUALIFIERS:
        return value["value"]
    if "href" not in value:
        return value
    path = str(value["href"]).removeprefix(str(request.base_url))
    known = next((path.removeprefix(start) for start in SCENES if path.startswith(start)), "")
    if not known or "/" in known:
        raise InputError(f"inputs.{name}.href: only scenes of this service are taken by reference")
    return known


def inlined(schema: Any, definitions: dict[str, Any]) -> Any:
    """A JSON Schema that needs no definitions from elsewhere; ours never name themselves."""
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
    """What a file of the results holds."""
    kind = media_type(name)
    if name == "report.json":
        return {"$ref": f"{request.base_url}schemas/report.json", "contentMediaType": kind}
    if kind in (JSON, "application/geo+json"):
        return {"type": "object", "contentMediaType": kind}
    encoded = {} if kind.startswith("text/") else {"contentEncoding": "base64"}
    return {"type": "string", "contentMediaType": kind, **encoded}


def _summary(base: str, process: Process) -> dict[str, Any]:
    here = f"{base}processes/{process.id}"
    execute = "http://www.opengis.net/def/rel/ogc/1.0/execute"
    return {
        "id": process.id,
        "title": process.title,
        "description": process.description,
        "version": VERSION,
        "jobControlOptions": ["async-execute", "dismiss"],
        "outputTransmission": ["value", "reference"],
        "links": [
            {"rel": "self", "href": here, "type": JSON, "title": "its description"},
            {"rel": execute, "href": f"{here}/execution", "type": JSON, "title": "where to ask for it"},
        ],
    }
