"""A relay before a PostgreSQL server that counts statements and ends the session of a chosen one.

It reads the messages of the protocol (version 3, without encryption), so that it sees whatever a command
sends: through an engine, by the driver alone, or from another program such as pg_dump.
"""

import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path

import psycopg
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from amers.app.db.cluster.embedded import SUPERUSER

STATEMENTS = (b"Q", b"E", b"c")
"""Messages of a client that let the server do something: a query, a prepared one, the end of a COPY."""
KEY_DATA, READY, COPY_IN = b"K", b"Z", b"G"
LEAST_VERSION, LAST_VERSION = 3 << 16, 4 << 16
ENDING_MS = 10_000


class Ending(StrEnum):
    """How a session ends at a statement.

    `terminated`: by `pg_terminate_backend`, before the server gets the statement. `unanswered`: the same
    after the server has done the statement, before the client learns it. `cut`: without a word, before
    the server gets the statement.
    """

    TERMINATED = "terminated"
    UNANSWERED = "unanswered"
    CUT = "cut"


class Relay:
    """Counts the statements of all sessions since the last `arm`, and ends the session of one of them.

    Attributes:
        direct, dsn: of the database itself, and through the relay.
        count: of the statements.
        has_ended: whether the session of the chosen statement was ended.
    """

    def __init__(self, dsn: str, port: int) -> None:
        address = conninfo_to_dict(dsn)
        self._place = str(Path(str(address["host"])) / f".s.PGSQL.{address['port']}")
        self.direct = dsn
        self._control = make_conninfo(dsn, user=SUPERUSER, dbname="postgres")
        self.dsn = make_conninfo(
            dsn, host="127.0.0.1", port=port, sslmode="disable", gssencmode="disable"
        )
        self.count, self.has_ended = 0, False
        self._chosen: int | None = None
        self._ending = Ending.TERMINATED
        self._lock = threading.Lock()

    def arm(self, chosen: int | None = None, ending: Ending = Ending.TERMINATED) -> None:
        """Count from nothing, and end the session of statement `chosen`, the first of which is 1."""
        with self._lock:
            self.count, self.has_ended, self._chosen, self._ending = 0, False, chosen, ending

    def serve(self, near: socket.socket) -> None:
        """Relay one session to its end."""
        far = socket.socket(socket.AF_UNIX)
        far.connect(self._place)
        near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        _Session(self, near, far).start()

    def is_chosen(self) -> Ending | None:
        """Count a statement; how its session ends, if it is the chosen one."""
        with self._lock:
            self.count += 1
            if self.count != self._chosen:
                return None
            self.has_ended = True
            return self._ending

    def terminate(self, pid: int) -> None:
        """Let the server end a session, and wait for it."""
        with psycopg.connect(self._control, autocommit=True) as connection:
            connection.execute("select pg_terminate_backend(%s, %s)", [pid, ENDING_MS])


class _Session:
    """One session: a thread for each direction."""

    def __init__(self, relay: Relay, near: socket.socket, far: socket.socket) -> None:
        self._relay, self._near, self._far = relay, near, far
        self._pid = 0
        self._drops_replies = threading.Event()

    def start(self) -> None:
        for work in (self._forward, self._reply):
            threading.Thread(target=self._run, args=(work,), daemon=True).start()

    def _run(self, work: object) -> None:
        assert callable(work)
        try:
            with suppress(OSError, EOFError, psycopg.Error):
                work()
        finally:
            # What the server said last has been sent to the client, which reads it before the end.
            for end in (self._near, self._far):
                with suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)

    def _forward(self) -> None:
        """From the client to the server."""
        first = _exactly(self._near, 8)
        length, version = struct.unpack("!II", first)
        self._far.sendall(first + _exactly(self._near, length - 8))
        if not LEAST_VERSION <= version < LAST_VERSION:
            raise EOFError  # a request to cancel is all of its session
        for kind, message in _messages(self._near):
            ending = self._relay.is_chosen() if kind in STATEMENTS else None
            if ending is Ending.CUT:
                return
            if ending is Ending.TERMINATED:
                self._relay.terminate(self._pid)
            if ending is Ending.UNANSWERED:
                self._drops_replies.set()
            self._far.sendall(message)

    def _reply(self) -> None:
        """From the server to the client."""
        for kind, message in _messages(self._far):
            if kind == KEY_DATA:
                (self._pid,) = struct.unpack("!I", message[5:9])
            if self._drops_replies.is_set() and kind in (READY, COPY_IN):
                self._relay.terminate(self._pid)
                self._drops_replies.clear()
            elif not self._drops_replies.is_set():
                self._near.sendall(message)


def _messages(source: socket.socket) -> Iterator[tuple[bytes, bytes]]:
    """The messages of a side after the first, each with its kind."""
    while True:
        head = _exactly(source, 5)
        yield head[:1], head + _exactly(source, struct.unpack("!I", head[1:])[0] - 4)


def _exactly(source: socket.socket, size: int) -> bytes:
    content = bytearray()
    while len(content) < size:
        piece = source.recv(size - len(content))
        if not piece:
            raise EOFError
        content += piece
    return bytes(content)


@contextmanager
def relayed(dsn: str) -> Iterator[Relay]:
    """A relay before the server of a private cluster, until the end of the context."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        relay = Relay(dsn, server.getsockname()[1])

        def accept() -> None:
            with suppress(OSError):
                while True:
                    relay.serve(server.accept()[0])

        threading.Thread(target=accept, daemon=True).start()
        try:
            yield relay
        finally:
            server.shutdown(socket.SHUT_RDWR)
