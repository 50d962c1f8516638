"""What every worker puts right from time to time: jobs of dead workers, files that no row names.

It runs in a thread of its own, not as a periodic task of the queue: such a task needs a free worker, and
the workers may all be busy for an hour.
"""

import logging
import threading
import time
from dataclasses import dataclass

import psycopg

from app.config import Settings
from app.db import scenes, uptime
from app.db.engine import Database, limit_lock_wait
from app.db.jobs import attempts, jobs, queue
from app.request_context import Origin, working_for
from app.storage import Storage
from app.usecases.blocks.uploads import remove_expired_archives
from app.usecases.garbage_collection import remove_unnamed_chips, remove_unnamed_files
from app.usecases.uploads import UPLOAD_PREFIX, remove_abandoned_uploads
from app.worker.attempt import FAILURES_ALLOWED

SILENT_WORKER_S = 60.0
"""A worker of the queue beats every ten seconds; after this long without, its entries are dead."""
FILES_EVERY_S = 3600.0
MOST_BETWEEN_S = 2 * FILES_EVERY_S
"""Believed to have passed between two sweeps of files; a clock that says more has jumped."""
LONGEST_UPLOAD_S = 3600.0 * scenes.LONGEST_UPLOAD_HOURS
LONGEST_WAIT_S = 5
"""For ingestions to end: meanwhile this thread takes no job back, and new ingestions queue behind it."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Sweeper:
    """Puts things right until it is told to stop.

    Attributes:
        database, storage: of the installation.
        settings: how long a lease is.
        stop: ends the thread.
    """

    database: Database
    storage: Storage
    settings: Settings
    stop: threading.Event

    def run(self) -> None:
        """Sweep jobs several times a lease, files every hour."""
        files_at = time.monotonic()
        while not self.stop.wait(self.settings.lease_seconds / 3.0):
            try:
                sweep_jobs(self.database, self.settings.lease_seconds)
                if time.monotonic() > files_at:
                    files_at += FILES_EVERY_S
                    sweep_results(self.database, self.settings.result_days)
                    sweep_files(self.database, self.storage, self.settings.job_seconds)
            except psycopg.OperationalError as outage:
                log.warning("could not sweep: %s", outage)
            except Exception:
                log.exception("could not sweep")


def sweep_jobs(database: Database, lease_s: float) -> None:
    """Take back the jobs of dead workers, and put into the queue what was lost from it."""
    with database.transaction() as connection:
        if not queue.may_sweep(connection):
            return
        for job_id in attempts.take_back(connection, FAILURES_ALLOWED):
            log.warning("job %s: taken back from a worker that gave no sign of life", job_id)
        for job_id in queue.enqueue_forgotten(connection, lease_s):
            log.warning("job %s: was not in the queue any more", job_id)
        queue.forget_dead_entries(connection, SILENT_WORKER_S)


def sweep_results(database: Database, result_days: float | None) -> None:
    """Give up the results of jobs that ended so many days ago; None keeps all of them."""
    if result_days is None:
        return
    with working_for(Origin(actor_name="retention")), database.transaction() as connection:
        for job_id in jobs.remove_old_results(connection, 86_400.0 * result_days):
            log.info("job %s: its results are older than %g days: removed", job_id, result_days)


def sweep_files(database: Database, storage: Storage, longest_job_s: float) -> None:
    """Remove the files of uploads, attempts and ingestions that came to nothing.

    Raises:
        psycopg.errors.LockNotAvailable: an ingestion is under way; its files are swept another time.
    """
    with database.transaction() as connection:
        uptime.advance(connection, MOST_BETWEEN_S)
    removed = remove_abandoned_uploads(database, storage)
    with database.transaction() as connection:
        scenes.give_up_old_uploads(connection)
    removed += remove_unnamed_files(database, storage)
    removed += storage.sweep_unfinished(LONGEST_UPLOAD_S + longest_job_s, UPLOAD_PREFIX)
    with database.transaction() as connection:
        limit_lock_wait(connection, LONGEST_WAIT_S)
        removed += remove_unnamed_chips(connection, storage)
        removed += remove_expired_archives(connection, storage)
    for name in removed:
        log.info("removed %s, which nothing names", name)
