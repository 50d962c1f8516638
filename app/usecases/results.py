"""What a job made, as it was asked to be told: values, files by reference or by value."""

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
"""Larger files go by reference whatever was asked for, but for one that is sent alone."""


@dataclass(frozen=True)
class ToldFile:
    """A file of the results.

    Attributes:
        key: in the storage.
        by: how it is told.
    """

    name: str
    key: str
    by: Transmission

    @property
    def media_type(self) -> str:
        """Of its name."""
        return media_type(self.name)


def told_results(storage: Storage, job: Job) -> tuple[dict[str, Any], list[ToldFile]]:
    """The values and the files of a successful job that were asked for.

    Files are told by reference unless an output was asked for by name.
    """
    values = dict(job.results or {})
    keys = values.pop("files", {})
    asked = job.outputs
    if asked is None:
        return values, [ToldFile(name, key, "reference") for name, key in keys.items()]
    alone = job.response == "raw" and len(asked) == 1
    files = []
    for name in asked:
        if name in keys:
            large = not alone and storage.size(keys[name]) > LARGEST_VALUE_BYTES
            by: Transmission = "reference" if large or asked[name] == "reference" else "value"
            files.append(ToldFile(name, keys[name], by))
    return {name: values[name] for name in asked if name in values}, files


def result_key(job: Job, name: str) -> str:
    """Where the storage has a file of the results.

    Raises:
        NotFound: there is none of that name.
    """
    key: str | None = (job.results or {}).get("files", {}).get(name)
    if key is None or job.results_removed_at is not None:
        raise NotFound(f"job {job.id} has no result {name:.100}")
    return key


def file_bytes(storage: Storage, file: ToldFile) -> bytes:
    """A file as it is."""
    with storage.open(file.key) as opened:
        return opened.read()


def file_value(storage: Storage, file: ToldFile) -> dict[str, Any]:
    """A file within a document: JSON as what it means, text as text, anything else in base64."""
    raw = file_bytes(storage, file)
    kind = {"mediaType": file.media_type}
    if Path(file.name).suffix in (".json", ".geojson"):
        return {"value": json.loads(raw), **kind}
    if file.media_type.startswith(("text/", "application/xml")):
        return {"value": raw.decode(), **kind}
    return {"value": base64.b64encode(raw).decode(), "encoding": "base64", **kind}
