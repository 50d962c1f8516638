"""One attempt at a job: a process of its own, watched, and what becomes of the job when it ends.

The process writes the outcome itself. The worker only keeps the lease alive, kills the process when the
job is no longer its own, and settles the job when the process ended without an outcome.
"""

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from uuid import UUID

from psycopg import OperationalError

from app.config import Settings
from app.db.engine import Database
from app.db.jobs import attempts
from app.db.jobs.attempts import LostJob
from app.db.jobs.jobs import Job
from app.errors import is_no_room
from app.request_context import Origin, working_for
from app.storage import Storage

FAILURES_ALLOWED = 3
"""A job fails when so many attempts at it have ended without an outcome."""
POLL_S = 0.2
LONGEST_BEAT_S = 2.0
"""A lease is renewed at least this often, which is also how soon a dismissed job is noticed."""
OUT_OF_MEMORY = 77
"""Exit code of a process that met its memory limit."""
NO_ROOM = 78
"""Exit code of a process that found a disk full."""

LIMITED_LIBRARIES = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "2",
    "GDAL_CACHEMAX": "64",
    "GDAL_PAM_ENABLED": "NO",
    "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
}

log = logging.getLogger(__name__)


class Stopped(Exception):
    """The worker has to stop."""


class TooLong(Exception):
    """The process ran beyond its time limit."""


@dataclass(frozen=True)
class Attempts:
    """How a worker does jobs.

    Attributes:
        database: with the jobs.
        settings: the installation's.
        worker: name of this worker, for the record.
        should_stop: asked all the time while a job is done.
    """

    database: Database
    settings: Settings
    worker: str
    should_stop: Callable[[], bool]

    def do_job(self, job_id: UUID) -> None:
        """Claim a job and see one attempt at it through; does nothing when it is not to be had."""
        with working_for(Origin(actor_name=f"worker {self.worker}", job_id=job_id)):
            self._do_job(job_id)

    def _do_job(self, job_id: UUID) -> None:
        with self.database.transaction() as connection:
            job = attempts.claim(connection, job_id, self.worker, self.settings.lease_seconds)
        if job is None:
            log.info("job %s is not to be had", job_id)
            return
        log.info("job %s: attempt %d at %s", job.id, job.attempt, job.kind)
        try:
            self._see_through(job)
        except LostJob as lost:
            log.info("%s", lost)

    def _see_through(self, job: Job) -> None:
        """Run the process; write what it could not write itself."""
        try:
            code = self._run(job)
        except Stopped:
            with self.database.transaction() as connection:
                attempts.give_back(connection, job.id, job.attempt)
            log.info("job %s: given back", job.id)
        except TooLong:
            allowed_s = self.settings.job_seconds
            self._fail(job, "Time limit", f"stopped after the {allowed_s:g} s that a job may take")
        except OSError as error:
            if not is_no_room(error):
                raise
            self._settle(job, NO_ROOM)
        else:
            self._settle(job, code)

    def _settle(self, job: Job, code: int) -> None:
        """A bug, a crash or an outage is tried again after a while, until it has happened too often."""
        if code == 0:
            return
        log.error("job %s: attempt %d ended with code %d", job.id, job.attempt, code)
        failures = job.failures + 1
        if code == OUT_OF_MEMORY:
            allowed = f"{self.settings.job_memory_bytes / 2**20:.0f} MiB"
            self._fail(job, "Memory limit", f"needs more memory than the {allowed} that a job may take")
        elif failures >= FAILURES_ALLOWED and code == NO_ROOM:
            self._fail(job, "No room", f"a disk of the service was full, {failures} attempts broke off")
        elif failures >= FAILURES_ALLOWED:
            self._fail(
                job,
                "Internal error",
                f"the work broke off {failures} times; the log of the worker says why",
            )
        else:
            with self.database.transaction() as connection:
                attempts.try_again(
                    connection, job.id, job.attempt, self.settings.lease_seconds * failures
                )

    def _fail(self, job: Job, title: str, detail: str) -> None:
        error: dict[str, Any] = {"type": "about:blank", "title": title, "detail": detail}
        with self.database.transaction() as connection:
            attempts.fail(connection, job.id, job.attempt, error)

    def _run(self, job: Job) -> int:
        """Exit code of the attempt's process; however this ends, the process is gone.

        Raises:
            Stopped, TooLong, LostJob
        """
        arguments = (job.id, job.attempt, os.getpid(), self.settings.job_memory_bytes)
        storage = Storage(self.settings.data_folder / "storage")
        with storage.scratch_folder(f"job-{job.id}-") as folder:
            process = subprocess.Popen(
                [sys.executable, "-m", "app.worker.run", *map(str, arguments)],
                env=os.environ | LIMITED_LIBRARIES | self._installation() | {"TMPDIR": str(folder)},
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
            try:
                return self._watch(job, process)
            finally:
                _kill(process)

    def _installation(self) -> dict[str, str]:
        """Where the process finds the database, which this worker keeps running, and the files."""
        ingest = self.settings.ingest_folder
        return {
            "AMERS_DATABASE_URL": self.database.dsn,
            "AMERS_DATA_FOLDER": str(self.settings.data_folder),
            **({} if ingest is None else {"AMERS_INGEST_FOLDER": str(ingest)}),
        }

    def _watch(self, job: Job, process: "subprocess.Popen[bytes]") -> int:
        """Keep the lease alive until the process ends or has to."""
        lease_s = self.settings.lease_seconds
        beat_s = min(lease_s / 3.0, LONGEST_BEAT_S)
        started = renewed = time.monotonic()
        while True:
            try:
                return process.wait(min(POLL_S, beat_s))
            except subprocess.TimeoutExpired:
                now = time.monotonic()
            if self.should_stop():
                raise Stopped
            if now - started > self.settings.job_seconds:
                raise TooLong
            if now - renewed > lease_s:
                raise LostJob(f"job {job.id}: attempt {job.attempt} could not renew its lease")
            if now - renewed > beat_s and self._renew(job):
                renewed = now

    def _renew(self, job: Job) -> bool:
        """Renew the lease; False when the database cannot be reached."""
        try:
            with self.database.transaction() as connection:
                attempts.renew(connection, job.id, job.attempt, self.settings.lease_seconds)
        except OperationalError as outage:
            log.warning("job %s: the lease could not be renewed: %s", job.id, outage)
            return False
        return True


def _kill(process: "subprocess.Popen[bytes]") -> None:
    """End the process and everything it started; harmless when it has ended."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
