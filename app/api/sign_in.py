"""Sign-in and sign-out of browsers, for the HTML pages."""

import time
from contextlib import suppress
from urllib.parse import parse_qs

from fastapi import APIRouter, Request, Response
from fastapi.responses import RedirectResponse
from starlette.concurrency import run_in_threadpool

from amers.app.api.credentials import refuse_other_sites
from amers.app.api.deps import DatabaseDep, SecretDep
from amers.app.api.negotiation import refuse_unknown
from amers.app.api.pages import Page, document_page
from amers.app.api.routes import CallerRoute
from amers.app.api.session_cookie import (
    COOKIE,
    LIFETIME_S,
    Session,
    format_session,
    parse_session,
    removal,
)
from amers.app.auth import authenticate
from amers.app.db.engine import Database
from amers.app.db.tokens import Token, end_session
from amers.app.errors import NotAllowed

router = APIRouter(include_in_schema=False, route_class=CallerRoute)

PAGE = Page(
    "Sign in",
    "The pages then show what your token may read, for an hour and in this browser alone.",
)


@router.get("/sign-in")
def form(request: Request) -> Response:
    """Return the page with the form."""
    refuse_unknown(request, set())
    return document_page(request, PAGE, "sign_in.html", fault="")


@router.post("/sign-in")
async def sign_in(request: Request, database: DatabaseDep, secret: SecretDep) -> Response:
    """Open a session for the token of the form."""
    refuse_other_sites(request)
    fields = parse_qs((await request.body()).decode(errors="replace"))
    try:
        token = await run_in_threadpool(_token, database, fields.get("token", [""])[0].strip())
    except NotAllowed as refused:
        reply: Response = document_page(request, PAGE, "sign_in.html", fault=str(refused))
        reply.status_code = 403
        return reply
    reply = RedirectResponse(request.base_url, 303)
    reply.set_cookie(
        COOKIE,
        format_session(token.id, time.time(), secret),
        max_age=LIFETIME_S,
        path=request.base_url.path,
        secure=request.url.scheme == "https",
        httponly=True,
        samesite="lax",
    )
    return reply


@router.post("/sign-out")
async def sign_out(request: Request, database: DatabaseDep, secret: SecretDep) -> Response:
    """End the session, here and in this browser."""
    refuse_other_sites(request)
    with suppress(NotAllowed):
        session = parse_session(request.cookies.get(COOKIE, ""), time.time(), secret)
        await run_in_threadpool(_end, database, session)
    reply = RedirectResponse(request.base_url, 303)
    reply.headers["Set-Cookie"] = removal(request.base_url.path)
    return reply


def _end(database: Database, session: Session) -> None:
    with database.transaction() as connection:
        end_session(connection, session.id, session.ends_at)


def _token(database: Database, secret: str) -> Token:
    with database.reading() as connection:
        return authenticate(connection, secret)
