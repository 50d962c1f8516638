"""Hosts under which the service may be addressed.

Without a public address, links in replies are built from the header `Host`.
"""

import socket
from collections.abc import Iterable
from urllib.parse import urlsplit

from starlette.types import ASGIApp, Receive, Scope, Send

from app.api.error_responses import problem
from app.config import Settings

LOOPBACK = ("localhost", "127.0.0.1", "::1")


class TrustedHosts:
    """Middleware that refuses requests whose `Host` is not a name of this service.

    Without this check, a page of another site whose name is bound to the address of the service could
    read from it (DNS rebinding), and links in replies could lead to another site. Accepted are the
    loopback names, the name of the machine, the address that the connection has arrived at, the host of
    the settings, that of the public address and the trusted hosts of the settings.

    Attributes:
        app: the application that gets the accepted requests.
        names: accepted names, in lower case; `*` for all, `*.example.org` for all below a domain.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app = app
        public = urlsplit(settings.public_url or "").hostname or settings.host
        own = (*LOOPBACK, settings.host, public, socket.gethostname())
        self.names = frozenset(name.lower() for name in (*own, *settings.trusted_hosts))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] == "http":
            arrived_at = scope["server"][0] if scope.get("server") else ""
            for value in _hosts(scope):
                if not self._accepts(_name_of(value), arrived_at):
                    reply = problem(
                        400,
                        f"Host: {value[:100]!r} is no name of this service; "
                        "its operator lists its public names in AMERS_TRUSTED_HOSTS",
                    )
                    await reply(scope, receive, send)
                    return
        await self.app(scope, receive, send)

    def _accepts(self, name: str, arrived_at: str) -> bool:
        if name in self.names or "*" in self.names or name == arrived_at.lower():
            return True
        return any(f"*{name[dot:]}" in self.names for dot in _dots(name))


def _hosts(scope: Scope) -> Iterable[str]:
    return [value.decode("latin-1") for name, value in scope["headers"] if name == b"host"]


def _name_of(host: str) -> str:
    """The name in a header `Host`, without port and without the brackets of an IPv6 address."""
    host = host.strip().lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]


def _dots(name: str) -> Iterable[int]:
    return [position for position, letter in enumerate(name) if letter == "."]
