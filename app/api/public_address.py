"""The address of the service in its replies, where the operator states it.

Links, redirects, cookies and the description of the API follow what ASGI says of a request: its scheme,
its header `Host` and its `root_path`, by `request.base_url` and `request.url`. So a public address is
set there, once, and nowhere else.
"""

import logging
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

from amers.app.public_url import DEFAULT_PORTS
from amers.app.usecases.readiness import OK, Part

MOST_SHOWN = 200

log = logging.getLogger(__name__)


class PublicAddress:
    """Middleware that gives every request the public address, whatever a proxy has made of it.

    A proxy removes the public path from a request or passes it on: both are the same request.

    Attributes:
        app: the application that gets the requests.
    """

    def __init__(self, app: ASGIApp, url: str) -> None:
        """Args:
        url: as `normal_public_url` returns it.
        """
        self.app = app
        parts = urlsplit(url)
        self._scheme = parts.scheme
        self._host = (b"host", parts.netloc.encode())
        self._path = parts.path.rstrip("/")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request. Middleware around this one sees the public address too."""
        if scope["type"] == "http":
            path: str = scope["path"]
            if path == self._path:
                path = "/"
            scope["path"] = path if path.startswith(f"{self._path}/") else f"{self._path}{path}"
            scope["root_path"] = self._path
            scope["scheme"] = self._scheme
            scope["headers"] = [self._host, *(item for item in scope["headers"] if item[0] != b"host")]
            scope.pop("raw_path", None)
        await self.app(scope, receive, send)


def own_path(scope: Scope) -> str:
    """The path of a request below the address of the service."""
    path: str = scope["path"]
    return path.removeprefix(scope.get("root_path", ""))


def address_state(request: Request) -> Part:
    """Whether links in replies lead back to where this request came from.

    A proxy states that in `X-Forwarded-Proto`, `-Host` and `-Prefix`, and the caller's address in
    `X-Forwarded-For`. What is stated is compared with what the service uses, and with nothing that
    others have sent: a caller who forges these headers is the only one who reads of it.
    """
    used, headers = request.base_url, request.headers
    links = _address(used.scheme, used.netloc, used.path)
    stated = _address(
        _first(headers, "x-forwarded-proto") or used.scheme,
        _first(headers, "x-forwarded-host") or used.netloc,
        _first(headers, "x-forwarded-prefix") or used.path,
    )
    if stated != links:
        return Part(
            "degraded",
            f"this request was made to {stated[:MOST_SHOWN]!a} by what its proxy states, but links in "
            f"replies begin with {links[:MOST_SHOWN]!a}: set AMERS_PUBLIC_URL to the address that "
            "callers use, and name the proxy in AMERS_TRUSTED_PROXIES",
        )
    callers = ",".join(headers.getlist("x-forwarded-for"))
    if callers and request.client is not None and request.client.host not in callers:
        return Part(
            "degraded",
            "a proxy states its caller in X-Forwarded-For, but AMERS_TRUSTED_PROXIES does not name the "
            "proxy: all its callers share the connections and turns of one; name its address there",
        )
    return OK


def log_wrong_address(request: Request) -> None:
    """Log that links would not lead back to where a request came from, once in the life of a process."""
    state = request.app.state
    if getattr(state, "has_logged_address", False):
        return
    part = address_state(request)
    if part != OK:
        state.has_logged_address = True
        peer = request.client.host if request.client is not None else "unknown"
        log.warning("%s: a request from %s: %s", request.url.path, peer, part.reason)


def _address(scheme: str, host: str, path: str) -> str:
    """An address in a form that can be compared: without a default port, with a slash at its end."""
    scheme, path = scheme.lower(), path.strip("/")
    host = host.lower().removesuffix(DEFAULT_PORTS.get(scheme, ""))
    return f"{scheme}://{host}/{path}/" if path else f"{scheme}://{host}/"


def _first(headers: Headers, name: str) -> str:
    """The first of the values of a header, which the outermost proxy has stated; "" without one."""
    return headers.get(name, "").partition(",")[0].strip()
