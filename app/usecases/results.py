"""Results of a job: stored within the owner's quota, sent as its request asked, and removed."""

import base64
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from uuid import UUID

from amers.app.db import stored_files
from amers.app.db.engine import Database
from amers.app.db.jobs import attempts, jobs
from amers.app.db.jobs.jobs import Job
from amers.app.errors import NotFound, StorageOutage
from amers.app.storage import Storage
from amers.app.usecases import quotas
from amers.app.usecases.damage import named_by_row
from amers.app.usecases.media_types import media_type
from amers.app.usecases.processes import Work, results_folder, work_folder

Transmission = Literal["value", "reference"]
LARGEST_VALUE_BYTES = 16 << 20
"""A larger file is sent by reference even if requested by value, unless it is the only raw output."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ResultFile:
    """A file of the results.

    Attributes:
        name: of the output.
        key: in the storage.
        transmission: whether the file itself is sent, or its address.
    """

    name: str
    key: str
    transmission: Transmission

    @property
    def media_type(self) -> str:
        """The media type, by the suffix of the name."""
        return media_type(self.name)


def store_results(work: Work, files: Mapping[str, Path]) -> dict[str, str]:
    """Put the files of an attempt into the storage and record their checksums; returns keys by name.

    Their size is reserved from the owner's quota first.

    Raises:
        TooLarge: the files exceed what is left of the quota; nothing is stored.
        LostJob: the attempt is over.
    """
    size_bytes = sum(path.stat().st_size for path in files.values())
    with work.database.transaction() as connection:
        quotas.reserve_results(connection, work.settings, work.job, size_bytes)
    stored = {
        name: work.storage.put_file(f"{work.attempt_folder}/{name}", path)
        for name, path in files.items()
    }
    with work.database.transaction() as connection:
        for file in stored.values():
            stored_files.record_result(connection, work.job.id, file.key, file.size_bytes, file.sha256)
    return {name: file.key for name, file in stored.items()}


def discard_work(database: Database, storage: Storage, job_id: UUID) -> None:
    """Delete what attempts at a job keep on this machine for the next one, once there is none."""
    if not storage.unfinished(work_folder(job_id)):
        return
    with database.transaction() as connection:
        job = jobs.find(connection, job_id)
    if job is None or job.finished_at is not None:
        storage.forget_folder(work_folder(job_id))


def discard_attempt(database: Database, storage: Storage, job_id: UUID, attempt: int) -> None:
    """Delete the files of an attempt that is over without success, and give back their room.

    Does nothing for an attempt that runs or has succeeded.
    """
    with database.transaction() as connection:
        if attempts.counting_attempts(connection, [job_id]).get(job_id) == attempt:
            return
    delete_files(storage, f"{results_folder(job_id)}/{attempt}")
    with database.transaction() as connection:
        attempts.release_results(connection, job_id, attempt)


def reconcile_results(database: Database, storage: Storage) -> None:
    """Delete what lost attempts have left, and measure results whose sizes were never recorded."""
    with database.transaction() as connection:
        lost = attempts.lost_reservations(connection)
        unmeasured = jobs.unmeasured(connection)
    for job_id, attempt in lost.items():
        discard_attempt(database, storage, job_id, attempt)
    for job_id in unmeasured:
        size_bytes = sum(storage.sizes(results_folder(job_id)).values())
        with database.transaction() as connection:
            jobs.set_measured(connection, job_id, size_bytes)


def delete_files(storage: Storage, folder: str) -> None:
    """Delete the files below a folder of the storage."""
    for key in storage.keys(folder):
        storage.delete(key)


def delete_removed(storage: Storage, folder: str) -> None:
    """Delete the files below a folder that no row names any more; the sweep removes what is left."""
    try:
        delete_files(storage, folder)
    except (StorageOutage, OSError) as outage:
        log.warning("%s: the sweep has to delete its files: %s", folder, outage)


def requested_results(storage: Storage, job: Job) -> tuple[dict[str, Any], list[ResultFile]]:
    """The values and the files of a successful job that its request asked for.

    A request that names no outputs gets all of them, files by reference.
    """
    values = dict(job.results or {})
    keys = values.pop("files", {})
    if job.outputs is None:
        return values, [ResultFile(name, key, "reference") for name, key in keys.items()]
    is_only_raw_output = job.response == "raw" and len(job.outputs) == 1
    files = []
    for name, requested in job.outputs.items():
        if name in keys:
            too_large = not is_only_raw_output and _size(storage, keys[name]) > LARGEST_VALUE_BYTES
            by_reference = too_large or requested == "reference"
            files.append(ResultFile(name, keys[name], "reference" if by_reference else "value"))
    return {name: values[name] for name in job.outputs if name in values}, files


def kept_files(job: Job) -> dict[str, str]:
    """The storage keys of the files of the results, by name; none once they were removed."""
    files: dict[str, str] = (job.results or {}).get("files", {})
    return files if job.results_removed_at is None else {}


def result_key(job: Job, name: str) -> str:
    """The storage key of a file of the results.

    Raises:
        NotFound: the job has no file of this name, or its files were removed.
    """
    key = kept_files(job).get(name)
    if key is None:
        raise NotFound(f"job {job.id} has no result {name:.100}")
    return key


def file_bytes(storage: Storage, file: ResultFile) -> bytes:
    """The content of a file."""
    with named_by_row(file.key), storage.open(file.key) as opened:
        return opened.read()


def _size(storage: Storage, key: str) -> int:
    with named_by_row(key):
        return storage.size(key)


def file_value(storage: Storage, file: ResultFile) -> dict[str, Any]:
    """A file as part of a JSON document: JSON as it is, text as a string, other content in base64."""
    content = file_bytes(storage, file)
    media = {"mediaType": file.media_type}
    if Path(file.name).suffix in (".json", ".geojson"):
        return {"value": json.loads(content), **media}
    if file.media_type.startswith(("text/", "application/xml")):
        return {"value": content.decode(), **media}
    return {"value": base64.b64encode(content).decode(), "encoding": "base64", **media}
