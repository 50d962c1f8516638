"""Paths of requests: a slash at their end changes nothing, and numbers in them name something."""

from typing import Annotated

from fastapi import Path
from starlette.types import ASGIApp, Receive, Scope, Send

PathNumber = Annotated[int, Path(ge=0, le=(1 << 63) - 1)]
"""A number in a path, which the database can look up; what is none names nothing: 404."""
SLASH = "amers.slash"
"""In the scope of a request whose path had a slash at its end."""


class TrailingSlashes:
    """Middleware that replies to a path with a slash at its end as to the path without.

    A redirect instead would lose the body of a request in many clients.

    Attributes:
        app: the application that gets the requests.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        path = scope.get("path", "")
        if path.endswith("/") and path != f"{scope.get('root_path', '')}/":
            scope["path"] = path[:-1]
            scope[SLASH] = True
        await self.app(scope, receive, send)
