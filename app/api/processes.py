"""OGC API - Processes: what the service can be asked to do, and asking."""

from dataclasses import dataclass, field
from typing import Annotated, Any

from fastapi import APIRouter, Header, Request, Response, status

from app.api.deps import Reader, SettingsDep, WriteConnection
from app.api.jobs import job_url, status_info
from app.usecases import jobs
from app.usecases.processes import Process

router = APIRouter(tags=["processes"])

VERSION = "1.0.0"


@dataclass(frozen=True)
class Execute:
    """The body of an execution.

    Attributes:
        inputs: those of the process, by name.
    """

    inputs: dict[str, Any] = field(default_factory=dict)


@router.get("/processes")
def list_processes(request: Request) -> dict[str, Any]:
    """The processes, in short."""
    base = str(request.base_url)
    return {
        "processes": [_summary(base, process) for process in jobs.PROCESSES.values()],
        "links": [{"rel": "self", "href": f"{base}processes", "type": "application/json"}],
    }


@router.get("/processes/{process_id}")
def describe_process(process_id: str, request: Request) -> dict[str, Any]:
    """One process with its inputs and outputs."""
    process = jobs.find_process(process_id)
    schema = process.input_schema()
    definitions = schema.get("$defs", {})
    required = schema.get("required", [])
    inputs = {
        name: {
            "title": name,
            "minOccurs": 1 if name in required else 0,
            "schema": {**member, "$defs": definitions} if "$ref" in str(member) else member,
        }
        for name, member in schema["properties"].items()
    }
    outputs = {
        name: {"title": text, "schema": {"type": "string", "format": "uri"}}
        for name, text in process.outputs.items()
    }
    return {**_summary(str(request.base_url), process), "inputs": inputs, "outputs": outputs}


@router.post("/processes/{process_id}/execution", status_code=status.HTTP_201_CREATED)
def execute(
    process_id: str,
    body: Execute,
    request: Request,
    response: Response,
    connection: WriteConnection,
    settings: SettingsDep,
    caller: Reader,
    idempotency_key: Annotated[str | None, Header()] = None,
) -> dict[str, Any]:
    """Ask for work; the answer is a job to watch.

    The same request with the same `Idempotency-Key` asks for it once.
    """
    job = jobs.execute(connection, settings, caller, process_id, body.inputs, idempotency_key)
    response.headers["Location"] = job_url(request, job)
    response.headers["Preference-Applied"] = "respond-async"
    return status_info(request, job)


def _summary(base: str, process: Process) -> dict[str, Any]:
    here = f"{base}processes/{process.id}"
    return {
        "id": process.id,
        "title": process.title,
        "description": process.description,
        "version": VERSION,
        "jobControlOptions": ["async-execute", "dismiss"],
        "outputTransmission": ["reference"],
        "links": [
            {"rel": "self", "href": here, "type": "application/json"},
            {
                "rel": "http://www.opengis.net/def/rel/ogc/1.0/execute",
                "href": f"{here}/execution",
                "type": "application/json",
            },
        ],
    }
