"""JSON bodies as RFC 8259 defines them: NaN, Infinity and half surrogate pairs are refused."""

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.json_values import unusable_body


class StrictJson:
    """Middleware that refuses a JSON body with a value that JSON does not have.

    The body is checked when its last piece has arrived, within the limit of the middleware around.

    Attributes:
        app: the application that gets the requests.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http" or "json" not in Headers(scope=scope).get("content-type", ""):
            await self.app(scope, receive, send)
            return
        pieces: list[bytes] = []

        async def checked() -> Message:
            message = await receive()
            if message["type"] == "http.request":
                pieces.append(message.get("body", b""))
                if not message.get("more_body", False):
                    problem = unusable_body(b"".join(pieces))
                    if problem is not None:
                        raise HTTPException(422, problem)
            return message

        await self.app(scope, checked, send)
