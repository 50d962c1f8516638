"""Bodies of requests: bounds on their size and their time, and reading them chunk by chunk.

A body is read under the bounds of an unknown caller, `ANONYMOUS_BODY_BYTES`. A route that has
authenticated its caller raises the limit (`amers.app.api.routes`); only a route that takes uploads
raises it to that of uploads. So a route without a word about its body has the small limit, whatever its
path.
"""

import time
from collections.abc import Iterator
from math import inf

from anyio import fail_after, from_thread
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from amers.app.config import Settings

ANONYMOUS_BODY_BYTES = 1 << 16
"""Limit of a body whose sender has no token: room for a long polygon."""
BODY = "amers.body"
BINARY_BODY = {
    "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
}
"""The body of an upload, for the description of the API."""


class BoundedBodies:
    """Middleware that gives every request a body with bounds.

    Attributes:
        app: the application that gets the requests.
        settings: limits in bytes and seconds.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self.app = app
        self.settings = settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        body = scope[BODY] = BoundedBody(scope, receive, self.settings)
        await self.app(scope, body.receive, send)


class BoundedBody:
    """The body of one request.

    Time counts while the service waits for the sender. It is divided into windows; in each the sender
    has to send so many bytes. The body of an ordinary request has one window, in which it must arrive.
    """

    def __init__(self, scope: Scope, receive: Receive, settings: Settings) -> None:
        self._scope = scope
        self._receive = receive
        self._settings = settings
        self._limit_bytes = min(ANONYMOUS_BODY_BYTES, settings.body_limit_bytes)
        self._window_s, self._least_bytes = settings.body_seconds, inf
        self._received = self._received_in_window = 0
        self._waited_s = 0.0
        self._complete = False

    def accept_from_caller(self) -> None:
        """Raise the limit to that of callers with a token."""
        self._limit_bytes = self._settings.body_limit_bytes

    def accept_upload(self) -> None:
        """Raise the limit to that of uploads, for as long as the sender keeps the least rate."""
        self._limit_bytes = self._settings.upload_limit_bytes
        self._window_s = self._settings.rate_seconds
        self._least_bytes = self._window_s * self._settings.least_rate_bytes

    async def receive(self) -> Message:
        """The next message of the server.

        Raises:
            HTTPException: the body is larger than its limit (413), or arrives too slowly (408).
        """
        if self._complete:
            return await self._receive()
        self._refuse_larger(_announced_length(self._scope))
        message = await self._next_message()
        chunk_bytes = len(message.get("body", b""))
        self._received += chunk_bytes
        self._received_in_window += chunk_bytes
        self._refuse_larger(self._received)
        self._complete = not message.get("more_body", False)
        return message

    async def _next_message(self) -> Message:
        while True:
            if self._waited_s >= self._window_s:
                self._refuse_slow()
                self._waited_s, self._received_in_window = 0.0, 0
            started = time.monotonic()
            try:
                with fail_after(self._window_s - self._waited_s):
                    return await self._receive()
            except TimeoutError:
                continue
            finally:
                self._waited_s += time.monotonic() - started

    def _refuse_larger(self, size_bytes: int | None) -> None:
        if size_bytes is not None and size_bytes > self._limit_bytes:
            raise HTTPException(
                413, f"the body is larger than {self._limit_bytes} bytes, the limit of this request"
            )

    def _refuse_slow(self) -> None:
        if self._received_in_window < self._least_bytes:
            expected = "all" if self._least_bytes == inf else f"{self._least_bytes:.0f}"
            raise HTTPException(
                408,
                f"the body arrives too slowly: {self._received_in_window} bytes in "
                f"{self._window_s:g} s of waiting, {expected} expected",
            )


def announced_length(request: Request) -> int | None:
    """The size of the body in bytes as the header Content-Length states it; None without one."""
    return _announced_length(request.scope)


def _announced_length(scope: Scope) -> int | None:
    length = next((value for name, value in scope["headers"] if name == b"content-length"), b"")
    return int(length) if length.isdigit() else None


def body_of(request: Request) -> BoundedBody:
    """The body of a request, to raise its limit."""
    body: BoundedBody = request.scope[BODY]
    return body


def body_chunks(request: Request) -> Iterator[bytes]:
    """The body, chunk by chunk, for an endpoint in a thread; the event loop receives it.

    Raises:
        ClientDisconnect: the sender has disconnected.
        HTTPException: the body is too large or arrives too slowly.
    """
    stream = request.stream()

    async def next_chunk() -> bytes | None:
        return await anext(stream, None)

    while (chunk := from_thread.run(next_chunk)) is not None:
        yield chunk
