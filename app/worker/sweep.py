"""The sweeper of a worker: takes over the jobs of dead workers, and removes files without rows.

It runs in a thread of its own, not as a periodic task of the queue: such a task needs a free worker, and
all workers may be busy for an hour.
"""

import logging
import threading
import time
from contextlib import suppress
from dataclasses import dataclass

from amers.app import reserve
from amers.app.config import TRASH_DAYS, Settings
from amers.app.db import scenes, uptime
from amers.app.db.engine import Database, limit_lock_wait
from amers.app.db.jobs import attempts, queue
from amers.app.errors import StorageOutage
from amers.app.outages import outage_of
from amers.app.storage import Storage, trash
from amers.app.usecases import garbage_collection, results, retention, storage_identity
from amers.app.usecases.blocks.uploads import remove_expired_archives
from amers.app.usecases.garbage_collection import Bin, remove_unnamed_chips, remove_unnamed_files
from amers.app.usecases.uploads import UPLOAD_PREFIX, remove_abandoned_uploads
from amers.app.worker.attempt import ATTEMPTS_ALLOWED

SILENT_WORKER_S = 60.0
"""A worker of the queue sends a heartbeat every ten seconds; without one for this long it is dead."""
FIRST_FILES_S = 900.0
"""Files are swept first this long after the start of a worker: time to notice a wrong configuration."""
FILES_EVERY_S = 3600.0
GENERATION_EVERY_S = 60.0
"""A backup of the database that is this much older than the newest files is recognised as older."""
MOST_BETWEEN_S = 2 * FILES_EVERY_S
"""Longest credible time between two sweeps of files; a clock that shows more has jumped."""
LONGEST_UPLOAD_S = 3600.0 * scenes.LONGEST_UPLOAD_HOURS
LONGEST_WAIT_S = 5
"""Longest wait for the end of ingestions; meanwhile no jobs are taken over and new ingestions wait."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Sweeper:
    """Sweeps jobs and files until `stop` is set.

    Attributes:
        database, storage, settings: of the installation.
        stop: ends the thread.
    """

    database: Database
    storage: Storage
    settings: Settings
    stop: threading.Event

    def run(self) -> None:
        """Sweep jobs three times per lease, and files every hour."""
        next_files_at = time.monotonic() + FIRST_FILES_S
        next_generation_at = time.monotonic()
        while not self.stop.wait(self.settings.lease_seconds / 3.0):
            try:
                sweep_jobs(
                    self.database, self.settings.lease_seconds, self.settings.jobs_running_per_owner
                )
                if time.monotonic() > next_generation_at:
                    next_generation_at += GENERATION_EVERY_S
                    storage_identity.advance(self.database.transaction, self.storage)
                    self._keep_reserve()
                if time.monotonic() > next_files_at:
                    next_files_at += FILES_EVERY_S
                    reserve.deleting(self.settings, self._sweep)
            except Exception as error:
                if (outage := outage_of(error)) is None:
                    log.exception("the sweep failed and is repeated")
                else:
                    log.warning("the sweep failed and is repeated: %s", outage.reason)

    def _sweep(self) -> None:
        """Remove old records, and files without rows."""
        sweep_records(self.database, self.storage, self.settings)
        sweep_files(self.database, self.storage, self.settings.job_seconds, self.settings.trash_days)

    def _keep_reserve(self) -> None:
        """Make the reserve for deletions, if it is missing and the storage is mounted."""
        with suppress(StorageOutage):
            self.storage.prove()
            reserve.keep(self.settings)


def sweep_jobs(database: Database, lease_s: float, running_limit: int | None = None) -> None:
    """Take the jobs of dead workers back, and issue tickets for jobs that wait without one."""
    with database.transaction() as connection:
        if not queue.may_sweep(connection):
            return
        for job_id in attempts.take_back(connection, ATTEMPTS_ALLOWED):
            log.warning("job %s: taken back from a worker whose lease expired", job_id)
        queue.forget_dead_entries(connection, SILENT_WORKER_S)
        if issued := queue.replace_lost_tickets(connection, lease_s, running_limit):
            log.warning("%d tickets of the queue were lost and are issued again", issued)


def sweep_records(database: Database, storage: Storage, settings: Settings) -> None:
    """Remove results, jobs and audit rows that are older than the settings keep them.

    Nothing is removed from a storage that does not belong to the database.
    """
    if not storage_identity.announce(database.transaction, storage):
        return
    results.reconcile_results(database, storage)
    retention.remove_what_is_old(database, storage, settings)


def sweep_files(
    database: Database, storage: Storage, longest_job_s: float, trash_days: float = TRASH_DAYS
) -> None:
    """Remove the files of abandoned uploads, attempts and ingestions, and old files of the trash.

    Nothing is removed from a storage that does not belong to the database.

    Raises:
        psycopg.errors.LockNotAvailable: an ingestion is under way; the next sweep removes the rest.
    """
    if not storage_identity.announce(database.transaction, storage):
        return
    with database.transaction() as connection:
        uptime.advance(connection, MOST_BETWEEN_S)
        moment = garbage_collection.moment(connection)
    rubbish = Bin(storage, moment if trash_days > 0 else None)
    removed = remove_abandoned_uploads(database, storage)
    with database.transaction() as connection:
        scenes.give_up_old_uploads(connection)
    removed += remove_unnamed_files(database, rubbish)
    removed += storage.sweep_unfinished(LONGEST_UPLOAD_S + longest_job_s, UPLOAD_PREFIX)
    with database.transaction() as connection:
        limit_lock_wait(connection, LONGEST_WAIT_S)
        removed += remove_unnamed_chips(connection, rubbish)
        removed += remove_expired_archives(connection, rubbish)
    for name in removed:
        log.info("removed the file %s, which no row refers to", name)
    n_deleted = trash.delete_old(storage, moment, trash_days)
    if n_deleted:
        log.info("deleted %d files that were in the trash for %g days", n_deleted, trash_days)
