"""The process that does one attempt at a job.

Forked by the server of warm processes, with the arguments JOB ATTEMPT WORKER MEMORY_BYTES.

Exit codes: 0 the outcome is written or no longer needed, 77 out of memory, 78 a disk is full, 79 the
storage is away, others for a crash or another outage. SIGXFSZ ends a process that writes too large a
file.
"""

import logging
from uuid import UUID

from amers.app import logs
from amers.app.config import read_settings
from amers.app.db.engine import pooled
from amers.app.db.jobs.attempts import LostJob
from amers.app.errors import StorageOutage, is_no_memory, is_no_room
from amers.app.request_context import Origin, working_for
from amers.app.usecases.jobs import do_attempt
from amers.app.worker.limits import NO_ROOM, OUT_OF_MEMORY, STORAGE_AWAY, limit_files, limit_memory

log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Do the attempt and return the exit code."""
    job_id, attempt, worker, memory_bytes = arguments
    settings = read_settings()
    logs.configure(settings)
    assert settings.database_url is not None, "the worker sets AMERS_DATABASE_URL"
    origin = Origin(actor_name=f"worker {worker}", job_id=UUID(job_id))
    try:
        url = settings.database_url.get_secret_value()
        # The worker ends what waits longer than a job may take.
        with (
            working_for(origin),
            pooled(url, settings, lock_wait_s=settings.job_seconds) as database,
        ):
            limit_memory(int(memory_bytes))
            limit_files(settings.job_file_bytes)
            do_attempt(database, settings, UUID(job_id), int(attempt))
    except LostJob as lost:
        log.info("%s", lost)
    except StorageOutage as outage:
        log.warning("%s", outage)
        return STORAGE_AWAY
    except Exception as error:
        if is_no_memory(error):
            return OUT_OF_MEMORY
        if not is_no_room(error):
            raise
        log.exception("a disk is full")
        return NO_ROOM
    return 0
