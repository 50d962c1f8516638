"""The routes of the API: callers are known before the body is read, and wait for turns.

Every route replies to HEAD where it replies to GET, to OPTIONS with its methods, and to conditions.
"""

from collections.abc import Callable, Coroutine, Hashable
from functools import partial, wraps
from typing import Any

from fastapi import Request, Response
from fastapi.dependencies.models import Dependant
from fastapi.dependencies.utils import solve_dependencies
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool
from starlette.routing import Match
from starlette.types import Receive, Scope, Send

from amers.app import reserve
from amers.app.api import deps
from amers.app.api.body import ANONYMOUS_BODY_BYTES, body_of
from amers.app.api.conditions import answer_conditions
from amers.app.api.json_bodies import refuse_no_json
from amers.app.api.methods import HEAD, allowed_methods, reply_to_other_method, without_body
from amers.app.api.negotiation import NEGOTIATED
from amers.app.api.open_connections import network_of
from amers.app.api.streams import Streamed
from amers.app.api.turns import Turns
from amers.app.config import Settings
from amers.app.db.tokens import Token

Handler = Callable[[Request], Coroutine[Any, Any, Response]]
Reply = Callable[[], Coroutine[Any, Any, Response]]


class CallerRoute(APIRoute):
    """A route for callers, with or without a token.

    FastAPI reads and parses a body before the dependencies of the endpoint run. This route first
    authenticates the caller and checks the scope that the endpoint needs, then reads the body, and then
    waits for a turn of this caller. A route whose endpoint does not ask for its caller is FastAPI's own.

    An endpoint of GET serves HEAD too, and sees a GET: the reply has the same headers, and its body is
    not made where it would be made piece by piece.
    """

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """Whether the route serves a request, or has its path alone."""
        match, child_scope = super().matches(scope)
        if match is Match.PARTIAL and self._heads(scope):
            match = Match.FULL
        return match, child_scope

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Reply to a request for the path of this route.

        Raises:
            HTTPException: no route of this path has the method (405).
        """
        if self._heads(scope):
            # The server keeps its own scope: it must not believe that it serves a GET.
            await super().handle({**scope, "method": "GET", HEAD: True}, receive, send)
        elif scope["method"] in (self.methods or ()):
            await super().handle(scope, receive, send)
        else:
            await reply_to_other_method(scope)(scope, receive, send)

    def _heads(self, scope: Scope) -> bool:
        """Whether a request is a HEAD that the endpoint of GET serves."""
        methods = self.methods or ()
        return scope["method"] == "HEAD" and "GET" in methods and "HEAD" not in methods

    def get_route_handler(self) -> Handler:
        """The function that replies to requests."""
        return _finishing(self._handler_for_callers(super().get_route_handler()))

    def _handler_for_callers(self, handle: Handler) -> Handler:
        needed = self.dependant.dependencies
        if not any(_uses(dependant, deps.caller_of) for dependant in needed):
            return handle
        takes_upload = any(_uses(dependant, deps.takes_upload) for dependant in needed)
        guards = Dependant(dependencies=[item for item in needed if _uses(item, deps.caller_of)])
        deletes = "DELETE" in (self.methods or ())
        has_body = self.body_field is not None

        async def handle_for_caller(request: Request) -> Response:
            caller = await deps.identify(request)
            reply: Reply = partial(handle, request)
            if has_body:
                await _solve(guards, request)
                if caller is not None:
                    body_of(request).accept_from_caller()
                reply = partial(_check_and_handle, handle, request, await request.body())
            if deletes:
                reply = partial(_without_reserve, reply, request.app.state.settings)
            turns: Turns = request.app.state.uploads if takes_upload else request.app.state.turns
            return await _in_turn(turns, _key(request, caller), reply)

        return handle_for_caller


def _finishing(handle: Handler) -> Handler:
    """A handler whose replies are completed: conditions, HEAD, and what decided on their format."""

    @wraps(handle)
    async def finish(request: Request) -> Response:
        response = await handle(request)
        if NEGOTIATED in request.scope:
            response.headers.add_vary_header("Accept")
        if request.method == "OPTIONS":
            response.headers["Allow"] = ", ".join(allowed_methods(request.scope))
        reply: Response | None = None
        try:
            reply = answer_conditions(request, response)
            if HEAD in request.scope:
                reply = without_body(reply)
        finally:
            if reply is not response and isinstance(response, Streamed):
                await response.discard()
        return reply

    return finish


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
    """The reply of an endpoint to a body, unless it is no JSON.

    A large body is checked in a thread, where it delays nobody else.
    """
    content_type = request.headers.get("content-type")
    if len(body) <= ANONYMOUS_BODY_BYTES:
        refuse_no_json(content_type, body)
    else:
        await run_in_threadpool(refuse_no_json, content_type, body)
    return await handle(request)


async def _without_reserve(reply: Reply, settings: Settings) -> Response:
    """The reply to a deletion; on a full disk it is tried again without the reserve."""
    try:
        return await reply()
    except Exception as error:
        if not reserve.is_full(error) or not await run_in_threadpool(reserve.give_up, settings):
            raise
    return await reply()


def _key(request: Request, caller: Token | None) -> Hashable:
    """Whose turns a request takes: those of its token, or of its address."""
    if caller is not None:
        return caller.id
    return network_of(request.scope["client"][0]) if request.scope.get("client") else None


async def _in_turn(turns: Turns, key: Hashable, handle: Reply) -> Response:
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
