"""Headers of all replies: whether they may be stored, and that browsers must not guess their type."""

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from amers.app.api.credentials import browser_may_have_added
from amers.app.api.session_cookie import ENDED_SESSION, removal
from amers.app.config import Settings

NO_STORE = "no-store"
FIRST_ERROR = 400
STRICT_TRANSPORT = "max-age=31536000"
"""A year, RFC 6797. It is about this host alone: other hosts of the domain may be of others."""


class ReplyHeaders:
    """Middleware that adds `X-Content-Type-Options: nosniff` and `Cache-Control: no-store`.

    A successful reply that states its own `Cache-Control` keeps it: tiles, chips and the map page. What
    is sent to a password or a session is not embedded by other sites:
    `Cross-Origin-Resource-Policy: same-origin`. The cookie of a session that has ended is removed.

    Where the public address begins with https, `Strict-Transport-Security` keeps browsers from its host
    without TLS.

    Attributes:
        app: the application that gets the requests.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app = app
        self._only_tls = (settings.public_url or "").startswith("https:")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        by_browser = browser_may_have_added(Headers(scope=scope))

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers["X-Content-Type-Options"] = "nosniff"
                if self._only_tls:
                    headers["Strict-Transport-Security"] = STRICT_TRANSPORT
                if by_browser:
                    # A browser sends it with images that other sites embed, too.
                    headers["Cross-Origin-Resource-Policy"] = "same-origin"
                if ENDED_SESSION in scope.get("state", ()):
                    headers.append("Set-Cookie", removal(Request(scope).base_url.path))
                if message["status"] >= FIRST_ERROR or "Cache-Control" not in headers:
                    headers["Cache-Control"] = NO_STORE
            await send(message)

        await self.app(scope, receive, send_with_headers)
