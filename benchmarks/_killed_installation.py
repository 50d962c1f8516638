"""An installation whose processes are killed and restarted, and what it stands on fails for a while."""

import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

import httpx
import psycopg

from amers.app.db.cluster.embedded import DATABASE, SUPERUSER, Cluster
from amers.app.db.engine import connect
from amers.app.usecases.tokens import create_token
from tests.app.worker_processes import children
from tests.service_process import free_port

LEASE_S = 2.0
WORKERS = 2
LONGEST_REST_S = 1.0
"""Longest time until a killed process is restarted."""
PATIENCE_S = 120.0
OUTAGE_S = 6.0
SETTING_S = 60.0
"""Longest time until the database takes a new setting: it may be killed and recover meanwhile."""
VICTIMS = ("supervisor", "api", "worker", "warm server", "attempt", "database")


@dataclass
class Service:
    """A command that is restarted whenever it has died.

    Attributes:
        command: of `amers`.
        environment: all of it.
        log: where it writes.
    """

    command: tuple[str, ...]
    environment: dict[str, str]
    log: Path
    process: "subprocess.Popen[bytes] | None" = None
    rests_until: float = 0.0

    def tend(self, rest_s: float) -> None:
        """Restart the command if it has died and its pause is over."""
        if self.process is not None and self.process.poll() is not None:
            self.process, self.rests_until = None, time.monotonic() + rest_s
        if self.process is None and time.monotonic() >= self.rests_until:
            with self.log.open("ab") as output:
                self.process = subprocess.Popen(
                    [sys.executable, "-m", "amers", *self.command],
                    env=self.environment,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                )

    def end(self) -> None:
        """Stop the command by SIGTERM and wait until it has ended."""
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            self.process.wait(PATIENCE_S)


@dataclass
class KilledInstallation:
    """A running installation, and the thread that kills its processes.

    Attributes:
        folder: its data folder.
        rng: draws the moments and the victims.
        kill_every_s: from the moment the service is ready again to the next kill, in the mean;
            exponentially distributed.
        killed: how often each kind of process was.
        finished_backups: folders of the backups whose command reported success.
        longest_backup_s: time of the slowest backup that was not killed.
        hung: backups that did not end in time.
    """

    folder: Path
    rng: random.Random
    kill_every_s: float
    killed: "Counter[str]" = field(default_factory=Counter)
    finished_backups: list[Path] = field(default_factory=list)
    longest_backup_s: float = 0.0
    hung: list[str] = field(default_factory=list)
    _services: dict[str, Service] = field(default_factory=dict)
    _threads: list[threading.Thread] = field(default_factory=list)
    _stop: threading.Event = field(default_factory=threading.Event)
    _quiet: threading.Event = field(default_factory=threading.Event)

    def __enter__(self) -> "KilledInstallation":
        self.port = free_port()
        self.ingest_folder.mkdir(parents=True)
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("AMERS_")}
        environment = inherited | {
            "AMERS_DATA_FOLDER": str(self.folder),
            "AMERS_LEASE_SECONDS": str(LEASE_S),
            "AMERS_INGEST_FOLDER": str(self.ingest_folder),
        }
        serve = ("serve", "--no-worker", "--port", str(self.port))
        self._services["api"] = Service(serve, environment, self.log)
        for number in range(WORKERS):
            self._services[f"worker {number}"] = Service(("worker",), environment, self.log)
        self._services["api"].tend(0.0)
        try:
            self.wait_ready()
        except TimeoutError:
            self._services["api"].end()
            raise
        self._start(self._tend)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._quiet.set()
        self._stop.set()
        for thread in self._threads:
            thread.join()
        for service in self._services.values():
            service.end()

    @property
    def url(self) -> str:
        """Address of the API."""
        return f"http://127.0.0.1:{self.port}"

    @property
    def ingest_folder(self) -> Path:
        """Folder of the blocks to ingest."""
        return self.folder.with_name("ingest")

    @property
    def log(self) -> Path:
        """Log of all processes."""
        return self.folder.with_name("log.txt")

    @property
    def cluster(self) -> Cluster:
        """The database."""
        return Cluster(self.folder / "postgres")

    def wait_ready(self) -> None:
        """Wait until the API and the database answer.

        Raises:
            TimeoutError: they do not.
        """
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            with suppress(httpx.TransportError):
                if httpx.get(f"{self.url}/readyz", timeout=10.0).status_code == 200:
                    return
            time.sleep(0.1)
        raise TimeoutError(f"the service is not ready after {PATIENCE_S:g} s: see {self.log}")

    def token(self) -> str:
        """The secret of an administrator."""
        with self.cluster.lease() as dsn, connect(dsn) as connection:
            return create_token(connection, "faults", ["admin"]).secret

    def start_killing(self) -> None:
        """Start to kill processes."""
        self._start(self._kill)

    def stop_killing(self) -> None:
        """Stop killing processes."""
        self._quiet.set()

    @property
    def backups(self) -> Path:
        """Folder of the backups."""
        return self.folder.with_name("backups")

    def back_up(self, name: str, kill_after_s: float, is_killed: bool) -> None:
        """Make a backup; one that is killed on the way must not look whole."""
        self.backups.mkdir(exist_ok=True)
        command = [sys.executable, "-m", "amers", "db", "backup", str(self.backups / name)]
        with self.log.open("ab") as output:
            process = subprocess.Popen(
                command,
                env=self._services["api"].environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
            )
        began = time.monotonic()
        try:
            process.wait(kill_after_s if is_killed else PATIENCE_S)
            self.longest_backup_s = max(self.longest_backup_s, time.monotonic() - began)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            if is_killed:
                self.killed["backup"] += 1
            else:
                self.hung.append(f"{name}: the command did not end within {PATIENCE_S:g} s")
        if process.returncode == 0:
            self.finished_backups.append(self.backups / name)

    @contextmanager
    def inside(self) -> Iterator[psycopg.Connection[dict[str, object]]]:
        """A connection to the database, to check what is left."""
        with self.cluster.lease() as dsn, connect(dsn) as connection:
            yield connection

    def _start(self, work: Callable[[], None]) -> None:
        thread = threading.Thread(target=work)
        self._threads.append(thread)
        thread.start()

    def _tend(self) -> None:
        rests = random.Random(self.rng.random())
        while not self._stop.wait(0.05):
            for service in self._services.values():
                service.tend(rests.uniform(0.0, LONGEST_REST_S))

    def _kill(self) -> None:
        while not self._quiet.wait(self.rng.expovariate(1.0 / self.kill_every_s)):
            victim = self.rng.choice(VICTIMS)
            numbers = self._numbers(victim)
            if victim != "database":
                numbers = [self.rng.choice(numbers)] if numbers else []
            for number in numbers:
                with suppress(ProcessLookupError):
                    os.kill(number, signal.SIGKILL)
            self.killed[victim] += bool(numbers)
            with suppress(TimeoutError):
                self.wait_ready()

    def _numbers(self, victim: str) -> list[int]:
        """The processes of a kind; those of the database server count as one."""
        if victim == "database":
            with suppress(OSError, IndexError, ValueError):
                server = int((self.cluster.data / "postmaster.pid").read_text().splitlines()[0])
                return [server, *children(server)]
            return []
        # `amers serve` supervises the API; a worker has a warm server, which forks the attempts.
        service, generation = {
            "supervisor": ("api", 0),
            "api": ("api", 1),
            "worker": ("worker", 0),
            "warm server": ("worker", 1),
            "attempt": ("worker", 2),
        }[victim]
        alive = [
            one.process.pid
            for key, one in self._services.items()
            if key.startswith(service) and one.process is not None and one.process.poll() is None
        ]
        for _ in range(generation):
            alive = [child for one in alive for child in children(one)]
        return alive


