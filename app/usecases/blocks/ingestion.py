"""Taking in blocks: the job that checks and loads one."""

import tempfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from uuid import UUID

from app.auth import Scope
from app.db import uploads
from app.db.engine import Connection
from app.db.tokens import Token
from app.errors import InputError, NotFound
from app.usecases.blocks import lifecycle
from app.usecases.blocks.uploads import finished_block
from app.usecases.processes import Commit, Process, Work
from services.errors import FormatError
from services.formats.archives import ArchiveLimits, Member, check_archive, unpack_archive
from services.formats.block.document_json import BLOCK_JSON
from services.quality.block import quality_document

UNPACKED_TIMES = 4
"""A block unpacks to at most so many times the largest upload."""


@dataclass(frozen=True)
class IngestBlock:
    """What an administrator says to have a block ingested: a folder of the server, or an upload.

    Attributes:
        path: of the block's folder on the server, below AMERS_INGEST_FOLDER.
        upload: id of an archive that was uploaded.
        publish: whether it becomes visible at once.
        priority: of blocks over one place the points of the greater one are served.
    """

    path: str | None = None
    upload: UUID | None = None
    publish: bool = False
    priority: int = 0


def _check(connection: Connection, caller: Token, inputs: IngestBlock) -> None:
    """Whether there is such a folder is for the worker to see: it may have other disks than the API."""
    if (inputs.path is None) == (inputs.upload is None):
        raise InputError("inputs of ingest-block: either path or upload is expected")
    if inputs.upload is not None:
        finished_block(connection, caller, inputs.upload)


def _run(work: Work) -> Commit:
    """The block is loaded in the transaction that ends the job: all of it is there, or nothing."""
    inputs: IngestBlock = work.inputs
    # Lives as long as the transaction may need it; goes with the attempt's process at the latest.
    scratch = tempfile.TemporaryDirectory(prefix="amers-block-")
    folder = (
        lifecycle.folder_to_ingest(work.settings.ingest_folder, inputs.path)
        if inputs.path is not None
        else _unpacked(work, inputs.upload, Path(scratch.name))
    )

    def commit(connection: Connection) -> dict[str, Any]:
        with scratch:
            ingested = lifecycle.ingest_block(
                connection, work.storage, folder, work.progress, inputs.priority
            )
        block = ingested.block
        if inputs.publish:
            block = lifecycle.publish_block(connection, str(block.number)).block
        figures = quality_document(ingested.quality)
        return {
            "number": block.number,
            "id": block.id,
            "version": block.version,
            "state": block.state,
            "points": block.n_points,
            "quality": {name: value for name, value in figures.items() if name != "cells"},
        }

    return commit


def _unpacked(work: Work, upload_id: UUID | None, scratch: Path) -> Path:
    """The folder of a block that came as an archive."""
    assert upload_id is not None
    with work.database.reading() as connection:
        key = uploads.find_block(connection, upload_id)
    if key is None:
        raise NotFound(f"no uploaded block {upload_id}")
    work.progress(0.0, "unpacking the block")
    archive = work.storage.fetch(key, scratch)
    limits = ArchiveLimits(UNPACKED_TIMES * work.settings.upload_limit_bytes)
    members = check_archive(archive, limits)
    root = _root(archive.name, members)
    folder = scratch / "block"
    places = {}
    for member in members:
        place = folder / member.path.relative_to(root)
        place.parent.mkdir(parents=True, exist_ok=True)
        places[member.path] = place
    unpack_archive(archive, places, limits)
    return folder


def _root(name: str, members: tuple[Member, ...]) -> PurePosixPath:
    """The folder of the archive that holds block.json and everything else."""
    documents = [member.path for member in members if member.path.name == BLOCK_JSON]
    if not documents:
        raise FormatError(f"{name}: no {BLOCK_JSON} in it")
    root = min(documents, key=lambda path: len(path.parts)).parent
    outside = next((m.path for m in members if not m.path.is_relative_to(root)), None)
    if outside is not None:
        raise FormatError(f"{name}: {str(outside)[:200]} lies outside the folder of {BLOCK_JSON}")
    return root


INGEST_BLOCK = Process(
    id="ingest-block",
    title="Ingest a block",
    description="Check a block of points, on the server or uploaded, and load it into the store.",
    scope=Scope.ADMIN,
    inputs=IngestBlock,
    outputs={},
    check=_check,
    run=_run,
    values={
        "number": {"type": "integer", "title": "Number of this version"},
        "id": {"type": "string", "title": "Name of the block"},
        "version": {"type": "string", "title": "Version"},
        "state": {"enum": ["staged", "published"], "title": "What it has become"},
        "points": {"type": "integer", "title": "Points that were loaded"},
        "quality": {"type": "object", "title": "Density, views a point, stated precision"},
    },
)
