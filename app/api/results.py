"""OGC API - Processes: what a job made, told in a document or sent as it is."""

import json
from http import HTTPStatus
from typing import Any
from uuid import uuid4

from fastapi import APIRouter, Request, Response
from fastapi.encoders import jsonable_encoder
from fastapi.responses import JSONResponse

from app import errors
from app.api.deps import DatabaseDep, Reader, StorageDep
from app.api.error_responses import HTTP_STATUS, OGC_EXCEPTIONS, problem
from app.api.files import file_reply
from app.api.jobs import JobId, job_url
from app.api.negotiation import JSON, SCHEMA_JSON
from app.db.jobs.jobs import Job
from app.errors import AmersError
from app.storage import Storage
from app.usecases import jobs, results
from app.usecases.registration.deliverables import media_type
from app.usecases.results import ResultFile
from services import errors as errors_of_science
from services.reports import document

router = APIRouter(tags=["jobs"])


@router.get("/jobs/{job_id}/results", response_class=Response)
def show_results(
    job_id: JobId, request: Request, database: DatabaseDep, storage: StorageDep, caller: Reader
) -> Response:
    """What a job made, as its request asked for: all of it in a document if it said nothing."""
    with database.reading() as connection:
        job = jobs.visible_job(connection, caller, job_id)
    if job.state == "failed":
        return _failed(job)
    if job.state != "successful":
        title = f"The job is {job.state}"
        return problem(404, job.message, title=title, type=f"{OGC_EXCEPTIONS}result-not-ready")
    if job.results_removed_at is not None:
        return problem(410, f"the results were removed on {job.results_removed_at:%Y-%m-%d}")
    values, files = results.requested_results(storage, job)
    if job.response == "raw":
        return _raw(storage, job_url(request, job), values, files)
    here = job_url(request, job)
    told = {
        file.name: results.file_value(storage, file)
        if file.transmission == "value"
        else _link(here, file)
        for file in files
    }
    return JSONResponse(jsonable_encoder({**values, **told}))


@router.get("/jobs/{job_id}/results/{name}", response_class=Response)
def download_result(
    job_id: JobId, name: str, database: DatabaseDep, storage: StorageDep, caller: Reader
) -> Response:
    """One file of the results."""
    with database.reading() as connection:
        job = jobs.visible_job(connection, caller, job_id)
    return file_reply(storage, results.result_key(job, name), media_type(name))


@router.get(
    "/schemas/report.json",
    response_class=Response,
    responses={200: {"description": "A JSON Schema.", "content": {SCHEMA_JSON: {}}}},
)
def report_schema() -> JSONResponse:
    """The JSON Schema of `report.json`, the report of a registration."""
    return JSONResponse(document.report_schema(), media_type=SCHEMA_JSON)


def _link(here: str, file: ResultFile) -> dict[str, str]:
    return {"href": f"{here}/results/{file.name}", "type": file.media_type, "title": file.name}


def _failed(job: Job) -> Response:
    """The reason of a failure, under the status that it would have had as a reply."""
    error = job.error or {"title": "Internal error", "detail": job.message}
    name = error.get("error", "")
    kind: Any = getattr(errors, name, None) or getattr(errors_of_science, name, None)
    told = isinstance(kind, type) and issubclass(kind, AmersError)
    status = next(HTTP_STATUS[k] for k in kind.__mro__ if k in HTTP_STATUS) if told else 500
    said = {key: value for key, value in error.items() if key not in ("type", "status")}
    return problem(status, **{"detail": "the job failed", **said})


def _raw(storage: Storage, here: str, values: dict[str, Any], files: list[ResultFile]) -> Response:
    """Outputs as they are: one alone, several as parts, references alone as links of the header."""
    if not values and all(file.transmission == "reference" for file in files):
        links = [f'<{here}/results/{f.name}>; rel="item"; type="{f.media_type}"' for f in files]
        return Response(status_code=HTTPStatus.NO_CONTENT, headers={"Link": ", ".join(links)})
    if not values and len(files) == 1:
        return file_reply(storage, files[0].key, files[0].media_type)
    parts = [
        (name, {"Content-Type": JSON}, json.dumps(value).encode()) for name, value in values.items()
    ]
    for file in files:
        place = {"Content-Type": file.media_type}
        if file.transmission == "reference":
            parts.append((file.name, {**place, "Content-Location": _link(here, file)["href"]}, b""))
        else:
            parts.append((file.name, place, results.file_bytes(storage, file)))
    if len(parts) == 1:
        _, headers, body = parts[0]
        return Response(body, media_type=headers["Content-Type"])
    return _multipart(parts)


def _multipart(parts: list[tuple[str, dict[str, str], bytes]]) -> Response:
    """Parts that belong together (RFC 2387), each under the name of its output."""
    boundary = uuid4().hex
    body = b""
    for name, headers, content in parts:
        lines = {"Content-ID": f"<{name}>", **headers, "Content-Length": str(len(content))}
        head = "".join(f"{key}: {value}\r\n" for key, value in lines.items())
        body += f"--{boundary}\r\n{head}\r\n".encode() + content + b"\r\n"
    body += f"--{boundary}--\r\n".encode()
    kind = f'multipart/related; boundary="{boundary}"; type="{parts[0][1]["Content-Type"]}"'
    return Response(body, headers={"Content-Type": kind})
