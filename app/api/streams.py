"""Replies in pieces that come straight from the database."""

from collections.abc import AsyncIterator, Generator, Iterable
from functools import partial

from anyio import CancelScope, CapacityLimiter, fail_after, to_thread
from starlette.requests import ClientDisconnect
from starlette.responses import StreamingResponse
from starlette.types import Message, Send

from app.api.body import STALLED_S


class Streamed(StreamingResponse):
    """Pieces that hold a connection until they are all read, or the reader is gone or silent.

    They are made in a thread beside those of endpoints, which may all be waiting for a connection: there
    are as many such replies at once as there are connections.
    """

    def __init__(
        self,
        ahead: Iterable[bytes],
        pieces: Generator[bytes, None, None],
        media_type: str,
        headers: dict[str, str],
    ) -> None:
        self._pieces = pieces
        self._thread = CapacityLimiter(1)
        super().__init__(self._made(ahead), media_type=media_type, headers=headers)

    async def _made(self, ahead: Iterable[bytes]) -> AsyncIterator[bytes]:
        for piece in ahead:
            yield piece
        following = partial(next, self._pieces, None)
        while (piece := await to_thread.run_sync(following, limiter=self._thread)) is not None:
            yield piece

    async def stream_response(self, send: Send) -> None:
        """Send all pieces, and let go of what they hold whatever happens.

        Raises:
            ClientDisconnect: the reader takes nothing any more.
        """

        async def patiently(message: Message) -> None:
            try:
                with fail_after(STALLED_S):
                    await send(message)
            except TimeoutError:
                raise ClientDisconnect from None

        try:
            await super().stream_response(patiently)
        finally:
            with CancelScope(shield=True):
                await to_thread.run_sync(self._pieces.close, limiter=self._thread)
