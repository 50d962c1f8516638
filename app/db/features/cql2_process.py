"""Parsing of filters in processes of their own, so that no filter can end or block the caller.

The library overflows its stack or takes exponential time for some filters. `cql2_tokens` refuses those
that are known. What is not known ends one of two small processes (`cql2_parser`), not the service.
"""

import json
import logging
import os
import queue
import signal
import socket
import subprocess
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from amers.app.child_processes import python_command
from amers.app.errors import InvalidParameter, TooMany

PROCESSES = 2
LONGEST_PARSE_S = 10.0
"""Time in which a process replies; it has 1 s to 2 s of CPU for one filter."""
LONGEST_WAIT_S = 10.0
PROGRAM = Path(__file__).with_name("cql2_parser.py")

log = logging.getLogger(__name__)


def parse(language: str, text: str) -> Any:
    """The CQL2 JSON of a filter.

    Args:
        language: `text` or `json`.

    Raises:
        InvalidParameter: the library refuses the filter, takes too long for it or ends.
        TooMany: all processes are busy.
    """
    try:
        process = _idle.get(timeout=LONGEST_WAIT_S)
    except queue.Empty:
        raise TooMany("filter: too many filters are being parsed: try again in some seconds") from None
    try:
        return process.parse(language, text)
    finally:
        _idle.put(process)


class _Process:
    """A process that parses filters: started for the first of them, and again after it has ended."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.line: socket.socket | None = None

    def parse(self, language: str, text: str) -> Any:
        """The CQL2 JSON of a filter; errors as those of the module's `parse`."""
        line = self._open_line()
        try:
            sign, reply = _ask(line, language, text)
        except (OSError, EOFError):
            raise InvalidParameter(self._lost(text)) from None
        if sign == b"+":
            try:
                return json.loads(reply)
            except RecursionError:
                raise InvalidParameter("filter: operators too deep in each other: split it") from None
        lines = [line.strip() for line in reply.splitlines()]
        reason = " ".join(line for line in lines if line and line not in ("|", "^---"))
        raise InvalidParameter(f"filter: not CQL2: {reason:.300}")

    def _open_line(self) -> socket.socket:
        """The connection to the process, which is started unless it runs."""
        if self.line is not None and self.process is not None and self.process.poll() is None:
            return self.line
        spec = find_spec("cql2")
        assert spec is not None
        assert spec.origin is not None
        ours, theirs = socket.socketpair()
        ours.settimeout(LONGEST_PARSE_S)
        # It ends when its line does: a signal at the parent's death would come from the thread that
        # starts it, which may end long before. A parse that never ends is left to its limit of CPU.
        with theirs:
            self.process = subprocess.Popen(
                python_command("-I", "-S", str(PROGRAM), str(Path(spec.origin).parent.parent)),
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                cwd="/",
                env={},
                start_new_session=True,
            )
        self.line = ours
        return ours

    def _lost(self, text: str) -> str:
        """End what is left of the process; returns the message to the caller."""
        assert self.process is not None
        assert self.line is not None
        self.process.kill()
        code = self.process.wait()
        self.line.close()
        self.line = None
        log.warning("a filter of %d characters ended its parser with exit code %d", len(text), code)
        if code in (-signal.SIGXCPU, -signal.SIGKILL):
            return "filter: takes more than 1 s to parse: simplify or split the filter"
        return "filter: cannot be parsed: simplify or split the filter"


def _ask(line: socket.socket, language: str, text: str) -> tuple[bytes, str]:
    content = text.encode()
    line.sendall(language[0].encode() + len(content).to_bytes(4, "big") + content)
    head = _receive(line, 5)
    return head[:1], _receive(line, int.from_bytes(head[1:], "big")).decode()


def _receive(line: socket.socket, size: int) -> bytes:
    content = bytearray()
    while len(content) < size:
        piece = line.recv(size - len(content))
        if not piece:
            raise EOFError
        content += piece
    return bytes(content)


def _start_afresh() -> None:
    """Forget the processes: those of the parent of a forked process are not shared with it."""
    global _processes, _idle
    _processes = tuple(_Process() for _ in range(PROCESSES))
    _idle = queue.LifoQueue()
    for process in _processes:
        _idle.put(process)


_processes: tuple[_Process, ...]
_idle: "queue.LifoQueue[_Process]"
_start_afresh()
os.register_at_fork(after_in_child=_start_afresh)
