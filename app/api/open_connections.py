"""The open connections of the API: their number, in all and per address."""

import logging
import time
from collections import Counter
from ipaddress import IPv6Address, ip_address, ip_network
from typing import Protocol

from amers.app.config import Settings

SILENT_S = 60.0
"""Shortest time between two warnings that the service has too many connections."""

log = logging.getLogger(__name__)


class Connection(Protocol):
    """A connection that can be closed."""

    def end(self) -> None:
        """Close the connection when its reader has taken what is left."""


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
        self._open: dict[Connection, str] = {}
        self._by_network: Counter[str] = Counter()
        self._idle: dict[Connection, None] = {}
        self._warned_at = -SILENT_S

    def admit(self, connection: Connection, address: str) -> bool:
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

    def remove(self, connection: Connection) -> None:
        """Forget a connection that ends, if it was admitted."""
        network = self._open.pop(connection, None)
        if network is None:
            return
        self._idle.pop(connection, None)
        self._by_network[network] -= 1
        if not self._by_network[network]:
            del self._by_network[network]

    def mark_busy(self, connection: Connection) -> None:
        """Keep a connection open for newcomers: a request is in progress."""
        self._idle.pop(connection, None)

    def mark_idle(self, connection: Connection) -> None:
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
