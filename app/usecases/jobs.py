"""Asking for work, watching it, and doing it."""

import logging
import re
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime
from tempfile import gettempdir
from typing import Any
from uuid import UUID

from psycopg import OperationalError

from app.auth import is_administrator, may_access, require
from app.config import Settings
from app.db.engine import Connection, Database
from app.db.jobs import attempts, jobs
from app.db.jobs import progress as job_course
from app.db.jobs.attempts import LostJob
from app.db.jobs.jobs import Job, JobFilter, Response
from app.db.jobs.progress import JobMessage
from app.db.tokens import Token
from app.errors import AmersError, Conflict, InputError, NoSuchJob, NoSuchProcess
from app.storage import Storage, open_storage
from app.usecases import quotas
from app.usecases.blocks.export import EXPORT_BLOCK
from app.usecases.blocks.ingestion import INGEST_BLOCK
from app.usecases.orthorectification import ORTHORECTIFY
from app.usecases.processes import Process, Work
from app.usecases.registration.job import REGISTER_SCENE

PROCESSES: dict[str, Process] = {
    process.id: process for process in (REGISTER_SCENE, ORTHORECTIFY, INGEST_BLOCK, EXPORT_BLOCK)
}
LONGEST_KEY = 200
MOST_MESSAGES = 1000
REPORT_EVERY_S = 0.5

log = logging.getLogger(__name__)


def find_process(process_id: str) -> Process:
    """The process of that name.

    Raises:
        NoSuchProcess: there is none.
    """
    process = PROCESSES.get(process_id)
    if process is None:
        raise NoSuchProcess(f"no process {process_id:.100}: there are {', '.join(PROCESSES)}")
    return process


def execute(
    connection: Connection,
    settings: Settings,
    caller: Token,
    process_id: str,
    given: dict[str, Any],
    idempotency_key: str | None = None,
    outputs: Mapping[str, str] | None = None,
    response: Response = "document",
) -> Job:
    """Ask for work; the same request with the same key asks for it once.

    Args:
        outputs: name of each output that is wanted, to `value` or `reference`; None: all of them.
        response: how results are told.

    Raises:
        NotFound: no such process, or an input that is not there for this caller.
        NotAllowed: the caller's token lacks the scope.
        TooMany: the caller has as many jobs as he may have at once.
        InputError: the inputs or outputs are not those of the process, or the key came with other ones
            before.
    """
    process = find_process(process_id)
    require(caller, process.scope)
    if idempotency_key is not None and not 0 < len(idempotency_key) <= LONGEST_KEY:
        raise InputError(f"an idempotency key has 1 to {LONGEST_KEY} characters")
    parsed = process.parse_inputs(given)
    inputs = process.format_inputs(parsed)
    process.check_outputs(outputs or {})
    wanted = None if outputs is None else dict(outputs)
    request = (process_id, inputs, wanted, response)
    if idempotency_key is not None:
        known = jobs.find_by_key(connection, caller.id, idempotency_key)
        if known is not None:
            return _same_request(known, request)
    process.check(connection, caller, parsed)
    quotas.require_free_job(connection, settings, caller)
    job = jobs.create(connection, process_id, inputs, caller.id, idempotency_key, wanted, response)
    if job is not None:
        return job
    assert idempotency_key is not None
    # Somebody else has just used the key: his job is visible now that the insert has waited for him.
    known = jobs.find_by_key(connection, caller.id, idempotency_key)
    assert known is not None
    return _same_request(known, request)


def _same_request(known: Job, request: tuple[object, ...]) -> Job:
    if (known.kind, known.inputs, known.outputs, known.response) != request:
        raise InputError(f"the idempotency key was used for job {known.id}, which was asked otherwise")
    return known


def visible_job(connection: Connection, caller: Token, job_id: UUID) -> Job:
    """The job, for its owner or an administrator.

    Raises:
        NoSuchJob: there is none, or it is somebody else's: strangers cannot tell which.
    """
    job = jobs.find(connection, job_id)
    if job is None or not may_access(caller, job.owner):
        raise NoSuchJob(f"no job {job_id}")
    return job


