"""Jobs: create one for a process, follow it, dismiss it, and do one attempt at it."""

import json
import logging
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from tempfile import gettempdir
from typing import Any
from uuid import UUID

import psycopg

from amers.app.auth import Scope, may_access, owner_filter, require
from amers.app.config import Settings
from amers.app.db.engine import Connection, Database
from amers.app.db.jobs import attempts, jobs
from amers.app.db.jobs import progress as job_progress
from amers.app.db.jobs.attempts import LostJob
from amers.app.db.jobs.jobs import Job, JobFilter
from amers.app.db.jobs.progress import JobMessage, Outlook
from amers.app.db.scenes import keeping_files, scene_names
from amers.app.db.schema import JobResponse
from amers.app.db.tokens import Token
from amers.app.errors import (
    AmersError,
    Conflict,
    DamagedFile,
    InputError,
    NoSuchJob,
    NoSuchProcess,
    StorageOutage,
    is_no_memory,
    is_no_room,
)
from amers.app.outages import outage_of
from amers.app.storage import Storage
from amers.app.usecases import quotas, storage_identity
from amers.app.usecases.base.job import MAKE_BASE
from amers.app.usecases.blocks.export import EXPORT_BLOCK
from amers.app.usecases.blocks.ingestion import INGEST_BLOCK
from amers.app.usecases.blocks.quality_job import ASSESS_BLOCK
from amers.app.usecases.blocks.renewal_job import RENEW_BLOCK
from amers.app.usecases.damage import report_damage
from amers.app.usecases.mosaic_job import MAKE_MOSAIC
from amers.app.usecases.orthorectification import ORTHORECTIFY
from amers.app.usecases.processes import Process, Work, WorkFailed
from amers.app.usecases.registration.job import REGISTER_SCENE
from amers.app.usecases.registration.joint_job import REGISTER_SCENES
from amers.app.usecases.scene_map import MAP_SCENE
from amers.app.usecases.scene_model import READ_MODEL
from amers.app.usecases.scene_view import VIEW_SCENE
from amers.app.usecases.straightening import STRAIGHTEN_SCENE
from amers.app.usecases.surface_job import MAKE_SURFACE
from amers.app.usecases.vector_job import CORRECT_VECTORS, PROJECT_VECTORS

PROCESSES: dict[str, Process] = {
    process.id: process
    for process in (
        REGISTER_SCENE,
        REGISTER_SCENES,
        VIEW_SCENE,
        READ_MODEL,
        MAP_SCENE,
        ORTHORECTIFY,
        STRAIGHTEN_SCENE,
        MAKE_SURFACE,
        MAKE_MOSAIC,
        CORRECT_VECTORS,
        PROJECT_VECTORS,
        INGEST_BLOCK,
        EXPORT_BLOCK,
        ASSESS_BLOCK,
        RENEW_BLOCK,
        MAKE_BASE,
    )
}
LONGEST_KEY = 200
LARGEST_INPUTS_BYTES = 64 << 10
"""Jobs are kept, and so are their inputs."""
MOST_MESSAGES = 1000
REPORT_INTERVAL_S = 0.5

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class JobRequest:
    """A request to execute a process.

    Attributes:
        process_id: name of the process.
        inputs: as sent, not yet checked.
        outputs: name of each requested output, to `value` or `reference`; None requests all of them.
        response: how the results are sent: in a document, or as they are.
        priority: of the job in the queue; only administrators may give another one than 0.
    """

    process_id: str
    inputs: dict[str, Any]
    outputs: Mapping[str, str] | None = None
    response: JobResponse = "document"
    priority: int = 0


def find_process(process_id: str) -> Process:
    """The process of this name.

    Raises:
        NoSuchProcess: there is none.
    """
    process = PROCESSES.get(process_id)
    if process is None:
        raise NoSuchProcess(f"no process {process_id:.100}: expected one of {', '.join(PROCESSES)}")
    return process


