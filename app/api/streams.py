"""Replies that the database sends piece by piece."""

from collections.abc import AsyncIterator, Generator, Iterable
from functools import partial

from anyio import CancelScope, CapacityLimiter, fail_after, to_thread
from starlette.requests import ClientDisconnect
from starlette.responses import StreamingResponse
from starlette.types import Message, Send

from app.api.body import STALLED_S


class Streamed(StreamingResponse):
    """A reply in pieces; its database connection is in use until all are sent or the reader is gone.

    The pieces are made in a thread of their own, because the threads of endpoints may all wait for a
    connection. There are at most as many such replies at once as there are connections.
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
        super().__init__(self._all_pieces(first_pieces), media_type=media_type, headers=headers)

    async def _all_pieces(self, first_pieces: Iterable[bytes]) -> AsyncIterator[bytes]:
        for piece in first_pieces:
            yield piece
        next_piece = partial(next, self._pieces, None)
        while (piece := await to_thread.run_sync(next_piece, limiter=self._thread)) is not None:
            yield piece

    async def stream_response(self, send: Send) -> None:
        """Send all pieces, and release the connection in any case.

        Raises:
            ClientDisconnect: the reader takes no more data.
        """

        async def send_or_give_up(message: Message) -> None:
            try:
                with fail_after(STALLED_S):
                    await send(message)
            except TimeoutError:
                raise ClientDisconnect from None

        try:
            await super().stream_response(send_or_give_up)
        finally:
            with CancelScope(shield=True):
                await to_thread.run_sync(self._pieces.close, limiter=self._thread)
