"""Blocks: the quality of each, and their life for an administrator."""

from typing import Annotated, Any
from uuid import UUID

from fastapi import APIRouter, Header, Request, Response
from pydantic import BaseModel, ConfigDict

from app.api.body import body_chunks
from app.api.deps import (
    Admin,
    DatabaseDep,
    PointsReader,
    SettingsDep,
    StorageDep,
    UploadTurn,
)
from app.api.jobs import job_url, status_info
from app.auth import is_administrator
from app.db.blocks import Block
from app.db.engine import Connection
from app.db.tokens import Token
from app.usecases import jobs
from app.usecases.blocks import lifecycle, uploads
from app.usecases.blocks.ingestion import INGEST_BLOCK
from app.usecases.blocks.lifecycle import Published
from app.usecases.installation import Installation
from app.usecases.jobs import JobRequest
from app.usecases.scenes import SentFile
from services.quality.block import quality_document

router = APIRouter(tags=["blocks"])


class BlockToIngest(BaseModel):
    """A block to ingest: on the server, or uploaded before.

    Attributes:
        path: of its folder, below AMERS_INGEST_FOLDER.
        upload: of an archive, as its upload replied.
        publish: whether it becomes visible at once.
        priority: of blocks over one place, the points of the greater one are served.
    """

    model_config = ConfigDict(extra="forbid")

    path: str | None = None
    upload: UUID | None = None
    publish: bool = False
    priority: int = 0


class Priority(BaseModel):
    """How a block stands against others over the same place."""

    model_config = ConfigDict(extra="forbid")

    priority: int


BINARY_BODY = {
    "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
}


@router.put(
    "/blocks/uploads/{name}",
    status_code=201,
    dependencies=[UploadTurn],
    openapi_extra={"requestBody": BINARY_BODY},
)
def upload_block(
    name: str,
    request: Request,
    database: DatabaseDep,
    storage: StorageDep,
    settings: SettingsDep,
    caller: Admin,
) -> dict[str, str]:
    """Upload a zip or tar of a block; the reply says how `POST /blocks` names it."""
    length = request.headers.get("content-length", "")
    announced = int(length) if length.isdigit() else None
    sent = SentFile(name, body_chunks(request), announced)
    upload_id = uploads.receive_block(Installation(database, storage, settings), caller, sent)
    return {"upload": str(upload_id)}


@router.post("/blocks", status_code=201)
def ingest(
    body: BlockToIngest,
    request: Request,
    response: Response,
    database: DatabaseDep,
    settings: SettingsDep,
    caller: Admin,
    idempotency_key: Annotated[str | None, Header()] = None,
) -> dict[str, Any]:
    """Have a block checked and loaded, staged or published; the reply is a job to watch.

    The same as an execution of the process `ingest-block`.
    """
    inputs = body.model_dump(mode="json", exclude_none=True)
    with database.transaction() as connection:
        job_request = JobRequest(INGEST_BLOCK.id, inputs)
        job = jobs.execute(connection, settings, caller, job_request, idempotency_key)
    response.headers["Location"] = job_url(request, job)
    return status_info(request, job)


@router.get("/blocks/{reference}/quality")
def quality(reference: str, database: DatabaseDep, caller: PointsReader) -> dict[str, Any]:
    """The quality figures of a block; `cells` list west, south, area in km2, number of points.

    `accuracy` is what the producer of the block measured, and against what.
    """
    with database.reading() as connection:
        block = _visible(connection, reference, caller)
        report = lifecycle.block_report(connection, block)
    return {**quality_document(report.quality), "accuracy": [vars(f) for f in report.accuracy]}


@router.post("/blocks/{reference}/publish")
def publish(reference: str, database: DatabaseDep, caller: Admin) -> dict[str, Any]:
    """Make a block visible, and the version of it that was visible before no longer."""
    with database.transaction() as connection:
        return _published(lifecycle.publish_block(connection, reference))


@router.post("/blocks/{reference}/restore")
def restore(reference: str, database: DatabaseDep, caller: Admin) -> dict[str, Any]:
    """Make a block visible again that was withdrawn or superseded, in place of its visible version."""
    with database.transaction() as connection:
        return _published(lifecycle.restore_block(connection, reference))


@router.patch("/blocks/{reference}")
def prioritise(reference: str, body: Priority, database: DatabaseDep, caller: Admin) -> dict[str, Any]:
    """Let a block win or lose against other blocks over the same place."""
    with database.transaction() as connection:
        return {"block": _properties(lifecycle.prioritise_block(connection, reference, body.priority))}


@router.post("/blocks/{reference}/withdraw")
def withdraw(reference: str, database: DatabaseDep, caller: Admin) -> dict[str, Any]:
    """Make a block invisible; it can be published again."""
    with database.transaction() as connection:
        return {"block": _properties(lifecycle.withdraw_block(connection, reference))}


def _published(published: Published) -> dict[str, Any]:
    superseded = published.superseded
    return {
        "block": _properties(published.block),
        "superseded": None if superseded is None else _properties(superseded),
    }


def _visible(connection: Connection, reference: str, caller: Token | None) -> Block:
    """The block a caller may see: any for an administrator, the published one for others."""
    if is_administrator(caller):
        return lifecycle.find_block(connection, reference)
    return lifecycle.find_published(connection, reference)


def _properties(block: Block) -> dict[str, Any]:
    return {name: value for name, value in vars(block).items() if name != "outline"}