def execute(
    connection: Connection,
    settings: Settings,
    caller: Token,
    request: JobRequest,
    idempotency_key: str | None = None,
) -> Job:
    """Create a job; a repeated request with the same key returns the job of the first one.

    Raises:
        NotFound: no such process, or an input that does not exist for this caller.
        NotAllowed: the caller's token lacks the scope of the process, or of a priority.
        TooMany: the caller has as many jobs as the quotas allow.
        TooLarge: the process makes files, and the caller's storage quota is used up.
        InputError: unusable inputs or outputs, or the key was used with another request.
    """
    process = find_process(request.process_id)
    require(caller, process.scope)
    if idempotency_key is not None and not 0 < len(idempotency_key) <= LONGEST_KEY:
        raise InputError(
            f"idempotency key: {len(idempotency_key)} characters found, 1 to {LONGEST_KEY} expected"
        )
    if request.priority:
        require(caller, Scope.ADMIN)
    parsed = process.parse_inputs(request.inputs)
    process.check_outputs(request.outputs or {})
    outputs = None if request.outputs is None else dict(request.outputs)
    inputs = process.format_inputs(parsed)
    checked = JobRequest(process.id, inputs, outputs, request.response, request.priority)
    size_bytes = len(json.dumps(checked.inputs))
    if size_bytes > LARGEST_INPUTS_BYTES:
        raise InputError(
            f"inputs of {process.id}: {size_bytes} bytes found, at most {LARGEST_INPUTS_BYTES} expected"
        )
    if idempotency_key is not None:
        earlier = jobs.find_by_key(connection, caller.id, idempotency_key)
        if earlier is not None:
            return _same_request(process, earlier, checked)
    process.check(connection, caller, parsed)
    quotas.require_free_job(connection, settings, caller)
    if process.outputs:
        quotas.require_room(connection, settings, caller.id, f"a job that does {process.id}")
    job = jobs.create(
        connection,
        kind=checked.process_id,
        inputs=checked.inputs,
        owner=caller.id,
        idempotency_key=idempotency_key,
        outputs=outputs,
        response=checked.response,
        priority=checked.priority,
    )
    if job is not None:
        return job
    assert idempotency_key is not None
    # Another request has just used the key; the insert waited for it, so its job is visible now.
    earlier = jobs.find_by_key(connection, caller.id, idempotency_key)
    assert earlier is not None
    return _same_request(process, earlier, checked)


def _same_request(process: Process, job: Job, request: JobRequest) -> Job:
    """The job of an idempotency key, if it was created by the same request.

    Inputs that an earlier release stored are compared with the defaults of later options.
    """
    inputs = job.inputs
    if job.kind == process.id:
        inputs = process.format_inputs(process.parse_inputs(job.inputs))
    if JobRequest(job.kind, inputs, job.outputs, job.response, job.priority) != request:
        raise InputError(
            f"idempotency key: job {job.id} was created with this key by a different request; "
            "send a new key"
        )
    return job


def visible_job(connection: Connection, caller: Token, job_id: UUID) -> Job:
    """The job, for its owner or an administrator.

    Raises:
        NoSuchJob: there is none, or the caller may not see it; the message does not say which.
    """
    job = jobs.find(connection, job_id)
    if job is None or not may_access(caller, job.owner):
        raise NoSuchJob(f"no job {job_id}")
    return job


def scenes_of(job: Job) -> list[str]:
    """The ids of the scenes among the inputs of a job."""
    one = [job.inputs["scene"]] if "scene" in job.inputs else []
    return [str(scene) for scene in job.inputs.get("scenes", one)]


def names_of_scenes(connection: Connection, listed: Sequence[Job]) -> dict[str, str]:
    """The names of the scenes among the inputs of some jobs, by id."""
    ids = {UUID(scene) for job in listed for scene in scenes_of(job)}
    return {str(scene): name for scene, name in scene_names(connection, list(ids)).items()}


def list_jobs(
    connection: Connection, caller: Token, wanted: JobFilter, limit: int, after: UUID | None = None
) -> list[Job]:
    """The caller's newest jobs, or those that follow job `after`; administrators see all jobs.

    Raises:
        NoSuchJob: the caller may not see the job `after`.
    """
    if after is not None:
        visible_job(connection, caller, after)
    return jobs.newest(connection, owner_filter(caller), wanted, limit, after)


def outlook(connection: Connection, job: Job) -> Outlook:
    """The place of a job in the queue, and its expected end."""
    return job_progress.outlook(connection, job.id)


def read_messages(connection: Connection, caller: Token, job_id: UUID) -> list[JobMessage]:
    """The last messages of a job, the oldest of them first.

    Raises:
        NoSuchJob: there is none, or the caller may not see it.
    """
    visible_job(connection, caller, job_id)
    return job_progress.read_messages(connection, job_id, MOST_MESSAGES)


def dismiss(connection: Connection, caller: Token, job_id: UUID) -> Job:
    """Dismiss a job that has not ended, or remove one that has ended with its messages and results.

    The worker stops the work of a dismissed job within seconds. The registration that a removed job made
    stays, because points have its measures in their histories. The caller deletes the files of a removed
    job (`results.delete_files`) once the transaction is committed: rows go before files.

    Returns:
        The dismissed job. `results_removed_at` of a removed one has a value.

    Raises:
        NoSuchJob: there is none, or the caller may not see it.
    """
    job = visible_job(connection, caller, job_id)
    if jobs.dismiss(connection, job_id):
        return visible_job(connection, caller, job_id)
    if not jobs.delete_ended(connection, [job_id]):
        raise NoSuchJob(f"no job {job_id}")
    removed_at = datetime.now(UTC)
    return replace(job, state="dismissed", message="removed", results_removed_at=removed_at)


