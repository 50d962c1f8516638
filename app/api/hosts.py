"""Hosts under which the service may be addressed.

Without a public address, links in replies are built from the header `Host`.

Source: RFC 9112, section 3.2.
"""

import re
import socket
from collections.abc import Iterable
from urllib.parse import urlsplit

from starlette.types import ASGIApp, Receive, Scope, Send

from amers.app.api.error_responses import problem
from amers.app.config import Settings

HOST = re.compile(r"([A-Za-z0-9._~\-]+|\[[0-9A-Fa-f:.]+\])(:[0-9]*)?")
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
            fault = self._fault(scope)
            if fault is not None:
                await problem(400, f"Host: {fault}")(scope, receive, send)
                return
        await self.app(scope, receive, send)

    def _fault(self, scope: Scope) -> str | None:
        """What is wrong with the header; None for a name of this service."""
        hosts = [value.decode("latin-1") for name, value in scope["headers"] if name == b"host"]
        if len(hosts) != 1:
            # HTTP/1.0 knew no such header.
            if not hosts and scope.get("http_version") != "1.1":
                return None
            return f"{len(hosts)} such headers found, one expected"
        arrived_at = scope["server"][0] if scope.get("server") else ""
        if HOST.fullmatch(hosts[0].strip()) and self._accepts(_name_of(hosts[0]), arrived_at):
            return None
        return (
            f"{hosts[0][:100]!r} is no name of this service; "
            "its operator states its public address in AMERS_PUBLIC_URL, further names in "
            "AMERS_TRUSTED_HOSTS"
        )

    def _accepts(self, name: str, arrived_at: str) -> bool:
        if name in self.names or "*" in self.names or name == arrived_at.lower():
            return True
        return any(f"*{name[dot:]}" in self.names for dot in _dots(name))


def _name_of(host: str) -> str:
    """The name in a header `Host`, without port and without the brackets of an IPv6 address."""
    host = host.strip().lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]


def _dots(name: str) -> Iterable[int]:
    return [position for position, letter in enumerate(name) if letter == "."]
