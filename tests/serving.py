"""A running `amers serve` for tests that look at it from outside."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import httpx

from app.db.embedded import Cluster

patience_s = 90.0


def free_port() -> int:
    """A port of this machine that nobody listens at."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port: int = free.getsockname()[1]
    return port


class Service:
    """A running `amers serve` with a data folder of its own.

    Attributes:
        folder: its data folder.
        environment: in which commands reach its database.
    """

    def __init__(self, folder: Path, **settings: str) -> None:
        self.folder = folder
        self.port = free_port()
        self.cluster = Cluster(folder / "postgres")
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("AMERS_")}
        self.environment = {**inherited, "AMERS_DATA_FOLDER": str(folder), **settings}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "app.cli.main", "serve", "--port", str(self.port)],
            env=self.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def is_ready(self) -> bool:
        try:
            return httpx.get(f"{self.url}/readyz", timeout=30).status_code == 200
        except httpx.TransportError:
            return False

    def workers(self) -> list[int]:
        """The processes that hold the cluster's lease and are not the API."""
        lease = self.cluster.folder / "lease"
        return [number for number in users_of(lease) if number != self.process.pid]


def users_of(file: Path) -> list[int]:
    found = set()
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if link.samefile(file):
                found.add(int(link.parts[2]))
        except OSError:
            continue
    return sorted(found)


def until(condition) -> bool:
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.2)
    return False