@dataclass
class Outages:
    """Outages of an installation, one at a time, each in a thread of its own.

    Attributes:
        had: how many of each kind there were.
        wrong: what was written where nothing should be.
    """

    installation: KilledInstallation
    had: "Counter[str]" = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    _threads: list[threading.Thread] = field(default_factory=list)

    def begin(self, kind: str) -> None:
        """Let an outage begin, of the `storage` or the `database`; it ends by itself."""
        self.wait()
        outage: Callable[[], None] = {"storage": self._unmount, "database": self._protect}[kind]
        thread = threading.Thread(target=outage, name=f"outage of the {kind}")
        self._threads.append(thread)
        thread.start()

    def wait(self) -> None:
        """Wait until all outages are over."""
        for thread in self._threads:
            thread.join()

    def _unmount(self) -> None:
        """Leave an empty folder in the place of the storage, as an unmount does."""
        folder = self.installation.folder / "storage"
        away = folder.with_name("storage-away")
        folder.rename(away)
        folder.mkdir(0o755)
        time.sleep(OUTAGE_S)
        hidden = [str(path.relative_to(folder)) for path in folder.rglob("*")]
        self.wrong += [f"{name}: written into the mount point" for name in hidden]
        shutil.rmtree(folder)
        away.rename(folder)
        self.had["storage not mounted"] += 1

    def _protect(self) -> None:
        """Let the database refuse writes for a while."""
        if self._set("alter system set default_transaction_read_only = on"):
            time.sleep(OUTAGE_S)
            self.had["database read-only"] += 1
        if not self._set("alter system reset default_transaction_read_only"):
            self.wrong.append("the database stayed read-only")

    def _set(self, statement: str) -> bool:
        """Change a setting of the server; returns whether it took it."""
        dsn = self.installation.cluster.dsn(DATABASE, SUPERUSER)
        deadline = time.monotonic() + SETTING_S
        while time.monotonic() < deadline:
            with (
                suppress(psycopg.Error),
                psycopg.connect(
                    dsn,
                    autocommit=True,
                    connect_timeout=5,
                    options="-c default_transaction_read_only=off",
                ) as connection,
            ):
                connection.execute(statement.encode())
                connection.execute("select pg_reload_conf()")
                return True
            time.sleep(0.2)
        return False
