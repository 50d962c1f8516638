"""Bodies of requests: a limit on their size, and reading them chunk by chunk."""

from collections.abc import Iterator

from anyio import fail_after, from_thread
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

UPLOADS = ("/scenes", "/uploads", "/blocks/uploads")
STALLED_S = 60.0
"""A connection on which nothing moves for so long is given up."""
BINARY_BODY = {
    "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
}
"""The body of an upload, for the description of the API."""


class BodyLimit:
    """Refuses bodies that are larger than the limit of their path.

    Attributes:
        app: the application that gets the accepted bodies.
        limit_bytes: limit of ordinary requests.
        upload_limit_bytes: limit of requests below the paths of `UPLOADS`.
    """

    def __init__(self, app: ASGIApp, limit_bytes: int, upload_limit_bytes: int) -> None:
        self.app = app
        self.limit_bytes = limit_bytes
        self.upload_limit_bytes = upload_limit_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        limit = self.upload_limit_bytes if scope["path"].startswith(UPLOADS) else self.limit_bytes
        length = dict(scope["headers"]).get(b"content-length", b"0")
        received = 0

        async def bounded() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit or (length.isdigit() and int(length) > limit):
                raise HTTPException(
                    413, f"the body is larger than {limit} bytes, the limit of this path"
                )
            return message

        await self.app(scope, bounded, send)


def announced_length(request: Request) -> int | None:
    """The size of the body in bytes as the header Content-Length states it; None without one."""
    length = request.headers.get("content-length", "")
    return int(length) if length.isdigit() else None


def body_chunks(request: Request) -> Iterator[bytes]:
    """The body, chunk by chunk, for an endpoint in a thread; the event loop receives it.

    Raises:
        ClientDisconnect: the sender has disconnected, or has sent nothing for `STALLED_S` seconds.
    """
    stream = request.stream()

    async def next_chunk() -> bytes | None:
        try:
            with fail_after(STALLED_S):
                return await anext(stream, None)
        except TimeoutError:
            raise ClientDisconnect from None

    while (chunk := from_thread.run(next_chunk)) is not None:
        yield chunk
