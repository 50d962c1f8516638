"""Outages below an installation: a storage that is not mounted, a database that is read-only."""

import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import psycopg

from amers.app.db.cluster.embedded import DATABASE, SUPERUSER
from benchmarks._killed_installation import KilledInstallation

LASTS_S = 6.0
PATIENCE_S = 60.0
"""Longest time until the database takes a new setting: it may be killed and recover meanwhile."""


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
        time.sleep(LASTS_S)
        hidden = [str(path.relative_to(folder)) for path in folder.rglob("*")]
        self.wrong += [f"{name}: written into the mount point" for name in hidden]
        shutil.rmtree(folder)
        away.rename(folder)
        self.had["storage not mounted"] += 1

    def _protect(self) -> None:
        """Let the database refuse writes for a while."""
        if self._set("alter system set default_transaction_read_only = on"):
            time.sleep(LASTS_S)
            self.had["database read-only"] += 1
        if not self._set("alter system reset default_transaction_read_only"):
            self.wrong.append("the database stayed read-only")

    def _set(self, statement: str) -> bool:
        """Change a setting of the server; returns whether it took it."""
        dsn = self.installation.cluster.dsn(DATABASE, SUPERUSER)
        deadline = time.monotonic() + PATIENCE_S
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
