"""The routes of the API: callers are known before the body is read, and wait for turns."""

from collections.abc import Callable, Coroutine, Hashable
from functools import partial
from typing import Any

from fastapi import Request, Response
from fastapi.dependencies.models import Dependant
from fastapi.dependencies.utils import solve_dependencies
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from app.api import deps
from app.api.body import ANONYMOUS_BODY_BYTES, body_of
from app.api.connections import network_of
from app.api.streams import Streamed
from app.api.turns import Turns
from app.db.tokens import Token
from app.json_values import unusable_body

Handler = Callable[[Request], Coroutine[Any, Any, Response]]


class CallerRoute(APIRoute):
    """A route for callers, with or without a token.

    FastAPI reads and parses a body before the dependencies of the endpoint run. This route first
    authenticates the caller and checks the scope that the endpoint needs, then reads the body, and then
    waits for a turn of this caller. A route whose endpoint does not ask for its caller is FastAPI's own.
    """

    def get_route_handler(self) -> Handler:
        """The function that replies to requests."""
        handle = super().get_route_handler()
        needed = self.dependant.dependencies
        if not any(_uses(dependant, deps.caller_of) for dependant in needed):
            return handle
        takes_upload = any(_uses(dependant, deps.takes_upload) for dependant in needed)
        guards = Dependant(dependencies=[item for item in needed if _uses(item, deps.caller_of)])
        has_body = self.body_field is not None

        async def handle_for_caller(request: Request) -> Response:
            caller = await deps.identify(request)
            reply = partial(handle, request)
            if has_body:
                await _solve(guards, request)
                if caller is not None:
                    body_of(request).accept_from_caller()
                reply = partial(_check_and_handle, handle, request, await request.body())
            turns: Turns = request.app.state.uploads if takes_upload else request.app.state.turns
            return await _in_turn(turns, _key(request, caller), reply)

        return handle_for_caller


def _uses(dependant: Dependant, call: Callable[..., Any]) -> bool:
    """Whether a dependency is this function or has it below it."""
    return dependant.call is call or any(_uses(below, call) for below in dependant.dependencies)


async def _solve(guards: Dependant, request: Request) -> None:
    """Run the dependencies that refuse callers; what they return is computed again with the others."""
    await solve_dependencies(
        request=request,
        dependant=guards,
        async_exit_stack=request.scope["fastapi_inner_astack"],
        embed_body_fields=False,
    )


async def _check_and_handle(handle: Handler, request: Request, body: bytes) -> Response:
    """The reply of an endpoint to a JSON body, unless the body has a value that JSON does not have.

    A large body is checked in a thread, where it delays nobody else.
    """
    if len(body) <= ANONYMOUS_BODY_BYTES:
        problem = unusable_body(body)
    else:
        problem = await run_in_threadpool(unusable_body, body)
    if problem is not None:
        raise HTTPException(422, problem)
    return await handle(request)


def _key(request: Request, caller: Token | None) -> Hashable:
    """Whose turns a request takes: those of its token, or of its address."""
    if caller is not None:
        return caller.id
    return network_of(request.scope["client"][0]) if request.scope.get("client") else None


async def _in_turn(
    turns: Turns, key: Hashable, handle: Callable[[], Coroutine[Any, Any, Response]]
) -> Response:
    """The reply of an endpoint; a reply in pieces keeps the turn while it reads from the database."""
    await turns.take(key)
    response = None
    try:
        response = await handle()
    finally:
        if isinstance(response, Streamed):
            response.on_release = partial(turns.release, key)
        else:
            turns.release(key)
    return response
