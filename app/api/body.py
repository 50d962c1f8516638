"""Bodies of requests: a limit on what may be sent, and reading them piece by piece."""

from collections.abc import Iterator

from anyio import fail_after, from_thread
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

UPLOADS = ("/scenes", "/uploads", "/blocks/uploads")
STALLED_S = 60.0
"""A sender that is silent for so long is gone."""


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


def body_chunks(request: Request) -> Iterator[bytes]:
    """The body, chunk by chunk; endpoints run in threads, the body arrives in the event loop.

    Raises:
        ClientDisconnect: the sender is gone, or silent.
    """
    stream = request.stream()

    async def following() -> bytes | None:
        try:
            with fail_after(STALLED_S):
                return await anext(stream, None)
        except TimeoutError:
            raise ClientDisconnect from None

    while (chunk := from_thread.run(following)) is not None:
        yield chunk
