"""The process `ingest-block`: check a block on the server or an uploaded archive, and load it."""

import tempfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from uuid import UUID

from amers.app.auth import Scope
from amers.app.db import uploads
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.errors import InputError, NotFound
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.uploads import find_uploaded_block
from amers.app.usecases.damage import named_by_row, suspecting_damage
from amers.app.usecases.processes import Commit, Process, Work
from amers.services.errors import FormatError
from amers.services.formats.archives import ArchiveLimits, Member, check_archive, unpack_archive
from amers.services.formats.block.document_json import BLOCK_JSON
from amers.services.quality.accuracy_statement import accuracy_document
from amers.services.quality.block import quality_document

UNPACKED_TIMES = 4
"""An archive may unpack to this many times the size limit of uploads."""


@dataclass(frozen=True)
class IngestBlock:
    """The inputs of an ingestion: a folder on the server, or an upload.

    Attributes:
        path: folder of the block on the server, below AMERS_INGEST_FOLDER.
        upload: id of an uploaded archive.
        publish: whether the block is published at once.
        priority: priority of the block: where blocks overlap, points of the block with the higher
            priority are served.
    """

    path: str | None = None
    upload: UUID | None = None
    publish: bool = False
    priority: int = 0


def _check(connection: Connection, caller: Token, inputs: IngestBlock) -> None:
    """Check the inputs but not the folder, which may lie on a disk that only the worker has."""
    if (inputs.path is None) == (inputs.upload is None):
        raise InputError("inputs of ingest-block: either path or upload is expected")
    if inputs.upload is not None:
        find_uploaded_block(connection, caller, inputs.upload)


def _run(work: Work) -> Commit:
    """Find the block; the transaction that ends the job loads it completely or not at all."""
    inputs: IngestBlock = work.inputs
    # Lives as long as the transaction may need it; it ends with the attempt's process at the latest.
    scratch = tempfile.TemporaryDirectory(prefix="amers-block-")
    folder = (
        lifecycle.folder_to_ingest(work.settings.ingest_folder, inputs.path)
        if inputs.path is not None
        else _unpack(work, inputs.upload, Path(scratch.name))
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
            **accuracy_document(ingested.stated),
            "quality": {name: value for name, value in figures.items() if name != "cells"},
        }

    return commit


def _unpack(work: Work, upload_id: UUID | None, scratch: Path) -> Path:
    """Unpack an uploaded block; returns its folder."""
    assert upload_id is not None
    with work.database.reading() as connection:
        key = uploads.find_block(connection, upload_id)
    if key is None:
        raise NotFound(f"no uploaded block {upload_id}")
    work.progress(0.0, "unpacking the block")
    with named_by_row(key):
        archive = work.storage.fetch(key, scratch)
    limits = ArchiveLimits(UNPACKED_TIMES * work.settings.upload_limit_bytes)
    with suspecting_damage(work.database, work.storage, [key]):
        members = check_archive(archive, limits)
    root = _block_root(archive.name, members)
    folder = scratch / "block"
    targets = {}
    for member in members:
        target = folder / member.path.relative_to(root)
        target.parent.mkdir(parents=True, exist_ok=True)
        targets[member.path] = target
    with suspecting_damage(work.database, work.storage, [key]):
        unpack_archive(archive, targets, limits)
    return folder


def _block_root(name: str, members: tuple[Member, ...]) -> PurePosixPath:
    """The folder inside an archive that contains block.json and all other members."""
    documents = [member.path for member in members if member.path.name == BLOCK_JSON]
    if not documents:
        raise FormatError(f"{name}: no {BLOCK_JSON} found in the archive; a block is expected")
    root = min(documents, key=lambda path: len(path.parts)).parent
    outside = next((m.path for m in members if not m.path.is_relative_to(root)), None)
    if outside is not None:
        raise FormatError(f"{name}: {str(outside)[:200]} lies outside the folder of {BLOCK_JSON}")
    return root


INGEST_BLOCK = Process(
    id="ingest-block",
    title="Ingest a block",
    description="Check a block of points that is on the server or was uploaded, and load it "
    "into the store.",
    scope=Scope.ADMIN,
    inputs=IngestBlock,
    outputs={},
    check=_check,
    run=_run,
    values={
        "number": {"type": "integer", "title": "Number of this version"},
        "id": {"type": "string", "title": "Name of the block"},
        "version": {"type": "string", "title": "Version"},
        "state": {"enum": ["staged", "published"], "title": "State after the ingestion"},
        "points": {"type": "integer", "title": "Points loaded"},
        "relative_to_control_points": {"type": "object", "title": "CE90, LE90 of the median point"},
        "on_the_earth": {
            "type": "object",
            "title": "CE90, LE90 of the median point, with the frame of the block",
        },
        "quality": {"type": "object", "title": "Density, views per point and stated precision"},
    },
)
