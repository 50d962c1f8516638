"""The process that does one attempt at a job.

Started as `python -m app.worker.run JOB ATTEMPT WORKER_PID MEMORY_BYTES`.

Exit codes: 0 the outcome is written or no longer needed, 77 out of memory, 78 a disk is full, others for
a crash or an outage. SIGXFSZ ends a process that writes too large a file.
"""

import ctypes
import logging
import os
import resource
import signal
import sys
from pathlib import Path
from uuid import UUID

import cv2

from app import logs
from app.config import read_settings
from app.db.engine import pooled
from app.db.jobs.attempts import LostJob
from app.errors import is_no_room
from app.request_context import Origin, working_for
from app.usecases.jobs import do_attempt
from app.worker.attempt import NO_ROOM, OUT_OF_MEMORY

PR_SET_PDEATHSIG = 1
CV_NO_MEMORY = -4

log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Do the attempt and return the exit code."""
    job_id, attempt, worker_pid, memory_bytes = arguments
    die_with(int(worker_pid))
    settings = read_settings()
    logs.configure(settings)
    assert settings.database_url is not None, "the worker sets AMERS_DATABASE_URL"
    origin = Origin(actor_name=f"worker {worker_pid}", job_id=UUID(job_id))
    try:
        with working_for(origin), pooled(settings.database_url.get_secret_value(), settings) as database:
            limit_memory(int(memory_bytes))
            limit_files(settings.job_file_bytes)
            do_attempt(database, settings, UUID(job_id), int(attempt))
    except LostJob as lost:
        log.info("%s", lost)
    except MemoryError:
        return OUT_OF_MEMORY
    except cv2.error as error:
        if error.code == CV_NO_MEMORY:
            return OUT_OF_MEMORY
        raise
    except Exception as error:
        if not is_no_room(error):
            raise
        log.exception("a disk is full")
        return NO_ROOM
    return 0


def die_with(worker_pid: int) -> None:
    """Make the kernel kill this process when its worker ends, for whatever reason."""
    if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl")
    if os.getppid() != worker_pid:
        sys.exit("the worker has ended")


def limit_memory(extra_bytes: int) -> None:
    """Limit what this process may allocate in addition to what its libraries have already reserved."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + extra_bytes
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def limit_files(largest_bytes: int) -> None:
    """Make the kernel end this process by SIGXFSZ when it writes a larger file, in whatever library."""
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest_bytes, largest_bytes))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
