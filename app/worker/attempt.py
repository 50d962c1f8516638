"""One attempt at a job in a process of its own, which the worker supervises.

The process writes the outcome itself. The worker renews the lease, kills the process when the job is no
longer its own, and updates the job when the process ended without an outcome.
"""

import logging
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import psycopg

from amers.app.config import Settings
from amers.app.db import revisions
from amers.app.db.engine import Database, driver
from amers.app.db.jobs import attempts
from amers.app.db.jobs.attempts import LostJob
from amers.app.db.jobs.jobs import Job
from amers.app.errors import StorageOutage, is_no_room
from amers.app.outages import outage_of
from amers.app.request_context import Origin, working_for
from amers.app.storage import Storage
from amers.app.usecases import results, storage_identity
from amers.app.worker.limits import NO_ROOM, OUT_OF_MEMORY, STORAGE_AWAY
from amers.app.worker.warm_process import WarmProcess, WarmServer

FAILURES_ALLOWED = 3
"""A job fails when this many attempts at it have ended without an outcome."""
ATTEMPTS_ALLOWED = 10
"""A job that ends its process or its worker every time fails after so many attempts."""
KILLED = (-signal.SIGKILL, -signal.SIGTERM)
"""Exit codes of a process that did not end by itself: the kernel found no memory, the server of warm
processes has died, or somebody stops the service. No job can be blamed for these."""
POLL_S = 0.2
LONGEST_BEAT_S = 2.0
"""Longest time between renewals of a lease; a dismissed job is noticed within this time."""

log = logging.getLogger(__name__)


class Stopped(Exception):
    """The worker must stop."""


class TooLong(Exception):
    """The process exceeded its time limit."""


