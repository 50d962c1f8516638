"""Connections to the API: their number, and the time that heads of requests and readers of replies take.

Uvicorn bounds none of these. Its protocol class is extended here; the rest of the server is its own.
"""

import asyncio
import logging
import time
from collections import Counter
from functools import partial
from ipaddress import IPv6Address, ip_address, ip_network
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from app.config import Settings

MOST_HEAD_BYTES = 1 << 16
"""Limit of what arrives beside bodies: a head, trailers, sizes of chunks."""
SILENT_S = 60.0
"""Shortest time between two warnings that the service has too many connections."""

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


def network_of(address: str) -> str:
    """Whose address this is: an IPv4 address itself, the network /64 of an IPv6 address.

    The owner of one IPv6 address has all others of its network.
    """
    if ":" not in address:
        return address
    number = int(IPv6Address(address.partition("%")[0]))
    return str(ip_address(number >> 64 << 64))


class Connections:
    """The open connections of the service; without room for a newcomer, the longest idle one is closed.

    Attributes:
        most: connections in all.
        most_per_address: connections of one address; proxies that are trusted have no such limit.
    """

    def __init__(self, settings: Settings) -> None:
        self.most = settings.connections
        self.most_per_address = settings.connections_per_address
        self._proxies = [ip_network(proxy) for proxy in settings.trusted_proxies]
        self._open: dict[BoundedProtocol, str] = {}
        self._by_network: Counter[str] = Counter()
        self._idle: dict[BoundedProtocol, None] = {}
        self._warned_at = -SILENT_S

    def admit(self, connection: "BoundedProtocol", address: str) -> bool:
        """Whether there is room for a new connection, which is idle until its first request."""
        network = network_of(address)
        if self._by_network[network] >= self.most_per_address and not self._is_proxy(address):
            room = self._close_idle(network)
        else:
            room = len(self._open) < self.most or self._close_idle(None)
        if not room:
            self._warn(address)
            return False
        self._open[connection] = network
        self._by_network[network] += 1
        self._idle[connection] = None
        return True

    def remove(self, connection: "BoundedProtocol") -> None:
        """Forget a connection that ends, if it was admitted."""
        network = self._open.pop(connection, None)
        if network is None:
            return
        self._idle.pop(connection, None)
        self._by_network[network] -= 1
        if not self._by_network[network]:
            del self._by_network[network]

    def mark_busy(self, connection: "BoundedProtocol") -> None:
        """Keep a connection open for newcomers: a request is in progress."""
        self._idle.pop(connection, None)

    def mark_idle(self, connection: "BoundedProtocol") -> None:
        """Let newcomers have the place of a connection without a request."""
        if connection in self._open:
            self._idle[connection] = None

    def _close_idle(self, network: str | None) -> bool:
        """Close the connection that has been idle longest, of one network or of all."""
        for connection in self._idle:
            if network is None or self._open[connection] == network:
                self.remove(connection)
                connection.end()
                return True
        return False

    def _is_proxy(self, address: str) -> bool:
        return any(ip_address(address) in proxy for proxy in self._proxies)

    def _warn(self, address: str) -> None:
        if time.monotonic() - self._warned_at >= SILENT_S:
            self._warned_at = time.monotonic()
            log.warning(
                "a connection of %s is refused: %d connections are open, none of them idle",
                address,
                len(self._open),
            )


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
        super().data_received(data)
        if self._beside_bodies > MOST_HEAD_BYTES:
            self._refuse(b"431 Request Header Fields Too Large", b"the head is larger than 64 KiB")
        elif not self._busy and self._head_timer is None:
            self._await_head()

    def on_message_begin(self) -> None:
        """Begin a head."""
        self._head_begun = True
        super().on_message_begin()

    def on_header(self, name: bytes, value: bytes) -> None:
        """Keep a field of the head; trailers after the body are not read by anybody."""
        if self._head_begun:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Start the request."""
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

    def _refuse(self, status: bytes, detail: bytes, retry_after: bytes | None = None) -> None:
        head = [
            b"HTTP/1.1 " + status,
            b"content-type: text/plain; charset=utf-8",
            b"content-length: %d" % len(detail),
            b"connection: close",
            *([b"retry-after: " + retry_after] if retry_after else []),
        ]
        self.transport.write(b"\r\n".join([*head, b"", detail]))
        self.end()
