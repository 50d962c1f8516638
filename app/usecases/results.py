"""Results of a job, sent as its request asked: values, and files by value or by reference."""

import base64
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from app.db.jobs.jobs import Job
from app.errors import NotFound
from app.storage import Storage
from app.usecases.registration.deliverables import media_type

Transmission = Literal["value", "reference"]
LARGEST_VALUE_BYTES = 16 << 20
"""A larger file is sent by reference even if requested by value, unless it is the only raw output."""


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
            too_large = not is_only_raw_output and storage.size(keys[name]) > LARGEST_VALUE_BYTES
            by_reference = too_large or requested == "reference"
            files.append(ResultFile(name, keys[name], "reference" if by_reference else "value"))
    return {name: values[name] for name in job.outputs if name in values}, files


def result_key(job: Job, name: str) -> str:
    """The storage key of a file of the results.

    Raises:
        NotFound: the job has no file of this name, or its files were removed.
    """
    key: str | None = (job.results or {}).get("files", {}).get(name)
    if key is None or job.results_removed_at is not None:
        raise NotFound(f"job {job.id} has no result {name:.100}")
    return key


def file_bytes(storage: Storage, file: ResultFile) -> bytes:
    """The content of a file."""
    with storage.open(file.key) as opened:
        return opened.read()


def file_value(storage: Storage, file: ResultFile) -> dict[str, Any]:
    """A file as part of a JSON document: JSON as it is, text as a string, other content in base64."""
    content = file_bytes(storage, file)
    media = {"mediaType": file.media_type}
    if Path(file.name).suffix in (".json", ".geojson"):
        return {"value": json.loads(content), **media}
    if file.media_type.startswith(("text/", "application/xml")):
        return {"value": content.decode(), **media}
    return {"value": base64.b64encode(content).decode(), "encoding": "base64", **media}
