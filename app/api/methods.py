"""Methods that every path has: HEAD wherever GET is, and OPTIONS, which tells the others.

Source: RFC 9110, sections 9.1, 9.3.2, 9.3.7 and 15.5.6.
"""

from fastapi import Response
from fastapi.routing import iter_route_contexts
from starlette.exceptions import HTTPException
from starlette.types import Scope

from amers.app.api.public_address import own_path

HEAD = "amers.head"
"""In the scope of a HEAD that an endpoint of GET serves: the endpoint sees a GET."""


def allowed_methods(scope: Scope) -> list[str]:
    """The methods that the routes of a path have together, sorted."""
    path = own_path(scope)
    methods = {"OPTIONS"}
    for route in iter_route_contexts(scope["app"].routes):
        if route.path_regex.match(path):
            methods |= route.methods or set()
    return sorted(methods | ({"HEAD"} if "GET" in methods else set()))


def reply_to_other_method(scope: Scope) -> Response:
    """The reply to a method that no route of the path has: OPTIONS is told those that there are.

    Raises:
        HTTPException: it is not OPTIONS (405).
    """
    allowed = ", ".join(allowed_methods(scope))
    if scope["method"] == "OPTIONS":
        return Response(status_code=204, headers={"Allow": allowed})
    detail = f"{scope['method']:.20} is no method of this path: one of {allowed} expected"
    raise HTTPException(405, detail, {"Allow": allowed})


def without_body(response: Response) -> Response:
    """A reply with the same status and headers as another one, and without its body."""
    reply = Response(status_code=response.status_code, background=response.background)
    reply.raw_headers = response.raw_headers
    return reply
