"""Processes that are kept running: restarted when they die, ended with this process."""

import logging
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import FrameType

from amers.app.child_processes import python_command

PROGRAM = """
import ctypes, os, sys
number, parent = int(sys.argv.pop()), int(sys.argv.pop())
ctypes.CDLL(None).prctl(1, number)  # PR_SET_PDEATHSIG: get this signal when the parent is killed
if os.getppid() == parent:
    {statement}
"""
FIRST_PAUSE_S = 1.0
LONGEST_PAUSE_S = 10.0
"""Longest pause before a restart: what dies again and again must not be away for long."""
SHORT_LIFE_S = 60.0
"""A process that lived for less doubles the pause before its next restart."""
POLL_S = 0.2

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Child:
    """A process to keep running.

    Attributes:
        name: in the log.
        statement: Python that it runs.
        arguments: its `sys.argv[1:]`.
        death_signal: what it gets when this process is killed.
        descriptors: file descriptors that it inherits.
        ending_s: time that it has to end after SIGTERM; then it is killed.
        must_start: whether this process ends with it when it ends by itself within its first minute,
            as it does when it cannot start.
    """

    name: str
    statement: str
    arguments: tuple[str, ...] = ()
    death_signal: signal.Signals = signal.SIGTERM
    descriptors: tuple[int, ...] = ()
    ending_s: float = 20.0
    must_start: bool = False

    def start(self) -> "subprocess.Popen[bytes]":
        """A new process; it lives no longer than the thread that calls this."""
        own = (str(os.getpid()), str(int(self.death_signal)))
        program = PROGRAM.format(statement=self.statement)
        return subprocess.Popen(
            python_command("-c", program, *self.arguments, *own),
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            pass_fds=self.descriptors,
        )


class Supervisor:
    """Keeps processes running until a signal.

    Attributes:
        exit_code: what this process ends with: 0 after Ctrl-C, 128 and its number after another signal,
            that of a process which could not start.
    """

    def __init__(self) -> None:
        self.exit_code = 0
        self._signals: list[int] = []
        self._stop = threading.Event()
        self._hurry = threading.Event()

    def run(self, children: Sequence[Child], at_stop: Callable[[], None]) -> None:
        """Keep processes running; on SIGTERM, SIGINT or SIGHUP, end them and return.

        A second signal ends them at once.

        Args:
            at_stop: called before the processes are ended.
        """
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            # `nohup` ignores SIGHUP. Shells without job control ignore SIGINT, which must work then too.
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._note)
        keepers = [
            threading.Thread(target=self._keep_running, args=(child,), name=f"keeper of {child.name}")
            for child in children
        ]
        for keeper in keepers:
            keeper.start()
        # The handler only appends: an event that it set could be locked by the thread it interrupts.
        while not self._signals and not self._stop.is_set():
            time.sleep(POLL_S)
        if self._signals and self._signals[0] != signal.SIGINT:
            self.exit_code = 128 + self._signals[0]
        at_stop()
        self._stop.set()
        for keeper in keepers:
            while keeper.is_alive():
                keeper.join(POLL_S)
                if len(self._signals) > 1:
                    self._hurry.set()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._signals.append(number)

    def _keep_running(self, child: Child) -> None:
        """Run a process until the stop; the pause before a restart doubles when it dies soon."""
        pause_s, is_first = FIRST_PAUSE_S, True
        while not self._stop.is_set():
            begin = time.monotonic()
            try:
                process = child.start()
            except OSError as error:
                log.error("%s cannot be started now: %s", child.name, error)
                self._stop.wait(LONGEST_PAUSE_S)
                continue
            while process.poll() is None and not self._stop.wait(POLL_S):
                pass
            if self._stop.is_set():
                self._end(process, child)
                return
            is_short = time.monotonic() - begin < SHORT_LIFE_S
            if child.must_start and is_first and is_short and process.returncode > 0:
                log.error("%s cannot start: exit code %d", child.name, process.returncode)
                self.exit_code = process.returncode
                self._stop.set()
                return
            log.error(
                "%s ended with exit code %d and is restarted in %.0f s",
                child.name,
                process.returncode,
                pause_s,
            )
            self._stop.wait(pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S) if is_short else FIRST_PAUSE_S
            is_first = False

    def _end(self, process: "subprocess.Popen[bytes]", child: Child) -> None:
        process.terminate()
        deadline = time.monotonic() + child.ending_s
        while process.poll() is None and time.monotonic() < deadline and not self._hurry.is_set():
            time.sleep(POLL_S / 4)
        process.kill()
        process.wait()
