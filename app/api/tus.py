"""What tus 1.0 demands of every request to an upload: a version in each reply, and override of methods.

Source: tus resumable upload protocol 1.0.0, core protocol, headers `Tus-Resumable` and
`X-HTTP-Method-Override`.
"""

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from amers.app.api.error_responses import problem
from amers.app.api.public_address import own_path

VERSION = "1.0.0"
UPLOADS = "/uploads"
OVERRIDABLE = ("HEAD", "PATCH", "DELETE")
"""Methods that some networks do not pass; a sender behind one of them names the method in a header."""


class TusRequests:
    """Middleware for the paths of uploads; other requests pass unchanged.

    Attributes:
        app: the application that gets the requests.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http" or not _is_upload(own_path(scope)):
            await self.app(scope, receive, send)
            return

        async def send_with_version(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)["Tus-Resumable"] = VERSION
            await send(message)

        method = Headers(scope=scope).get("x-http-method-override")
        if method is not None and scope["method"] == "POST":
            if method.upper() not in OVERRIDABLE:
                detail = (
                    f"X-HTTP-Method-Override: {method[:20]!r} found, one of HEAD, PATCH, DELETE expected"
                )
                await problem(400, detail)(scope, receive, send_with_version)
                return
            scope = {**scope, "method": method.upper()}
        await self.app(scope, receive, send_with_version)


def _is_upload(path: str) -> bool:
    return path == UPLOADS or path.startswith(f"{UPLOADS}/")
