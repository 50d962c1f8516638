"""Connections to the API: the time that heads of requests and readers of replies take, and their size.

Uvicorn bounds none of these. Its protocol class is extended here; the rest of the server is its own.
"""

import asyncio
import logging
import re
from functools import partial
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from amers.app.api.open_connections import Connections
from amers.app.config import Settings

MOST_HEAD_BYTES = 1 << 16
"""Limit of what arrives beside bodies: a head, trailers, sizes of chunks."""
LINGER_S = 2.0
"""So long the rest of too large a head is thrown away; its sender would miss an abrupt reply."""
MOST_THROWN_AWAY_BYTES = 10 << 20
"""So much of it: a sender that has not stopped by then does not read the reply."""
ABSOLUTE = re.compile(rb"[A-Za-z][A-Za-z0-9+.\-]*://([^/?#]*)(.*)", re.DOTALL)

log = logging.getLogger(__name__)


def server_options(settings: Settings) -> dict[str, Any]:
    """The options of uvicorn that bound connections; the protocol is made anew for each of them."""
    connections = Connections(settings)
    return {
        "http": partial(BoundedProtocol, settings=settings, open_connections=connections),
        "ws": "none",
        "proxy_headers": bool(settings.trusted_proxies),
        "forwarded_allow_ips": list(settings.trusted_proxies),
    }


