"""Readiness: what of an installation works, by part, checked at most every few seconds."""

import os
import shutil
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as TooSlow
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import psycopg

from amers.app import reserve
from amers.app.config import Settings
from amers.app.db import checks, engine, revisions
from amers.app.db.engine import Connection
from amers.app.db.jobs import progress
from amers.app.errors import StorageOutage
from amers.app.outages import NO_ANSWER, outage_of
from amers.app.usecases import storage_identity
from amers.app.usecases.installation import Installation
from amers.app.usecases.operations import existing_folder

VALID_S = 2.0
"""A result is repeated for this time, so that frequent probes cost nothing."""
STORAGE_LIMIT_S = 5.0
"""A storage that takes longer to write and read a tiny file does not answer."""
PROBE = storage_identity.PROBE
SILENT_SHARE = 0.1
"""Share of the time limit of a job for which its process may report nothing."""
STILL_LEASES = 3
"""A lost ticket is replaced, and the job of a dead worker taken over, within two leases."""
NEEDED_TO_READ = ("database", "schema", "storage")

State = Literal["ok", "degraded", "failed"]


@dataclass(frozen=True)
class Part:
    """The state of one part of an installation.

    Attributes:
        status: `degraded`: requests that read are answered, others may fail.
        reason: what is wrong and what to do; None for `ok`.
    """

    status: State
    reason: str | None = None


OK = Part("ok")


class Readiness:
    """The state of the parts of an installation. Threads may share it."""

    def __init__(self, installation: Installation) -> None:
        self._installation = installation
        self._lock = threading.Lock()
        self._parts: dict[str, Part] = {}
        self._checked_at = float("-inf")
        # One thread: a storage that does not answer holds up no more than one.
        self._prober = ThreadPoolExecutor(1, thread_name_prefix="storage-probe")
        self._probe: Future[Part] | None = None

    def check(self) -> dict[str, Part]:
        """The state by part; while one caller checks, the others get the last result."""
        if not self._lock.acquire(blocking=not self._parts):
            return self._parts
        try:
            if time.monotonic() - self._checked_at > VALID_S:
                self._parts = self._check()
                self._checked_at = time.monotonic()
            return self._parts
        finally:
            self._lock.release()

    def close(self) -> None:
        """End the thread of the probes."""
        self._prober.shutdown(wait=False, cancel_futures=True)

    def _check(self) -> dict[str, Part]:
        try:
            with self._installation.database.reading() as connection:
                checks.check_reading(connection)
                parts = {
                    "database": _database(self._installation),
                    "schema": _schema(connection),
                    "worker": _worker(connection, self._installation.settings),
                }
        except psycopg.Error as error:
            parts = {"database": Part("failed", (outage_of(error) or NO_ANSWER).reason)}
        return {**parts, "storage": self._storage(), "disk": _disk(self._installation)}

    def _storage(self) -> Part:
        if self._probe is None or self._probe.done():
            self._probe = self._prober.submit(_storage, self._installation)
        try:
            return self._probe.result(STORAGE_LIMIT_S)
        except TooSlow:
            return Part("failed", f"the storage has not answered within {STORAGE_LIMIT_S:g} s")


def overall(parts: dict[str, Part]) -> Literal["ready", "degraded", "not ready"]:
    """The state of an installation: without a part that is needed to read it is not ready."""
    if any(parts[name].status == "failed" for name in NEEDED_TO_READ if name in parts):
        return "not ready"
    return "ready" if all(part == OK for part in parts.values()) else "degraded"


def _database(installation: Installation) -> Part:
    """The database answers, but may take no writes; while all writing connections write, it does."""
    if installation.database.writers_are_busy:
        return OK
    try:
        with installation.database.transaction() as connection:
            reason = checks.obstacle_to_writing(connection)
    except psycopg.Error as error:
        reason = (outage_of(error) or NO_ANSWER).reason
    return OK if reason is None else Part("degraded", reason)


