"""A running `amers serve` process, for tests from outside."""

import os
import socket
import subprocess
import sys
import time
from contextlib import suppress
from itertools import cycle, islice
from pathlib import Path
from typing import Self

import httpx

from amers.app.db.cluster.embedded import Cluster

patience_s = 90.0
PORTS = range(20_000, 32_000)
"""Ports below those that Linux gives to outgoing connections."""
_ports = islice(cycle(PORTS), 37 * os.getpid() % len(PORTS), None)


def free_port() -> int:
    """A free port that no outgoing connection gets before the service listens on it."""
    for port in _ports:
        with socket.socket() as free, suppress(OSError):
            free.bind(("127.0.0.1", port))
            return port
    raise AssertionError("an endless row of ports has ended")


def installed_at(folder: Path, **settings: str) -> dict[str, str]:
    """The environment in which commands use the installation of a data folder, with other settings."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("AMERS_")}
    return {**inherited, "AMERS_DATA_FOLDER": str(folder), **settings}


class Service:
    """A running `amers serve` with options, and a data folder of its own.

    In a `with` statement it serves, with its worker unless an option leaves it out, and is then ended.

    Attributes:
        folder: its data folder.
        log: what it says.
        environment: in which commands reach its database.
    """

    def __init__(self, folder: Path, *options: str, **settings: str) -> None:
        self.folder = folder
        self.port = free_port()
        self.has_worker = "--no-worker" not in options
        self.cluster = Cluster(folder / "postgres")
        self.environment = installed_at(folder, **settings)
        self.log = folder.with_suffix(".log")
        with self.log.open("ab") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "amers", "serve", "--port", str(self.port), *options],
                env=self.environment,
                stdout=output,
                stderr=output,
            )

    def __enter__(self) -> Self:
        if not until(lambda: self.is_ready() and (self.workers() or not self.has_worker)):
            self.end()
            raise AssertionError(self.log.read_text())
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Stop the service by SIGTERM and wait until it has ended."""
        self.process.terminate()
        self.process.wait(timeout=patience_s)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def is_ready(self) -> bool:
        try:
            return httpx.get(f"{self.url}/readyz", timeout=30).status_code == 200
        except httpx.TransportError:
            return False

    def workers(self) -> list[int]:
        """The workers that have a lease of the cluster."""
        return self._children("worker")

    def apis(self) -> list[int]:
        """The processes of the API that have a lease of the cluster."""
        return self._children("api")

    def _children(self, kind: str) -> list[int]:
        users = users_of(self.cluster.folder / "lease")
        return [number for number in users if f"\0{kind}\0".encode() in command_of(number)]


def command_of(process: int) -> bytes:
    """The command line of a process, each part ended by NUL; nothing of one that has ended."""
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return b""


def users_of(file: Path) -> list[int]:
    """The processes that have the file open, but those that end while they are looked at."""
    return sorted(
        int(process.name) for process in Path("/proc").glob("[0-9]*") if _has_open(process, file)
    )


def _has_open(process: Path, file: Path) -> bool:
    try:
        links = list((process / "fd").iterdir())
    except OSError:
        return False
    return any(_is_same(link, file) for link in links)


def _is_same(link: Path, file: Path) -> bool:
    try:
        return link.samefile(file)
    except OSError:
        return False


def until(condition) -> bool:
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.2)
    return False
