"""Ingesting a block as a job, for blocks that no request would wait for."""

from dataclasses import dataclass
from typing import Any

from app.auth import Scope
from app.db.engine import Connection
from app.db.tokens import Token
from app.usecases import blocks
from app.usecases.processes import Commit, Process, Work


@dataclass(frozen=True)
class IngestBlock:
    """What an administrator says to have a block ingested.

    Attributes:
        path: of the block's folder on the server, below AMERS_INGEST_FOLDER.
        publish: whether it becomes visible at once.
    """

    path: str
    publish: bool = False


def _check(connection: Connection, caller: Token, inputs: IngestBlock) -> None:
    """Whether there is such a folder is for the worker to see: it may have other disks than the API."""


def _run(work: Work) -> Commit:
    """The block is loaded in the transaction that ends the job: all of it is there, or nothing."""
    inputs: IngestBlock = work.inputs
    folder = blocks.folder_to_ingest(work.settings.ingest_folder, inputs.path)

    def commit(connection: Connection) -> dict[str, Any]:
        block = blocks.ingest_block(connection, work.storage, folder, work.progress).block
        if inputs.publish:
            block = blocks.publish_block(connection, str(block.number)).block
        return {
            "number": block.number,
            "id": block.id,
            "version": block.version,
            "state": block.state,
            "points": block.n_points,
        }

    return commit


INGEST_BLOCK = Process(
    id="ingest-block",
    title="Ingest a block",
    description="Check a block of points on the server and load it into the store.",
    scope=Scope.ADMIN,
    inputs=IngestBlock,
    outputs={"id": "Name of the block.", "state": "Staged, or published."},
    check=_check,
    run=_run,
)