def list_jobs(
    connection: Connection, caller: Token, wanted: JobFilter, limit: int, after: UUID | None = None
) -> list[Job]:
    """The caller's newest jobs, or those that follow one of them; everybody's for an administrator.

    Raises:
        NoSuchJob: the job to follow is none of the caller's.
    """
    if after is not None:
        visible_job(connection, caller, after)
    owner = None if is_administrator(caller) else caller.id
    return jobs.newest(connection, owner, wanted, limit, after)


def queue_position(connection: Connection, job: Job) -> int | None:
    """How many jobs are to be begun before this one and with it; None when it does not wait."""
    return job_course.position(connection, job) if job.state == "accepted" else None


def expected_end(connection: Connection, job: Job) -> datetime | None:
    """When an open job may end, as far as jobs before it tell."""
    return job_course.expected_end(connection, job)


def read_messages(connection: Connection, caller: Token, job_id: UUID) -> list[JobMessage]:
    """The last messages of a job, the oldest of them first.

    Raises:
        NoSuchJob: there is none, or not the caller's.
    """
    visible_job(connection, caller, job_id)
    return job_course.read_messages(connection, job_id, MOST_MESSAGES)


def dismiss(connection: Connection, caller: Token, job_id: UUID) -> Job:
    """End a job that nobody wants any more; work on it stops within seconds.

    Raises:
        NoSuchJob: there is none, or not the caller's.
        Conflict: it has ended; its record and its results are kept.
    """
    job = visible_job(connection, caller, job_id)
    if not jobs.dismiss(connection, job_id):
        job = visible_job(connection, caller, job_id)
        if job.state != "dismissed":
            raise Conflict(f"job {job_id} has ended ({job.state}); it is kept")
    return visible_job(connection, caller, job_id)


def do_attempt(database: Database, settings: Settings, job_id: UUID, attempt: int) -> None:
    """Do the work of a job and write its outcome, once.

    An error that concerns the user ends the job; any other leaves it to the caller.

    Raises:
        LostJob: the job went on without this attempt; nothing was written.
    """
    with database.transaction() as connection:
        job = jobs.find(connection, job_id)
    if job is None or (job.attempt, job.state) != (attempt, "running"):
        raise LostJob(f"attempt {attempt} of job {job_id} is over")
    process = find_process(job.kind)
    storage = open_storage(settings)
    try:
        inputs = process.parse_inputs(job.inputs)
        progress = _ReportedProgress(database, job)
        commit = process.run(Work(job, inputs, database, storage, settings, progress))
        with database.transaction() as connection:
            results = commit(connection)
            attempts.succeed(connection, job.id, attempt, results)
    except AmersError as error:
        log.info("job %s: %s: %s", job.id, type(error).__name__, error)
        with database.transaction() as connection:
            attempts.fail(connection, job.id, attempt, error_details(error, storage))


def error_details(error: AmersError, storage: Storage) -> dict[str, Any]:
    """Problem details (RFC 9457) of an error: the numbers it carries, no folder of this machine."""
    folder = rf"{re.escape(str(storage.folder))}/(scenes|results)/[^/\s]+/"
    detail = re.sub(rf"{folder}|{re.escape(gettempdir())}/(amers-\w+/)?", "", str(error))
    name = type(error).__name__
    title = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).capitalize()
    numbers = {key: value for key, value in vars(error).items() if isinstance(value, int | float | str)}
    problems = [asdict(problem) for problem in getattr(error, "problems", ())]
    told = {"problems": problems} if problems else {}
    return {"type": "about:blank", "title": title, "detail": detail, "error": name, **numbers, **told}


@dataclass
class _ReportedProgress:
    """Progress that is written into the job, not too often."""

    database: Database
    job: Job
    written_at: float = field(default=float("-inf"))

    def __call__(self, fraction: float, message: str) -> None:
        """Report the fraction done.

        Raises:
            LostJob: nobody waits for this attempt any more.
        """
        now = time.monotonic()
        if now - self.written_at < REPORT_EVERY_S:
            return
        self.written_at = now
        percent = min(max(int(100.0 * fraction), 0), 99)
        try:
            with self.database.transaction() as connection:
                attempts.report(connection, self.job.id, self.job.attempt, percent, message)
        except OperationalError as outage:
            log.warning("job %s: progress could not be written: %s", self.job.id, outage)
