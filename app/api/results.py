"""OGC API - Processes: the results of a job, in one document or as they are."""

import json
from http import HTTPStatus
from typing import Any
from uuid import uuid4

from fastapi import APIRouter, Request, Response
from fastapi.encoders import jsonable_encoder
from fastapi.responses import JSONResponse

from amers.app import errors
from amers.app.api.access import Public
from amers.app.api.deps import DatabaseDep, Reader, StorageDep
from amers.app.api.error_responses import HTTP_STATUS, OGC_EXCEPTIONS, problem
from amers.app.api.files import file_reply
from amers.app.api.jobs import JobId, job_url
from amers.app.api.models.jobs import ResultFile
from amers.app.api.negotiation import JSON, SCHEMA_JSON
from amers.app.api.routes import CallerRoute
from amers.app.db.jobs.jobs import Job
from amers.app.errors import AmersError
from amers.app.storage import Storage
from amers.app.usecases import jobs, results
from amers.app.usecases.media_types import media_type
from amers.services import errors as errors_of_science
from amers.services.reports import document

router = APIRouter(tags=["jobs"], route_class=CallerRoute)

Part = tuple[str, dict[str, str], bytes]
"""Name, headers and content of a part of a multipart reply."""


@router.get(
    "/jobs/{job_id}/results",
    response_class=Response,
    responses={
        200: {
            "description": "The results in a document, or an output as it is.",
            "model": dict[str, ResultFile | Any],
            "content": {"*/*": {}},
        }
    },
)
def show_results(
    *, job_id: JobId, request: Request, database: DatabaseDep, storage: StorageDep, caller: Reader
) -> Response:
    """Return the results of a job as its request asked for them; by default all in one document."""
    with database.reading() as connection:
        job = jobs.visible_job(connection, caller, job_id)
    if job.state == "failed":
        return _failure_reply(job)
    if job.state != "successful":
        title = f"The job is {job.state}"
        return problem(404, job.message, title=title, type=f"{OGC_EXCEPTIONS}result-not-ready")
    if job.results_removed_at is not None:
        return problem(410, f"the results were removed on {job.results_removed_at:%Y-%m-%d}")
    here = job_url(request, job)
    values, files = results.requested_results(storage, job)
    if job.response == "raw":
        return _raw_reply(request, storage, here, values, files)
    members = {
        file.name: results.file_value(storage, file)
        if file.transmission == "value"
        else _result_file(here, file).model_dump()
        for file in files
    }
    return JSONResponse(jsonable_encoder({**values, **members}))


@router.get("/jobs/{job_id}/results/{name:path}", response_class=Response)
def download_result(
    *,
    job_id: JobId,
    name: str,
    request: Request,
    database: DatabaseDep,
    storage: StorageDep,
    caller: Reader,
) -> Response:
    """Return one file of the results; of scenes registered together its name is `SCENE/NAME`."""
    with database.reading() as connection:
        job = jobs.visible_job(connection, caller, job_id)
    return file_reply(request, storage, results.result_key(job, name), media_type(name), name)


@router.get(
    "/schemas/report.json",
    dependencies=[Public],
    response_class=Response,
    responses={200: {"description": "A JSON Schema.", "content": {SCHEMA_JSON: {}}}},
)
def report_schema() -> JSONResponse:
    """Return the JSON Schema of `report.json`, the report of a registration."""
    return JSONResponse(document.report_schema(), media_type=SCHEMA_JSON)


@router.get(
    "/schemas/failure.json",
    dependencies=[Public],
    response_class=Response,
    responses={200: {"description": "A JSON Schema.", "content": {SCHEMA_JSON: {}}}},
)
def failure_schema() -> JSONResponse:
    """Return the JSON Schema of the `report.json` of a registration that failed."""
    return JSONResponse(document.failure_schema(), media_type=SCHEMA_JSON)


@router.get(
    "/schemas/joint.json",
    dependencies=[Public],
    response_class=Response,
    responses={200: {"description": "A JSON Schema.", "content": {SCHEMA_JSON: {}}}},
)
def joint_schema() -> JSONResponse:
    """Return the JSON Schema of the `report.json` of scenes registered together."""
    return JSONResponse(document.joint_schema(), media_type=SCHEMA_JSON)


@router.get(
    "/schemas/block_quality.json",
    dependencies=[Public],
    response_class=Response,
    responses={200: {"description": "A JSON Schema.", "content": {SCHEMA_JSON: {}}}},
)
def block_quality_schema() -> JSONResponse:
    """Return the JSON Schema of `block_quality.json`, the report on the quality of a block."""
    return JSONResponse(document.block_quality_schema(), media_type=SCHEMA_JSON)


def _result_file(here: str, file: results.ResultFile) -> ResultFile:
    return ResultFile(href=f"{here}/results/{file.name}", type=file.media_type, title=file.name)


def _failure_reply(job: Job) -> Response:
    """The error of a failed job, with the status that the error has in a reply."""
    error = job.error or {"title": "Internal error", "detail": job.message}
    name = error.get("error", "")
    kind: Any = getattr(errors, name, None) or getattr(errors_of_science, name, None)
    is_ours = isinstance(kind, type) and issubclass(kind, AmersError)
    status = next(HTTP_STATUS[k] for k in kind.__mro__ if k in HTTP_STATUS) if is_ours else 500
    members = {key: value for key, value in error.items() if key not in ("type", "status")}
    return problem(status, **{"detail": "the job failed", **members})


def _raw_reply(
    request: Request,
    storage: Storage,
    here: str,
    values: dict[str, Any],
    files: list[results.ResultFile],
) -> Response:
    """Outputs as they are: one as the body, several as parts, references alone in the header Link."""
    if not values and all(file.transmission == "reference" for file in files):
        links = [f'<{here}/results/{f.name}>; rel="item"; type="{f.media_type}"' for f in files]
        return Response(status_code=HTTPStatus.NO_CONTENT, headers={"Link": ", ".join(links)})
    if not values and len(files) == 1:
        return file_reply(request, storage, files[0].key, files[0].media_type, files[0].name)
    parts: list[Part] = [
        (name, {"Content-Type": JSON}, json.dumps(value).encode()) for name, value in values.items()
    ]
    for file in files:
        headers = {"Content-Type": file.media_type}
        if file.transmission == "reference":
            headers["Content-Location"] = _result_file(here, file).href
            parts.append((file.name, headers, b""))
        else:
            parts.append((file.name, headers, results.file_bytes(storage, file)))
    if len(parts) == 1:
        _, headers, body = parts[0]
        return Response(body, media_type=headers["Content-Type"])
    return _multipart_reply(parts)


def _multipart_reply(parts: list[Part]) -> Response:
    """Outputs as the parts of a multipart/related body (RFC 2387), each with the name of its output."""
    boundary = uuid4().hex
    body = b""
    for name, headers, content in parts:
        lines = {"Content-ID": f"<{name}>", **headers, "Content-Length": str(len(content))}
        head = "".join(f"{key}: {value}\r\n" for key, value in lines.items())
        body += f"--{boundary}\r\n{head}\r\n".encode() + content + b"\r\n"
    body += f"--{boundary}--\r\n".encode()
    kind = f'multipart/related; boundary="{boundary}"; type="{parts[0][1]["Content-Type"]}"'
    return Response(body, headers={"Content-Type": kind})