def _schema(connection: Connection) -> Part:
    found, needed = revisions.current(engine.driver(connection)), revisions.newest_revision()
    if found == needed:
        return OK
    return Part(
        "failed",
        f"the schema of the database is at revision {found}, this Amers needs {needed}: run "
        "`amers db upgrade`, or the Amers that the database was upgraded for",
    )


def _worker(connection: Connection, settings: Settings) -> Part:
    """Workers are alive, the jobs that run report progress, and those that wait are claimed."""
    jobs = progress.movement(connection, settings.jobs_running_per_owner)
    if not jobs.workers:
        return Part("degraded", "no worker is alive: jobs wait until `amers worker` runs")
    longest_s = SILENT_SHARE * settings.job_seconds
    if jobs.silent_s > longest_s:
        return Part(
            "degraded",
            f"job {jobs.silent_job} runs and has reported no progress for {jobs.silent_s:.0f} s, more "
            f"than {SILENT_SHARE:.0%} of AMERS_JOB_SECONDS ({longest_s:g} s): see the worker's log, "
            f"and dismiss the job (DELETE /jobs/{jobs.silent_job}) if it does not go on",
        )
    idle, longest_s = jobs.workers - jobs.running, STILL_LEASES * settings.lease_seconds
    if idle > 0 and jobs.still_s > longest_s:
        return Part(
            "degraded",
            f"the queue does not move: {jobs.claimable} jobs wait, job {jobs.first_job} for "
            f"{jobs.still_s:.0f} s, more than {STILL_LEASES} times AMERS_LEASE_SECONDS "
            f"({longest_s:g} s), and {idle} of {jobs.workers} workers have nothing to do: see their "
            "logs, and restart them",
        )
    return OK


def _storage(installation: Installation) -> Part:
    """The storage belongs to the database, and a tiny file can be written and read."""
    storage = installation.storage
    try:
        with installation.database.reading() as connection:
            reason = storage_identity.mismatch(connection, storage)
    except psycopg.Error:
        return Part("failed", "it is not known whether the storage belongs to the database")
    except (StorageOutage, OSError) as error:
        outage = outage_of(error)
        return Part("failed", "the storage does not answer" if outage is None else outage.reason)
    if reason is not None:
        return Part("failed", reason)
    try:
        storage_identity.require_writable(storage)
    except StorageOutage as outage:
        return Part(
            "degraded",
            f"no file can be written into the storage: uploads and jobs wait; {outage.reason}",
        )
    reserve.keep(installation.settings)
    return OK


def _disk(installation: Installation) -> Part:
    """Each disk that Amers writes to takes files and has room."""
    settings = installation.settings
    reasons = [
        reason
        for name, folder in _disks(settings).items()
        if (reason := _trouble(name, folder, settings.min_free_bytes)) is not None
    ]
    return Part("degraded", "; ".join(reasons)) if reasons else OK


def _disks(settings: Settings) -> dict[str, Path]:
    """The folders that lie on disks of their own, by their names."""
    folders = {"the data folder": existing_folder(settings.data_folder)}
    if settings.storage_url is None:
        folders["the storage"] = settings.data_folder / "storage"
    if settings.database_url is None:
        folders["the private database"] = settings.data_folder / "postgres"
    disks: dict[str, Path] = {}
    seen = set()
    for name, folder in folders.items():
        # A storage that is away is told of by its own part.
        with suppress(OSError):
            if (disk := folder.stat().st_dev) not in seen:
                disks[name] = folder
                seen.add(disk)
    return disks


def _trouble(name: str, folder: Path, least_bytes: int) -> str | None:
    """Why a disk takes no files, or soon will not."""
    try:
        free_bytes = shutil.disk_usage(folder).free
        is_read_only = bool(os.statvfs(folder).f_flag & os.ST_RDONLY)
    except OSError as error:
        return f"the disk of {name} cannot be looked at: {error.strerror}"
    if is_read_only:
        return f"the disk of {name} is mounted read-only: nothing can be stored there"
    if free_bytes >= least_bytes:
        return None
    return (
        f"{free_bytes} bytes are free on the disk of {name}, fewer than AMERS_MIN_FREE_BYTES "
        f"({least_bytes}): delete something, which works on a full disk too"
    )
