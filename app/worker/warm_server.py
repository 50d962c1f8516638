"""A process that has loaded all modules and compiled code, and forks the processes that do the work.

Started as `python -m amers.app.worker.warm_server SOCKET`, with the descriptor of a socket to its
parent. Each message of this socket asks for one process: a JSON document with its function and
arguments, and the descriptor of a connection of its own. Over this connection the server sends the
number of the process, and later its exit code and the CPU that it took with its children, seconds. When
the parent closes its side, the process is killed with all it started.
"""

import ctypes
import gc
import json
import logging
import os
import random
import selectors
import signal
import socket
import sys
import tempfile
import traceback
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

PR_SET_PDEATHSIG = 1
LARGEST_REQUEST = 1 << 16
CRASHED = 1


class _Forked(BaseException):
    """Leaves the loop of the server in a process that has just been forked."""

    def __init__(self, request: dict[str, Any]) -> None:
        self.request = request


@dataclass(frozen=True)
class _Child:
    """A running process.

    Attributes:
        pid: its number, also that of its session and group.
        connection: to the one who asked for it.
        ending: descriptor that becomes readable when it ends.
    """

    pid: int
    connection: socket.socket
    ending: int


def main(arguments: list[str]) -> int:
    """Load everything, then fork processes until the parent closes the socket.

    Returns the exit code of the server, or that of a forked process.
    """
    from amers.app.worker.warm_up import warm_up

    (descriptor,) = arguments
    control = socket.socket(fileno=int(descriptor))
    warm_up()
    _refuse_threads()
    gc.collect()
    gc.freeze()
    server = os.getpid()
    request = None
    try:
        _serve(control)
    except _Forked as forked:
        request = forked.request
    return 0 if request is None else _run(request, server)


def _serve(control: socket.socket) -> None:
    """Fork and watch processes until the parent closes its socket; then kill those that are left."""
    children: dict[int, _Child] = {}
    with selectors.DefaultSelector() as selector:
        selector.register(control, selectors.EVENT_READ)
        while True:
            for key, _ in selector.select():
                if key.fileobj is control:
                    message, descriptors, _, _ = socket.recv_fds(control, LARGEST_REQUEST, 1)
                    if not message:
                        for child in children.values():
                            _kill(child.pid)
                        return
                    connection = socket.socket(fileno=descriptors[0])
                    if _is_withdrawn(connection):
                        connection.close()
                        continue
                    child = _fork(json.loads(message), connection, [control, selector], children)
                    children[child.pid] = child
                    selector.register(child.ending, selectors.EVENT_READ, child)
                    selector.register(connection, selectors.EVENT_READ, child)
                    continue
                child = key.data
                if child.pid not in children:
                    continue
                if key.fileobj is child.connection:
                    selector.unregister(child.connection)
                    _kill(child.pid)
                    continue
                del children[child.pid]
                selector.unregister(child.ending)
                with suppress(KeyError):
                    selector.unregister(child.connection)
                _report_end(child)


def _is_withdrawn(connection: socket.socket) -> bool:
    """Whether the one who asked for a process has closed its side before the process started."""
    try:
        return connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False


def _fork(
    request: dict[str, Any],
    connection: socket.socket,
    inherited: list[Any],
    children: dict[int, _Child],
) -> _Child:
    """A new process, which closes what belongs to the server and raises `_Forked`."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        os.setsid()
        for one in (*inherited, connection, *(other.connection for other in children.values())):
            one.close()
        for other in children.values():
            os.close(other.ending)
        raise _Forked(request)
    _send(connection, pid)
    return _Child(pid, connection, os.pidfd_open(pid))


def _report_end(child: _Child) -> None:
    """Send the exit code of a process that has ended, after all it started has been killed."""
    _kill(child.pid)
    _, status, used = os.wait4(child.pid, 0)
    _send(child.connection, os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime)
    child.connection.close()
    os.close(child.ending)


def _send(connection: socket.socket, *numbers: float) -> None:
    with suppress(OSError):
        connection.sendall(" ".join(map(str, numbers)).encode() + b"\n")


def _kill(pid: int) -> None:
    """Kill a process that has not been waited for, and its group, which it makes first of all."""
    with suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def _run(request: dict[str, Any], server: int) -> int:
    """Do the work of a forked process and return its exit code."""
    die_with(server)
    os.environ.update(request["environment"])
    tempfile.tempdir = None
    random.seed()
    np.random.seed()
    module, _, function = request["function"].partition(":")
    code: int = getattr(import_module(module), function)(request["arguments"])
    return code


def die_with(parent: int) -> None:
    """Make the kernel kill this process when its parent ends, for whatever reason."""
    if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl")
    if os.getppid() != parent:
        sys.exit("the parent of this process has ended")


def _refuse_threads() -> None:
    """Refuse to fork beside other threads, whose locks the processes would inherit.

    Raises:
        RuntimeError: a library has started a thread.
    """
    tasks = Path("/proc/self/task")
    names = [(task / "comm").read_text().strip() for task in tasks.iterdir()]
    if len(names) > 1:
        raise RuntimeError(f"one thread expected before processes are forked, found {', '.join(names)}")


if __name__ == "__main__":
    try:
        code = main(sys.argv[1:])
    except SystemExit as ending:
        code = ending.code if isinstance(ending.code, int) else CRASHED
        if isinstance(ending.code, str):
            print(ending.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        code = CRASHED
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    # A forked process skips what its server registered for its own end.
    os._exit(code)
