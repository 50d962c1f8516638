"""Replies that the database sends piece by piece."""

import time
from collections.abc import AsyncIterator, Callable, Generator, Iterable
from functools import partial
from tempfile import SpooledTemporaryFile

from anyio import (
    CancelScope,
    CapacityLimiter,
    Event,
    create_task_group,
    move_on_after,
    to_thread,
)
from starlette.requests import ClientDisconnect
from starlette.responses import StreamingResponse
from starlette.types import Message, Send

STALLED_S = 60.0
"""A reader who takes nothing for so long is given up."""
READER_PATIENCE_S = 2.0
"""Time that a reader may keep the database waiting, all pieces together."""
IN_MEMORY_BYTES = 1 << 20
PIECE_BYTES = 1 << 16


class Streamed(StreamingResponse):
    """A reply in pieces; its database connection is in use until all are read.

    The pieces are made in a thread of their own, because the threads of endpoints may all wait for a
    connection. When the reader is slow, the rest is read at the database's speed and set aside in a
    temporary file: slow readers keep no connection from others.

    Attributes:
        on_release: called once, when the connection is not in use any more.
    """

    def __init__(
        self,
        first_pieces: Iterable[bytes],
        pieces: Generator[bytes, None, None],
        media_type: str,
        headers: dict[str, str],
    ) -> None:
        self._pieces = pieces
        self._thread = CapacityLimiter(1)
        self._patience_s = READER_PATIENCE_S
        self._aside: SpooledTemporaryFile[bytes] | None = None
        self.on_release: Callable[[], None] = lambda: None
        super().__init__(self._all_pieces(first_pieces), media_type=media_type, headers=headers)

    async def stream_response(self, send: Send) -> None:
        """Send all pieces, and release the connection in any case.

        Raises:
            ClientDisconnect: the reader takes no more data.
        """
        try:
            await super().stream_response(partial(self._send, send))
        finally:
            await self.discard()

    async def discard(self) -> None:
        """Give up the pieces that are not read yet, and release the connection."""
        with CancelScope(shield=True):
            await to_thread.run_sync(self._close, limiter=self._thread)
        self._release()

    async def _all_pieces(self, first_pieces: Iterable[bytes]) -> AsyncIterator[bytes]:
        for piece in first_pieces:
            yield piece
        while piece := await to_thread.run_sync(self._next_piece, limiter=self._thread):
            yield piece

    async def _send(self, send: Send, message: Message) -> None:
        """Send a message; read the rest of the reply when its reader has no patience left."""
        sent = Event()
        sending = move_on_after(STALLED_S)
        async with create_task_group() as tasks:

            async def send_in_time() -> None:
                with sending:
                    await send(message)
                sent.set()

            started = time.monotonic()
            tasks.start_soon(send_in_time)
            with move_on_after(self._patience_s):
                await sent.wait()
            self._patience_s = max(0.0, self._patience_s - (time.monotonic() - started))
            if not sent.is_set() and self._aside is None:
                await to_thread.run_sync(self._set_aside, limiter=self._thread)
                self._release()
        if sending.cancelled_caught:
            raise ClientDisconnect

    def _next_piece(self) -> bytes:
        """The next piece; empty after the last one."""
        if self._aside is not None:
            return self._aside.read(PIECE_BYTES)
        return next(self._pieces, b"")

    def _set_aside(self) -> None:
        aside = SpooledTemporaryFile(IN_MEMORY_BYTES)  # noqa: SIM115
        for piece in self._pieces:
            aside.write(piece)
        aside.seek(0)
        self._aside = aside

    def _close(self) -> None:
        self._pieces.close()
        if self._aside is not None:
            self._aside.close()

    def _release(self) -> None:
        on_release, self.on_release = self.on_release, lambda: None
        on_release()