def do_attempt(database: Database, settings: Settings, job_id: UUID, attempt: int) -> None:
    """Do the work of a job and write its outcome.

    An `AmersError` ends the job as failed; any other exception is left to the caller.

    Raises:
        MemoryError: a file seemed unusable because there was no memory to read it.
        LostJob: this attempt is no longer the current one; nothing is written.
        StorageOutage: the storage is away, takes no files, or is not that of the installation.
    """
    with database.transaction() as connection:
        job = jobs.find(connection, job_id)
    if job is None or (job.attempt, job.state) != (attempt, "running"):
        raise LostJob(f"attempt {attempt} of job {job_id} is over")
    process = find_process(job.kind)
    storage = storage_identity.opened(database, settings)
    try:
        inputs = process.parse_inputs(job.inputs)
        progress = _ReportedProgress(database, job)
        with _noticing_removal(database, job):
            commit = process.run(Work(job, inputs, database, storage, settings, progress))
        with database.transaction() as connection:
            results = commit(connection)
            message = success_message(results)
            attempts.succeed(connection, job.id, attempt, results, message)
            storage.prove()
        log.info("job %s: %s", job.id, message)
    except AmersError as error:
        # What cannot be read because the storage is away is no failure of the job.
        storage.prove()
        if is_no_memory(error):
            raise MemoryError from error
        if isinstance(error, DamagedFile):
            report_damage(database, error)
        _fail(database, storage, job, error)
    except WorkFailed as failure:
        storage.prove()
        _fail(database, storage, job, failure.error, failure.results)
    except (LostJob, StorageOutage):
        raise
    except Exception as error:
        if not is_no_memory(error) and not is_no_room(error):
            storage_identity.require_writable(storage)
        raise


@contextmanager
def _noticing_removal(database: Database, job: Job) -> Iterator[None]:
    """Name the scene that its owner removed while a job read its files, whatever broke by that.

    Raises:
        Conflict: a scene of the inputs was removed.
    """
    try:
        yield
    except (LostJob, MemoryError, StorageOutage):
        raise
    except Exception as error:
        named = [job.inputs.get("scene"), *(job.inputs.get("scenes") or ())]
        ids = [UUID(scene) for scene in named if scene]
        with database.reading() as connection:
            kept = keeping_files(connection, ids)
        removed = [scene for scene in ids if not kept.get(scene, False)]
        if not removed or is_no_memory(error):
            raise
        raise Conflict(
            f"scene {removed[0]} was removed while this job used it; upload it again"
        ) from error


def _fail(
    database: Database,
    storage: Storage,
    job: Job,
    error: AmersError,
    results: dict[str, Any] | None = None,
) -> None:
    """End a job as failed, with its error and what it made all the same."""
    log.info("job %s failed: %s: %s", job.id, type(error).__name__, error)
    with database.transaction() as connection:
        attempts.fail(connection, job.id, job.attempt, error_details(error, storage), results)


def success_message(results: dict[str, Any]) -> str:
    """The last message of a job by its results: a verdict that forbids their use stands in it."""
    verdict = results.get("verdict")
    if verdict == "failed":
        return "done, verdict failed: do not use the refined model"
    return "done" if verdict is None else f"done, verdict {verdict}"


def error_details(error: AmersError, storage: Storage) -> dict[str, Any]:
    """Problem details (RFC 9457) of an error, with its numbers and without folders of this machine."""
    folder = rf"{re.escape(str(storage.folder))}/(scenes|results)/[^/\s]+/"
    detail = re.sub(rf"{folder}|{re.escape(gettempdir())}/(amers-\w+/)?", "", str(error))
    name = type(error).__name__
    title = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).capitalize()
    numbers = {key: value for key, value in vars(error).items() if isinstance(value, int | float | str)}
    problems = [asdict(problem) for problem in getattr(error, "problems", ())]
    details = {"type": "about:blank", "title": title, "detail": detail, "error": name, **numbers}
    return {**details, "problems": problems} if problems else details


@dataclass
class _ReportedProgress:
    """Writes progress into the job, at most once in `REPORT_INTERVAL_S`."""

    database: Database
    job: Job
    written_at: float = field(default=float("-inf"))

    def __call__(self, fraction: float, message: str) -> None:
        """Write the fraction done and the message.

        Raises:
            LostJob: this attempt is no longer the current one: the job was dismissed or taken over.
        """
        now = time.monotonic()
        if now - self.written_at < REPORT_INTERVAL_S:
            return
        self.written_at = now
        percent = min(max(int(100.0 * fraction), 0), 99)
        try:
            with self.database.transaction() as connection:
                attempts.report(connection, self.job.id, self.job.attempt, percent, message)
        except psycopg.Error as error:
            if (outage := outage_of(error)) is None:
                raise
            log.warning("job %s: the progress was not written: %s", self.job.id, outage.reason)
