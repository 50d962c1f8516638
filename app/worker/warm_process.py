"""Processes that start warm: forked by a server that has loaded all modules and compiled code."""

import json
import logging
import os
import select
import signal
import socket
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from types import TracebackType

from amers.app.child_processes import SAFE_PATH, python_command
from amers.app.one_thread import ONE_THREAD

LIMITED_LIBRARIES = {
    **ONE_THREAD,
    "MALLOC_ARENA_MAX": "2",
    "JE_ARROW_MALLOC_CONF": "background_thread:false",
    "GDAL_CACHEMAX": "64",
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
}
"""Variables without which libraries start threads, or take memory for many, when they are loaded."""
ENDING_S = 5.0
"""Longest time that a server may take to report the end of a process it was asked to kill."""

WITHDRAWING_S = 0.2
"""Time until a server that has not replied is taken to be loading; it skips the request later."""

log = logging.getLogger(__name__)


class WarmProcess:
    """A process that a `WarmServer` was asked for; `close` ends it with all it started."""

    def __init__(self, server: "WarmServer", connection: socket.socket) -> None:
        """Follow a process over its connection with the server."""
        self._server = server
        self._connection = connection
        self._received = b""

    def fileno(self) -> int:
        """The descriptor that becomes readable when the process starts and when it ends."""
        return self._connection.fileno()

    def wait(self, timeout_s: float) -> int | None:
        """The exit code, negative for a signal; None when the process runs on after the time-out.

        A process that ends with its server has the code of a SIGKILL.
        """
        deadline = time.monotonic() + timeout_s
        while self._received.count(b"\n") < 2:
            left_s = max(0.0, deadline - time.monotonic())
            if not select.select([self._connection], [], [], left_s)[0]:
                return None
            try:
                received = self._connection.recv(64)
            except ConnectionError:
                received = b""
            if not received:
                return -signal.SIGKILL
            self._received += received
        return int(self._received.split()[1])

    @property
    def cpu_s(self) -> float:
        """CPU that the process took with its children, seconds; 0 before its end, and when unknown."""
        numbers = self._received.split()
        return float(numbers[2]) if len(numbers) > 2 else 0.0

    def close(self) -> None:
        """Kill the process and wait for its end; one that has not started yet never does."""
        with self._connection:
            with suppress(OSError):
                self._connection.shutdown(socket.SHUT_WR)
            if self.wait(WITHDRAWING_S) is None and self._received and self.wait(ENDING_S) is None:
                self._server.close()


class WarmServer:
    """Starts processes of `amers.app.worker.warm_server`, which it restarts when it has died.

    The server ends with this process, however it ends, and its processes end with the server.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Start to load the server; `environment` is added to that of its processes."""
        self._environment = SAFE_PATH | os.environ | LIMITED_LIBRARIES | dict(environment)
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._launch()

    def __enter__(self) -> "WarmServer":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def pid(self) -> int | None:
        """The number of the process of the server; None when it is not running."""
        return None if self._process is None else self._process.pid

    def start(
        self, function: str, arguments: Sequence[str], environment: Mapping[str, str]
    ) -> WarmProcess:
        """Start a process; it waits for a server that is still loading.

        Args:
            function: `module:name` of what the process runs; takes the arguments, returns the exit code.
            arguments: of the function.
            environment: variables of this process alone.
        """
        request = {"function": function, "arguments": list(arguments), "environment": dict(environment)}
        message = json.dumps(request).encode()
        ours, theirs = socket.socketpair()
        with theirs:
            if self._process is not None and self._process.poll() is not None:
                log.error("the server of warm processes ended with code %s", self._process.returncode)
                self.close()
            try:
                socket.send_fds(self._launch(), [message], [theirs.fileno()])
            except OSError:
                self.close()
                socket.send_fds(self._launch(), [message], [theirs.fileno()])
        return WarmProcess(self, ours)

    def close(self) -> None:
        """End the server and all its processes."""
        if self._control is not None:
            self._control.close()
        if self._process is not None:
            try:
                self._process.wait(ENDING_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._process = self._control = None

    def _launch(self) -> socket.socket:
        """The socket of the running server, which is started when there is none."""
        if self._control is None:
            self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs:
                self._process = subprocess.Popen(
                    python_command("-m", "amers.app.worker.warm_server", str(theirs.fileno())),
                    env=self._environment,
                    stdin=subprocess.DEVNULL,
                    pass_fds=[theirs.fileno()],
                    start_new_session=True,
                )
        return self._control
