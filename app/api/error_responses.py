"""Replies to errors: problem details of RFC 9457. No other module knows errors and HTTP statuses."""

import logging
from http import HTTPStatus
from typing import Any

import psycopg
from fastapi import FastAPI, Request
from fastapi.encoders import jsonable_encoder
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from amers.app.api.credentials import challenges
from amers.app.errors import (
    AmersError,
    ComputationError,
    Conflict,
    DamagedFile,
    InputError,
    InvalidParameter,
    NoSuchJob,
    NoSuchProcess,
    NotAllowed,
    NotFound,
    StorageOutage,
    TooLarge,
    TooMany,
)
from amers.app.json_values import usable
from amers.app.outages import outage_of
from amers.app.usecases.damage import report_damage

PROBLEM_JSON = "application/problem+json"
HTTP_STATUS: dict[type[Exception], int] = {
    InputError: 422,
    InvalidParameter: 400,
    ComputationError: 409,
    Conflict: 409,
    NotFound: 404,
    TooLarge: 413,
    TooMany: 429,
    AmersError: 500,
}
OGC_EXCEPTIONS = "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0/"
PROBLEM_TYPES: dict[type[Exception], str] = {
    NoSuchJob: f"{OGC_EXCEPTIONS}no-such-job",
    NoSuchProcess: f"{OGC_EXCEPTIONS}no-such-process",
}
UNUSABLE = (None, "22003", "22021", "22P05")
"""SQLSTATEs of numbers and characters that PostgreSQL cannot store; None: the driver refused them."""
RETRY = {"Retry-After": "5"}
HEADERS = {429: RETRY}
MOST_SHOWN = 200

log = logging.getLogger(__name__)


def install(app: FastAPI) -> None:
    """Reply to every error of an application with problem details."""
    app.add_exception_handler(AmersError, _refused)
    app.add_exception_handler(DamagedFile, _damaged)
    app.add_exception_handler(RequestValidationError, _malformed)
    app.add_exception_handler(HTTPException, _not_routed)
    for kind in (psycopg.Error, OSError, StorageOutage):
        app.add_exception_handler(kind, _failed)
    app.add_exception_handler(Exception, _unexpected)


def problem(
    status: int,
    detail: str,
    *,
    title: str | None = None,
    headers: dict[str, str] | None = None,
    **more: Any,
) -> JSONResponse:
    """A reply with problem details.

    Args:
        status: HTTP status.
        detail: what is wrong with this request, with its numbers.
        title: kind of problem; by default the name of the status.
        more: members beside the standard ones.
    """
    body = {
        "type": "about:blank",
        "title": title or HTTPStatus(status).phrase,
        "status": status,
        "detail": detail,
    }
    return JSONResponse(
        usable(jsonable_encoder({**body, **more})), status, headers, media_type=PROBLEM_JSON
    )


def status_of(error: AmersError) -> int:
    """The HTTP status of an error of Amers."""
    if isinstance(error, NotAllowed):
        return 403 if error.authenticated else 401
    return next(HTTP_STATUS[kind] for kind in type(error).__mro__ if kind in HTTP_STATUS)


def _refused(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, AmersError)
    status = status_of(error)
    headers = HEADERS.get(status)
    kind = {"type": PROBLEM_TYPES[type(error)]} if type(error) in PROBLEM_TYPES else {}
    reply = problem(status, str(error), headers=headers, error=type(error).__name__, **kind)
    if status == HTTPStatus.UNAUTHORIZED:
        # Each in a header of its own: some clients understand only the first of a list.
        for challenge in challenges(request.headers):
            reply.headers.append("WWW-Authenticate", challenge)
    return reply


def _damaged(request: Request, error: Exception) -> JSONResponse:
    """The reply to damage in the storage, which the operator has to repair."""
    assert isinstance(error, DamagedFile)
    try:
        request.app.state.storage.prove()
    except StorageOutage as outage:
        return _failed(request, outage)
    if not report_damage(request.app.state.database, error):
        return problem(404, f"{error.key} was removed meanwhile", error=NotFound.__name__)
    return problem(500, str(error), error=DamagedFile.__name__)


def _malformed(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    wrong = [
        {"field": ".".join(map(str, item["loc"])), "message": _message(item)} for item in error.errors()
    ]
    detail = "; ".join(f"{item['field']}: {item['message']}" for item in wrong)
    names = [f"{item['loc'][-1]} {item['input']!r:.60}" for item in error.errors() if _in_path(item)]
    if names:
        return problem(404, f"there is no {', '.join(names)}", error=NotFound.__name__, errors=wrong)
    places = {item["loc"][0] for item in error.errors()}
    # OGC API requires 400 for a wrong parameter of the query; a wrong body is 422.
    return problem(422 if "body" in places else 400, detail, error="InputError", errors=wrong)


def _in_path(item: dict[str, Any]) -> bool:
    """Whether an error is about a part of the path, which then names nothing."""
    return bool(item["loc"][0] == "path")


def _message(item: dict[str, Any]) -> str:
    """What is wrong with one value, and for what is no JSON, what the parser found there."""
    if item["type"] == "json_invalid":
        return f"{item['msg']}: {item['ctx']['error']}"
    if item["type"] == "missing" and item["loc"] == ("body",):
        return "the body is empty: send JSON with the header Content-Type: application/json"
    return str(item["msg"])


def _not_routed(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    headers = dict(error.headers) if error.headers else None
    detail = str(error.detail)
    if detail == HTTPStatus.NOT_FOUND.phrase:
        # No route: a proxy may pass on a path that the service does not know to be its own.
        path, base = request.url.path[:MOST_SHOWN], request.base_url
        detail = (
            f"nothing is at {path!r}; the paths of this service begin with {base} (AMERS_PUBLIC_URL)"
        )
    return problem(error.status_code, detail, headers=headers)


def _failed(request: Request, error: Exception) -> JSONResponse:
    """The reply to an outage, to a value that no column can store, or to a bug."""
    outage = outage_of(error)
    if outage is None:
        return _unusable(request, error)
    what = f"{request.method} {request.url.path}: {outage.reason}"
    if outage.again:
        log.warning("%s", what)
    else:
        log.error("%s", what, exc_info=error)
    detail = f"{outage.reason}; try again" if outage.again else outage.reason
    return problem(outage.status, detail, headers=RETRY if outage.again else None)


def _unusable(request: Request, error: Exception) -> JSONResponse:
    """The reply to a value that no column can store, as a NUL in a text; other errors are bugs."""
    if not isinstance(error, psycopg.DataError) or error.sqlstate not in UNUSABLE:
        log.error("%s %s failed", request.method, request.url.path, exc_info=error)
        return _unexpected(request, error)
    first_line = str(error).partition("\n")[0]
    log.warning("%s %s: %s", request.method, request.url.path, first_line)
    detail = f"a value of this request cannot be used: {first_line}"
    if "\0" in request.scope["path"]:
        return problem(404, f"nothing has this path: {detail}", error=NotFound.__name__)
    return problem(400, detail, error=InvalidParameter.__name__)


def _unexpected(request: Request, error: Exception) -> JSONResponse:
    """The reply to a bug or an outage: no details, which the log has with their trace."""
    request_id = getattr(request.state, "request_id", None)
    # This reply is made outside of all middleware.
    headers = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
    if request_id is not None:
        headers["X-Request-ID"] = request_id
    return problem(500, "an unexpected error; the service has logged it", headers=headers)
