"""A limit on what a request may send, checked before anything is kept in memory."""

from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

UPLOADS = ("/scenes",)


class BodyLimit:
    """Refuses bodies that are too large: uploads have their own limit.

    Attributes:
        app: what is protected.
        limit_bytes: for ordinary requests.
        upload_limit_bytes: for requests below the paths of `UPLOADS`.
    """

    def __init__(self, app: ASGIApp, limit_bytes: int, upload_limit_bytes: int) -> None:
        self.app = app
        self.limit_bytes = limit_bytes
        self.upload_limit_bytes = upload_limit_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit = self.upload_limit_bytes if scope["path"].startswith(UPLOADS) else self.limit_bytes
        announced = dict(scope["headers"]).get(b"content-length", b"0")
        received = 0

        async def bounded() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit or (announced.isdigit() and int(announced) > limit):
                raise HTTPException(
                    413, f"the body is larger than {limit} bytes, the most that is accepted here"
                )
            return message

        await self.app(scope, bounded, send)