@dataclass(frozen=True)
class Attempts:
    """Does attempts at jobs for one worker.

    Attributes:
        database: with the jobs.
        processes: starts the processes of the attempts.
        settings: of the installation.
        worker: name of this worker, recorded in its jobs.
        should_stop: whether the worker must stop; called several times a second during an attempt.
    """

    database: Database
    processes: WarmServer
    settings: Settings
    worker: str
    should_stop: Callable[[], bool]

    def do_next_job(self) -> None:
        """Claim the next job and do one attempt at it; does nothing when no job may be claimed.

        Raises:
            InputError: the database was upgraded while this worker ran; no job is claimed.
        """
        with self.database.transaction() as connection:
            # The sweep of a worker that fits the database queues the ticket again.
            revisions.require_current(driver(connection))
            try:
                self._storage.prove()
            except StorageOutage as outage:
                # The sweep queues the ticket again.
                log.warning("no job is claimed: %s", outage)
                return
            job = attempts.claim_next(
                connection,
                self.worker,
                self.settings.lease_seconds,
                self.settings.jobs_running_per_owner,
            )
        if job is None:
            return
        with working_for(Origin(actor_name=f"worker {self.worker}", job_id=job.id)):
            self._do_job(job)

    @cached_property
    def _storage(self) -> Storage:
        """The storage of the installation, which this worker writes into while it proves to be that."""
        return storage_identity.opened(self.database, self.settings)

    def _do_job(self, job: Job) -> None:
        log.info("job %s: attempt %d at %s", job.id, job.attempt, job.kind)
        try:
            self._supervise(job)
        except LostJob as lost:
            log.info("%s", lost)
        try:
            results.discard_attempt(self.database, self._storage, job.id, job.attempt)
            results.discard_work(self.database, self._storage, job.id)
        except (psycopg.Error, StorageOutage, OSError) as error:
            if (outage := outage_of(error)) is None:
                raise
            log.warning(
                "job %s: the sweep has to delete the files of its attempt: %s", job.id, outage.reason
            )

    def _supervise(self, job: Job) -> None:
        """Run the process, and update the job when the process did not write an outcome."""
        try:
            code = self._run(job)
        except Stopped:
            with self.database.transaction() as connection:
                attempts.give_back(connection, job.id, job.attempt)
            log.info("job %s: given back to the queue, because this worker stops", job.id)
        except TooLong:
            self._fail(
                job,
                "Time limit",
                f"the job was stopped after {self.settings.job_seconds:g} s, the limit of this service "
                "(AMERS_JOB_SECONDS)",
            )
        except StorageOutage as outage:
            log.warning("job %s: %s", job.id, outage)
            self._settle(job, STORAGE_AWAY)
        except OSError as error:
            if outage_of(error) is None:
                raise
            log.warning("job %s: %s", job.id, error)
            self._settle(job, NO_ROOM if is_no_room(error) else STORAGE_AWAY)
        else:
            self._settle(job, code)

    def _settle(self, job: Job, code: int) -> None:
        """Fail a job, or schedule another attempt after one of its first bugs, crashes or outages."""
        if code == 0:
            return
        log.error("job %s: attempt %d ended with exit code %d", job.id, job.attempt, code)
        failures = job.failures + 1
        if code == STORAGE_AWAY:
            with self.database.transaction() as connection:
                attempts.try_again(
                    connection, job.id, job.attempt, self.settings.lease_seconds, counts=False
                )
        elif code == OUT_OF_MEMORY:
            limit = f"{self.settings.job_memory_bytes / 2**20:.0f} MiB"
            self._fail(
                job,
                "Memory limit",
                f"the job needs more memory than {limit}, the limit of this service "
                "(AMERS_JOB_MEMORY_BYTES)",
            )
        elif code == -signal.SIGXFSZ:
            limit = f"{self.settings.job_file_bytes / 2**20:.0f} MiB"
            self._fail(
                job,
                "File size limit",
                f"the job writes a file larger than {limit}, the limit of this service "
                "(AMERS_JOB_FILE_BYTES)",
            )
        elif code in KILLED and job.attempt < ATTEMPTS_ALLOWED:
            with self.database.transaction() as connection:
                delay_s = self.settings.lease_seconds * min(job.attempt, FAILURES_ALLOWED)
                attempts.try_again(connection, job.id, job.attempt, delay_s, counts=False)
        elif code in KILLED:
            self._fail(job, "Process killed", f"the process was killed in {job.attempt} attempts")
        elif failures >= FAILURES_ALLOWED and code == NO_ROOM:
            self._fail(job, "No room", f"a disk of the service was full in {failures} attempts")
        elif failures >= FAILURES_ALLOWED:
            self._fail(
                job,
                "Internal error",
                f"{failures} attempts ended without an outcome; the log of the worker has the reasons",
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
        """The exit code of the attempt's process; the process has ended whenever this returns or raises.

        Raises:
            Stopped, TooLong, LostJob
        """
        arguments = (job.id, job.attempt, os.getpid(), self.settings.job_memory_bytes)
        with self._storage.scratch_folder(f"job-{job.id}-") as folder:
            process = self.processes.start(
                "amers.app.worker.run:main", [str(value) for value in arguments], {"TMPDIR": str(folder)}
            )
            try:
                return self._watch(job, process)
            finally:
                process.close()
                self._count(job, process.cpu_s)

    def _count(self, job: Job, cpu_s: float) -> None:
        """Record the CPU of an attempt for its owner, however it ended."""
        try:
            with self.database.transaction() as connection:
                attempts.count_cpu(connection, job.owner, cpu_s, self.settings.quota_cpu_seconds)
        except psycopg.Error as error:
            if (outage := outage_of(error)) is None:
                raise
            log.warning("job %s: %.0f s of CPU are not recorded: %s", job.id, cpu_s, outage.reason)

    def _watch(self, job: Job, process: WarmProcess) -> int:
        """Renew the lease until the process ends or must end."""
        lease_s = self.settings.lease_seconds
        beat_s = min(lease_s / 3.0, LONGEST_BEAT_S)
        started = renewed = time.monotonic()
        while True:
            code = process.wait(min(POLL_S, beat_s))
            if code is not None:
                return code
            now = time.monotonic()
            if self.should_stop():
                raise Stopped
            if now - started > self.settings.job_seconds:
                raise TooLong
            if now - renewed > lease_s:
                raise LostJob(f"job {job.id}: the lease of attempt {job.attempt} expired unrenewed")
            if now - renewed > beat_s and self._renew(job):
                renewed = now

    def _renew(self, job: Job) -> bool:
        """Renew the lease; returns False when the database cannot be reached."""
        try:
            with self.database.transaction() as connection:
                attempts.renew(connection, job.id, job.attempt, self.settings.lease_seconds)
        except psycopg.Error as error:
            if (outage := outage_of(error)) is None:
                raise
            log.warning("job %s: the lease could not be renewed: %s", job.id, outage.reason)
            return False
        return True