class BoundedProtocol(HttpToolsProtocol):
    """A connection whose head of a request is complete in time, and whose reader keeps a least rate.

    While no request is in progress, what arrives has to become the head of one within `head_seconds`.
    That bounds idle connections, slow heads, and bodies that go on after their reply alike.
    """

    def __init__(self, *, settings: Settings, open_connections: Connections, **server: Any) -> None:
        super().__init__(**server)
        self._open_connections = open_connections
        self._head_s = settings.head_seconds
        self._rate_s = settings.rate_seconds
        self._least_drained = settings.rate_seconds * settings.least_rate_bytes
        self._busy = False
        self._head_begun = False
        self._head_bytes = 0
        self._refused = False
        self._beside_bodies = 0
        self._head_timer: asyncio.TimerHandle | None = None
        self._reader_timer: asyncio.TimerHandle | None = None
        self._end_timer: asyncio.TimerHandle | None = None
        self._buffered = self._drained = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Admit a new connection, or refuse it at once."""
        super().connection_made(transport)
        if self._open_connections.admit(self, self.client[0] if self.client else ""):
            self._await_head()
        else:
            self._refuse(b"503 Service Unavailable", b"too many connections: try again", b"5")

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._open_connections.remove(self)
        for timer in (self._head_timer, self._reader_timer, self._end_timer):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse what arrived, if it does not grow without an end."""
        if self.transport.is_closing():
            return
        self._beside_bodies += len(data)
        if self._refused:
            if self._beside_bodies > MOST_THROWN_AWAY_BYTES:
                self.transport.abort()
            return
        super().data_received(data)
        if self._beside_bodies > MOST_HEAD_BYTES:
            self._refuse_head()
        elif not self._busy and self._head_timer is None:
            self._await_head()

    def on_message_begin(self) -> None:
        """Begin a head."""
        self._head_begun = True
        self._head_bytes = 0
        super().on_message_begin()

    def on_url(self, url: bytes) -> None:
        """Keep a part of the target of the request."""
        self._count(len(url))
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        """Keep a field of the head; trailers after the body are not read by anybody."""
        if self._head_begun:
            self._count(len(name) + len(value) + len(b": \r\n"))
            super().on_header(name, value)

    def send_400_response(self, msg: str) -> None:
        """Refuse what the parser has refused, or a head that was too large for it to go on."""
        if self._head_bytes > MOST_HEAD_BYTES:
            self._refuse_head()
        else:
            super().send_400_response(msg)

    def on_headers_complete(self) -> None:
        """Start the request."""
        self._take_host_of_target()
        self._head_begun = False
        self._beside_bodies = 0
        self._busy = True
        self._open_connections.mark_busy(self)
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Pass a part of a body on."""
        self._beside_bodies = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """End a body."""
        self._beside_bodies = 0
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """End a request: the connection is idle, unless the next request has arrived already."""
        next_request = bool(self.pipeline)
        super().on_response_complete()
        if self.transport.is_closing():
            self.end()
        elif not next_request:
            self._busy = False
            self._open_connections.mark_idle(self)
            if self.cycle.more_body or self._head_begun:
                self._await_head()

    def pause_writing(self) -> None:
        """Watch the reader while more is to be sent than the connection takes at once."""
        super().pause_writing()
        self._buffered = self.transport.get_write_buffer_size()
        if self._reader_timer is None:
            self._drained = 0
            self._reader_timer = self.loop.call_later(self._rate_s, self._check_reader)

    def resume_writing(self) -> None:
        """Count what the reader has taken."""
        self._drained += self._buffered - self.transport.get_write_buffer_size()
        self._buffered = 0
        super().resume_writing()

    def timeout_keep_alive_handler(self) -> None:
        """Close the connection after the longest time between two requests."""
        self.end()

    def end(self) -> None:
        """Close the connection when its reader has taken what is left, within `rate_seconds`."""
        if self._end_timer is None:
            self._end_timer = self.loop.call_later(self._rate_s, self.transport.abort)
        self.transport.close()

    def _await_head(self) -> None:
        if self._head_timer is None:
            self._head_timer = self.loop.call_later(self._head_s, self._give_up_head)

    def _give_up_head(self) -> None:
        if self._head_begun and not self.transport.is_closing():
            self._refuse(b"408 Request Timeout", b"the head of the request is not complete in time")
        else:
            self.end()

    def _check_reader(self) -> None:
        self._reader_timer = None
        if not self.flow.write_paused:
            return
        buffered = self.transport.get_write_buffer_size()
        if self._drained + self._buffered - buffered < self._least_drained:
            log.info("a reader of %s is too slow and is given up", self.client)
            self.transport.abort()
            return
        self._drained, self._buffered = 0, buffered
        self._reader_timer = self.loop.call_later(self._rate_s, self._check_reader)

    def _count(self, size_bytes: int) -> None:
        """Count a part of the head, which may have arrived complete at once.

        Raises:
            ValueError: the head is too large; the parser stops.
        """
        self._head_bytes += size_bytes
        if self._head_bytes > MOST_HEAD_BYTES:
            raise ValueError("the head is too large")

    def _take_host_of_target(self) -> None:
        """Make a path of a target that is a whole address, whose host counts instead of `Host`.

        OPTIONS asks by `*` about the whole service. Source: RFC 9112, sections 3.2.2 and 3.2.4.
        """
        if self.url == b"*" and self.parser.get_method() == b"OPTIONS":
            self.url = b"/"
        absolute = ABSOLUTE.fullmatch(self.url)
        if absolute is None:
            return
        host, rest = absolute.groups()
        self.url = rest if rest.startswith(b"/") else b"/" + rest
        hosts = [place for place, (name, _) in enumerate(self.headers) if name == b"host"]
        if len(hosts) == 1:
            self.headers[hosts[0]] = (b"host", host)

    def _refuse_head(self) -> None:
        if self._refused:
            return
        self._refuse(
            b"431 Request Header Fields Too Large", b"the head is larger than 64 KiB", linger=True
        )

    def _refuse(
        self, status: bytes, detail: bytes, retry_after: bytes | None = None, *, linger: bool = False
    ) -> None:
        head = [
            b"HTTP/1.1 " + status,
            b"content-type: text/plain; charset=utf-8",
            b"content-length: %d" % len(detail),
            b"connection: close",
            *([b"retry-after: " + retry_after] if retry_after else []),
        ]
        self._refused = True
        self.transport.write(b"\r\n".join([*head, b"", detail]))
        if linger and self.transport.can_write_eof():
            self.transport.write_eof()
            self._end_timer = self.loop.call_later(LINGER_S, self.transport.abort)
        else:
            self.end()
